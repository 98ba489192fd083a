"""Mine tuples: a query, its nearest positive and its hardest negatives, by the model as it is.

NetVLAD's cached hard mining (Arandjelovic et al., CVPR 2016), and the partial mining of Mapillary's
code and of Berton et al. (CVPR 2022), which Patch-NetVLAD and SelaVPR train with.
"""

import math
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Int32, Int64

from crisalad_jax.data.loader import ImageBatch, batches_of_groups
from crisalad_jax.data.query_set import QuerySet
from crisalad_jax.training.batches import prepared_as
from crisalad_jax.training.config import MiningConfig, TrainConfig
from crisalad_jax.training.losses.pairs import Role, tuple_labels
from crisalad_jax.utils.errors import InputError

Describe = Callable[[Int[np.ndarray, " n"]], Float[np.ndarray, "n descriptor"]]
"""Takes image numbers; returns their descriptors, NaN for images that cannot be read."""


class Mined(NamedTuple):
    """The tuples of a round, which a run saves with its state."""

    step: Int32[np.ndarray, ""]
    """First step of the round; -1 before the first."""
    images: Int32[np.ndarray, "tuple image"]
    roles: Int32[np.ndarray, "tuple image"]
    """See `losses.pairs.Role`."""
    hardest: Int32[np.ndarray, "query negative"]
    """Last negatives of each query, which are candidates again; -1 for none."""


class Miner:
    """Mines the tuples of each round of an epoch, and yields their batches."""

    classes: tuple[int, ...] = ()

    def __init__(self, config: TrainConfig, queries: QuerySet, **reading: Any) -> None:
        """Divide an epoch into rounds; raises as `rounds_of`.

        Args:
            config: the run's.
            queries: the training set.
            **reading: how images are read; see `batches_of_groups`.
        """
        self._config, self._queries = config, queries
        self._reading = prepared_as(config) | reading
        rounds, self.steps_per_round = rounds_of(config, queries)
        self.steps_per_epoch = rounds * self.steps_per_round
        self.mined = no_tuples(
            config.mining, queries, self.steps_per_round * config.places_per_batch
        )
        """Tuples of the round that trains now, which a run saves with its state."""

    def is_due(self, step: int) -> bool:
        """Return whether a round begins with this step, whose tuples are not mined yet."""
        return step % self.steps_per_round == 0 and int(self.mined.step) != step

    def mine(self, step: int, describe: Callable[[Sequence[pathlib.Path]], np.ndarray]) -> str:
        """Mine the tuples of the round that begins with a step.

        Args:
            step: the first step of the round.
            describe: takes image files; returns their descriptors by the model as it is, NaN for
                those that cannot be read.

        Returns:
            How hard the tuples are, for the user.
        """
        config, unreadable = self._config, 0
        epoch, first = divmod(step, self.steps_per_epoch)
        chosen = draw_queries(
            config.mining,
            len(self._queries.queries),
            len(self.mined.images),
            seed=config.seed,
            epoch=epoch,
            number=first // self.steps_per_round,
        )

        def described(images: np.ndarray) -> np.ndarray:
            nonlocal unreadable
            rows = describe([self._queries.path(image) for image in images])
            unreadable += int(np.isnan(rows).any(axis=1).sum())
            return rows

        hardest, seed = self.mined.hardest, config.seed
        self.mined = mine_tuples(
            config.mining, self._queries, chosen, hardest, described, seed=seed, step=step
        )
        negatives = (self.mined.roles == Role.NEGATIVE).sum(axis=1)
        left_out = f"; {unreadable} unreadable images left out" if unreadable else ""
        return (
            f"mined {len(negatives)} tuples: {100 * (negatives > 0).mean():.0f} % have hard "
            f"negatives, {negatives.mean():.1f} in the mean{left_out}"
        )

    def batches(self, step: int) -> Iterator[ImageBatch]:
        """Yield the batches from `step` to the end of its round; see `batches_of_groups`."""
        config = self._config
        shape = (-1, config.places_per_batch, config.images_per_place)
        return batches_of_groups(
            self._queries,
            self.mined.images.reshape(shape),
            tuple_labels(self.mined.roles).reshape(shape),
            seed=(config.seed, int(self.mined.step)),
            start_step=step % self.steps_per_round,
            **self._reading,
        )


