"""Paired differences of recall: which of two methods is better, on the same queries."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool

from crisalad_jax.evaluation.metrics import Interval
from crisalad_jax.utils.errors import InputError

RESAMPLES = 10_000
"""Number of resamples: the ends of an interval then vary by about a hundredth of its width."""
Verdict = Literal["better", "worse", "not told apart"]


class Difference(NamedTuple):
    """A method's recall less the reference's, as fractions of the same queries."""

    mean: float
    """Difference of the means over the seeds."""
    interval: Interval
    """95 % interval of it over queries and seeds."""

    @property
    def verdict(self) -> Verdict:
        """Say what the interval decides: "better" or "worse" where it excludes 0."""
        if self.interval.low > 0:
            return "better"
        return "worse" if self.interval.high < 0 else "not told apart"


def paired_difference(
    hits: Bool[np.ndarray, "seed q"],
    reference: Bool[np.ndarray, "other_seed q"],
    *,
    same_seeds: bool = True,
    resamples: int = RESAMPLES,
    confidence: float = 0.95,
    seed: int = 0,
) -> Difference:
    """Compute the difference of two recalls, and its percentile bootstrap's interval.

    A resample draws as many queries with replacement, the same ones for both methods, and as many
    seeds. Runs of one seed share initial values and batches, so that the same seeds are drawn for
    both methods; what a seed does to both cancels. Queries with the same hits are drawn together,
    by a multinomial distribution, which is exact and takes no more time for more queries.

    Args:
        hits: whether each query was a hit, for each seed of the method.
        reference: the same of the reference, on the same queries.
        same_seeds: whether row i of both is a run of the same seed. If not, as for a model from a
            file, the seeds of each method are drawn independently.
        resamples: number of resamples.
        confidence: of the interval, 0 to 1.
        seed: of the resampling; the same one gives the same interval.

    Returns:
        The difference, positive where the method recalls more.

    Raises:
        InputError: no queries or seeds, other queries than the reference's, another number of seeds
            although they are the same, or no such confidence.

    Example:
        >>> first, second = np.array([[True, True, True, False]]), np.array([[False] * 4])
        >>> paired_difference(first, second).mean
        0.75
    """
    if not hits.size or not reference.size or hits.shape[1] != reference.shape[1]:
        raise InputError(
            f"hits: found shapes {hits.shape} and {reference.shape}, expected (seeds, queries) of "
            "the same queries"
        )
    if same_seeds and len(hits) != len(reference):
        raise InputError(
            f"hits: found {len(hits)} and {len(reference)} seeds, expected the same number, or "
            "same_seeds=False"
        )
    if not 0 < confidence < 1:
        raise InputError(f"confidence: found {confidence}, expected a fraction between 0 and 1")
    generator = np.random.default_rng(seed)
    queries = hits.shape[1]
    patterns, counts = np.unique(np.concatenate([hits, reference]), axis=1, return_counts=True)
    drawn = generator.multinomial(queries, counts / queries, size=resamples)
    recalls = drawn @ patterns.T.astype(float) / queries
    ours, theirs = recalls[:, : len(hits)], recalls[:, len(hits) :]
    weights = _drawn_seeds(generator, resamples, len(hits))
    other = weights if same_seeds else _drawn_seeds(generator, resamples, len(reference))
    differences = (weights * ours).sum(axis=1) - (other * theirs).sum(axis=1)
    tail = (1 - confidence) / 2
    # Sums that are equal in exact arithmetic must not differ by their rounding.
    low, high = np.quantile(differences.round(12), (tail, 1 - tail))
    return Difference(float(hits.mean() - reference.mean()), Interval(float(low), float(high)))


def _drawn_seeds(generator: np.random.Generator, resamples: int, seeds: int) -> np.ndarray:
    """Draw seeds with replacement; return the share of each in each resample."""
    return generator.multinomial(seeds, [1 / seeds] * seeds, size=resamples) / seeds
