"""Mine tuples: a query, its nearest positive and its hardest negatives, by the model as it is.

NetVLAD's cached hard mining (Arandjelovic et al., CVPR 2016), and the partial mining of Mapillary's
code and of Berton et al. (CVPR 2022), which Patch-NetVLAD and SelaVPR train with.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Int32, Int64

from crisalad_jax.data.query_set import QuerySet
from crisalad_jax.losses.pairs import Role
from crisalad_jax.training.config import MiningConfig

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


def describe_mined(mined: Mined) -> str:
    """Tell in words how hard the tuples are."""
    negatives = (mined.roles == Role.NEGATIVE).sum(axis=1)
    return (
        f"mined {len(negatives)} tuples: {100 * (negatives > 0).mean():.0f} % have hard negatives, "
        f"{negatives.mean():.1f} in the mean"
    )