def rounds_of(config: TrainConfig, queries: QuerySet) -> tuple[int, int]:
    """Divide an epoch into rounds of whole batches.

    Returns:
        (rounds, steps of each).

    Raises:
        InputError: the queries make no batch.
    """
    mining = config.mining
    queries_per_epoch = mining.queries_per_epoch or len(queries.queries)
    rounds = math.ceil(queries_per_epoch / mining.queries_per_round)
    size = min(queries_per_epoch // rounds, len(queries.queries))
    steps = size // config.places_per_batch
    if not steps:
        raise InputError(
            f"{queries.root}: found rounds of {size} queries, of {len(queries.queries)} with "
            f"positives, mining.queries_per_epoch {mining.queries_per_epoch} and queries_per_round "
            f"{mining.queries_per_round}, expected at least places_per_batch "
            f"{config.places_per_batch}"
        )
    return rounds, steps


def no_tuples(config: MiningConfig, queries: QuerySet, size: int) -> Mined:
    """Return what a run has before its first round, in the shapes of a round of `size` tuples."""
    none = np.zeros((size, 2 + config.negatives), np.int32)
    hardest = np.full((len(queries.queries), config.negatives), -1, np.int32)
    return Mined(np.array(-1, np.int32), none, none, hardest)


def draw_queries(
    config: MiningConfig,
    queries: int,
    size: int,
    *,
    seed: int,
    epoch: int,
    number: int,
) -> Int64[np.ndarray, " tuple"]:
    """Draw the queries of a round: those that are its turn, or `size` of all.

    Args:
        config: the mining's.
        queries: how many there are.
        size: number of tuples of a round.
        seed: draws them, with the epoch and the round.
        epoch: from 0.
        number: of the round in its epoch, from 0.

    Returns:
        Positions of the queries.
    """
    if config.queries_per_epoch is not None:
        return _generator(seed, epoch, number).choice(queries, size, replace=False)
    start = number * size
    return _generator(seed, epoch).permutation(queries)[start : start + size]


def mine_tuples(
    config: MiningConfig,
    queries: QuerySet,
    chosen: Int64[np.ndarray, " tuple"],
    hardest: Int32[np.ndarray, "query negative"],
    describe: Describe,
    *,
    seed: int,
    step: int,
) -> Mined:
    """Mine a tuple for each chosen query.

    Args:
        config: the mining's.
        queries: the training set.
        chosen: positions of the queries.
        hardest: last negatives of each query.
        describe: makes descriptors.
        seed: draws candidates, with the step.
        step: first step of the round.

    Returns:
        The tuples, and the last negatives after them.
    """
    generator = _generator(seed, step, key=3)
    count = min(config.candidates, queries.database)
    if config.kind == "sample":
        sampled = np.sort(generator.choice(queries.database, count, replace=False))
        of_queries = np.concatenate([queries.positives[query] for query in chosen])
        described = np.union1d(sampled, of_queries)
    else:
        sampled, described = None, np.arange(queries.database)
    database, asked = describe(described), describe(queries.queries[chosen])
    tuples, roles, hardest = [], [], hardest.copy()
    for query, descriptor in zip(chosen, asked, strict=True):
        candidates = sampled
        if candidates is None:
            drawn = generator.choice(queries.database, count, replace=False)
            candidates = np.union1d(drawn, hardest[query][hardest[query] >= 0])
        candidates = np.setdiff1d(candidates, queries.near[query], assume_unique=True)
        positives = queries.positives[query]
        to_positive, to_negative = (
            _distances(descriptor, database[np.searchsorted(described, images)])
            for images in (positives, candidates)
        )
        nearest = to_positive.argmin()
        order = np.argsort(to_negative, kind="stable")[: config.negatives]
        farthest = np.inf if config.margin is None else to_positive[nearest] + config.margin
        used = to_negative[order] < farthest
        negatives = np.full(config.negatives, positives[nearest])
        negatives[: len(order)] = candidates[order]
        role = np.full(config.negatives, Role.SPARE)
        role[: len(order)][used] = Role.NEGATIVE
        if used.any():
            hardest[query] = np.where(role == Role.NEGATIVE, negatives, -1)
        tuples.append((queries.queries[query], positives[nearest], *negatives))
        roles.append((Role.QUERY, Role.POSITIVE, *role))
    return Mined(
        np.array(step, np.int32), np.array(tuples, np.int32), np.array(roles, np.int32), hardest
    )


def _distances(
    descriptor: Float[np.ndarray, " descriptor"], others: Float[np.ndarray, "n descriptor"]
) -> Float[np.ndarray, " n"]:
    """Compute Euclidean distances; infinite to images that cannot be read."""
    squares = (others * others).sum(axis=1) + descriptor @ descriptor - 2 * (others @ descriptor)
    return np.nan_to_num(np.sqrt(np.maximum(squares, 0)), nan=np.inf)


def _generator(*numbers: int, key: int = 2) -> np.random.Generator:
    # The spawn key makes these streams independent of the loader's from the same numbers.
    return np.random.default_rng(np.random.SeedSequence(numbers, spawn_key=(key,)))
