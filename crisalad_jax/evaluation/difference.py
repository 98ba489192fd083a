"""The difference of two recalls on the same queries, and its confidence interval."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool

from crisalad_jax.evaluation.metrics import Interval
from crisalad_jax.utils.errors import InputError

RESAMPLES = 10_000
"""Number of resamples: the ends of an interval then vary by about a hundredth of its width."""


class Difference(NamedTuple):
    """The recall of a method minus that of a reference, as fractions of the same queries."""

    mean: float
    """Mean recall over the seeds of the method, minus that over the seeds of the reference."""
    interval: Interval
    """95 % bootstrap interval of the difference, resampled over queries and seeds."""

    verdict: Literal["better", "worse", "inconclusive"]
    """What the interval shows: "better" if it is above 0, "worse" if below, else "inconclusive"."""


def paired_difference(
    hits: Bool[np.ndarray, "seed q"],
    reference: Bool[np.ndarray, "other_seed q"],
    *,
    same_seeds: bool = True,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Difference:
    """Compute the difference of two recalls, and its 95 % interval by percentile bootstrap.

    Each resample draws queries and seeds with replacement, as many as there are. Both methods get
    the same queries and, if `same_seeds`, the same seeds: two runs with one seed share initial
    values and batches, whose effect then cancels. Queries with the same hits in all runs are drawn
    together from a multinomial distribution: exactly, at a cost independent of their number.

    Args:
        hits: whether each query was a hit, for each seed of the method.
        reference: the same for the reference method, on the same queries.
        same_seeds: whether row i of both arrays is a run of the same seed. If not, as for a model
            from a file, the seeds of each method are drawn independently.
        resamples: number of resamples.
        seed: seed of the resampling; the same seed gives the same interval.

    Returns:
        The difference, positive if the method recalls more.

    Raises:
        InputError: there are no queries or no seeds; the numbers of queries differ; or, with
            `same_seeds`, the numbers of seeds differ.

    Example:
        >>> first, second = np.array([[True, True, True, False]]), np.array([[False] * 4])
        >>> paired_difference(first, second).mean
        0.75
    """
    fits = hits.size and hits.shape[1] == reference.shape[1]
    if not fits or (same_seeds and len(hits) != len(reference)):
        raise InputError(
            f"hits: found shapes {hits.shape} and {reference.shape}, expected (seeds, queries) of "
            "the same queries, and the same number of seeds unless same_seeds=False"
        )
    generator = np.random.default_rng(seed)
    queries = hits.shape[1]
    patterns, counts = np.unique(np.concatenate([hits, reference]), axis=1, return_counts=True)
    drawn = generator.multinomial(queries, counts / queries, size=resamples)
    recalls = drawn @ patterns.T.astype(float) / queries
    ours, theirs = recalls[:, : len(hits)], recalls[:, len(hits) :]
    weights = _drawn_seeds(generator, resamples, len(hits))
    other = weights if same_seeds else _drawn_seeds(generator, resamples, len(reference))
    differences = (weights * ours).sum(axis=1) - (other * theirs).sum(axis=1)
    # Sums that are equal in exact arithmetic must not differ by rounding.
    low, high = np.quantile(differences.round(12), (0.025, 0.975))
    verdict = "better" if low > 0 else "worse" if high < 0 else "inconclusive"
    mean = float(hits.mean() - reference.mean())
    return Difference(mean, Interval(float(low), float(high)), verdict)


def _drawn_seeds(generator: np.random.Generator, resamples: int, seeds: int) -> np.ndarray:
    """Draw seeds with replacement; return the share of each in each resample."""
    return generator.multinomial(seeds, [1 / seeds] * seeds, size=resamples) / seeds
