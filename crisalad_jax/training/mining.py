"""Mine tuples with the current model: a query, its nearest positive and its hardest negatives.

It is NetVLAD's cached hard mining (Arandjelovic et al., CVPR 2016), or the partial mining of
Mapillary's code and Berton et al. (CVPR 2022), with which Patch-NetVLAD and SelaVPR train.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Int32

from crisalad_jax.config.checks import require
from crisalad_jax.data.loader import ImageBatch, batches_of_groups
from crisalad_jax.data.query_set import QuerySet
from crisalad_jax.data.samplers.base import Describe
from crisalad_jax.training.batches import PlaceBatches, prepared_as
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.losses.pairs import Role, tuple_labels


class Mined(NamedTuple):
    """The tuples of a round (the part of an epoch that is mined at once), saved with the state."""

    step: Int32[np.ndarray, ""]
    """First step of the round; -1 before the first round."""
    images: Int32[np.ndarray, "tuple image"]
    roles: Int32[np.ndarray, "tuple image"]
    """`losses.pairs.Role` of each image; `images` holds indices in `QuerySet.files`."""
    hardest: Int32[np.ndarray, "query negative"]
    """Each query's previous hard negatives, which become candidates again; -1 for none."""


class Miner:
    """Mines the tuples of each round of an epoch, and yields their batches."""

    classes: tuple[int, ...] = ()

    def __init__(self, config: TrainConfig, queries: QuerySet, **reading: Any) -> None:
        """Divide an epoch into rounds of whole batches.

        Args:
            config: the run's configuration.
            queries: the training set.
            **reading: how images are read; see `batches_of_groups`.

        Raises:
            InputError: there are too few queries for a batch.
        """
        self._config, self._queries = config, queries
        self._reading = prepared_as(config) | reading
        mining, count = config.mining, len(queries.queries)
        queries_per_epoch = mining.queries_per_epoch or count
        rounds = math.ceil(queries_per_epoch / mining.queries_per_round)
        size = min(queries_per_epoch // rounds, count)
        self.steps_per_round = size // config.places_per_batch
        self.steps_per_epoch = rounds * self.steps_per_round
        require(
            self.steps_per_round > 0,
            f"{queries.root}: found rounds of {size} queries, of {count} with positives, "
            f"mining.queries_per_epoch {mining.queries_per_epoch} and queries_per_round "
            f"{mining.queries_per_round}, expected at least places_per_batch "
            f"{config.places_per_batch}",
        )
        tuples = self.steps_per_round * config.places_per_batch
        none = np.zeros((tuples, config.images_per_place), np.int32)
        hardest = np.full((count, mining.negatives), -1, np.int32)
        self.mined = Mined(np.array(-1, np.int32), none, none, hardest)
        """Tuples of the current round, which a run saves with its state."""

    def is_due(self, step: int) -> bool:
        """Return whether this step begins a round whose tuples are not mined yet."""
        return step % self.steps_per_round == 0 and int(self.mined.step) != step

    def mine(self, step: int, describe: Describe) -> str:
        """Mine a tuple for each query of the round that begins with `step`.

        Args:
            step: the first step of the round; with the seed, it determines the candidates drawn.
            describe: computes the current model's descriptors of image files.

        Returns:
            A message to the user on how hard the tuples are.
        """
        mining, queries = self._config.mining, self._queries
        chosen = self._draw_queries(step)
        generator = self._generator(step, key=3)

        def drawn() -> np.ndarray:
            count = min(mining.candidates, queries.database)
            return generator.choice(queries.database, count, replace=False)

        described, sampled = np.arange(queries.database), None
        if mining.kind == "sample":
            sampled = np.sort(drawn())
            described = np.union1d(sampled, np.concatenate([queries.positives[q] for q in chosen]))
        database, asked = (
            describe([queries.path(image) for image in images])
            for images in (described, queries.queries[chosen])
        )
        tuples, roles, hardest = [], [], self.mined.hardest.copy()
        for query, descriptor in zip(chosen, asked, strict=True):
            candidates, last = sampled, hardest[query]
            if candidates is None:
                candidates = np.union1d(drawn(), last[last >= 0])
            candidates = np.setdiff1d(candidates, queries.near[query], assume_unique=True)
            to_positives, to_candidates = (
                _distances(descriptor, database[np.searchsorted(described, images)])
                for images in (queries.positives[query], candidates)
            )
            images, role = self._tuple(int(query), candidates, to_positives, to_candidates)
            if (role == Role.NEGATIVE).any():
                hardest[query] = np.where(role == Role.NEGATIVE, images, -1)[2:]
            tuples.append(images)
            roles.append(role)
        self.mined = Mined(
            np.array(step, np.int32), np.array(tuples, np.int32), np.array(roles, np.int32), hardest
        )
        hard = (self.mined.roles == Role.NEGATIVE).sum(axis=1)
        unreadable = sum(int(np.isnan(rows).any(axis=1).sum()) for rows in (database, asked))
        left_out = f"; {unreadable} unreadable images left out" if unreadable else ""
        return (
            f"mined {len(hard)} tuples: {100 * (hard > 0).mean():.0f} % have hard negatives, "
            f"{hard.mean():.1f} on average{left_out}"
        )

    def _tuple(
        self,
        query: int,
        candidates: Int[np.ndarray, " candidate"],
        to_positives: Float[np.ndarray, " positive"],
        to_candidates: Float[np.ndarray, " candidate"],
    ) -> tuple[Int[np.ndarray, " image"], Int[np.ndarray, " image"]]:
        """Make a query's tuple from its distances; return its images and their roles."""
        mining, queries = self._config.mining, self._queries
        nearest = to_positives.argmin()
        positive = queries.positives[query][nearest]
        farthest = np.inf if mining.margin is None else to_positives[nearest] + mining.margin
        order = np.argsort(to_candidates, kind="stable")[: mining.negatives]
        images = np.full(2 + mining.negatives, positive)  # where candidates are too few
        roles = np.full(len(images), Role.SPARE)
        images[0], roles[:2] = queries.queries[query], (Role.QUERY, Role.POSITIVE)
        images[2:][: len(order)] = candidates[order]
        roles[2:][: len(order)][to_candidates[order] < farthest] = Role.NEGATIVE
        return images, roles

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

    def _draw_queries(self, step: int) -> Int[np.ndarray, " tuple"]:
        """Draw positions of a round's queries: the next of a permutation, or a random sample."""
        count, size = len(self._queries.queries), len(self.mined.images)
        epoch, first = divmod(step, self.steps_per_epoch)
        number = first // self.steps_per_round
        if self._config.mining.queries_per_epoch is not None:
            return self._generator(epoch, number).choice(count, size, replace=False)
        return self._generator(epoch).permutation(count)[number * size :][:size]

    def _generator(self, *numbers: int, key: int = 2) -> np.random.Generator:
        # The spawn key makes these streams independent of the loader's from the same numbers.
        numbers = self._config.seed, *numbers
        return np.random.default_rng(np.random.SeedSequence(numbers, spawn_key=(key,)))


Batches = PlaceBatches | Miner
"""Source of a run's batches, which consist of places or of mined tuples."""


def _distances(
    descriptor: Float[np.ndarray, " descriptor"], others: Float[np.ndarray, "n descriptor"]
) -> Float[np.ndarray, " n"]:
    """Compute Euclidean distances; infinite to images that cannot be read."""
    squares = (others * others).sum(axis=1) + descriptor @ descriptor - 2 * (others @ descriptor)
    return np.nan_to_num(np.sqrt(np.maximum(squares, 0)), nan=np.inf)
