"""Recall@K with confidence intervals, and precision-recall.

As is usual in visual place recognition, recall counts every query, even those without a match.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int64

from crisalad_jax.config.checks import check_count, require
from crisalad_jax.config.short_repr import brief, in_one_line
from crisalad_jax.utils.errors import InputError


def right_retrievals(
    indices: Int[np.ndarray, "q k"], positives: Sequence[Int[np.ndarray, " _"]]
) -> Bool[np.ndarray, "q k"]:
    """Mark the retrieved database images that are correct for their query.

    Args:
        indices: database indices of each query's neighbours, best first.
        positives: correct database indices of each query, possibly none.

    Raises:
        InputError: there are no queries; `positives` has another number of queries; or an index in
            it is negative, which some ground truths use for "no match" (leave such an index out).
    """
    fits = 0 < len(indices) == len(positives)
    if not fits or any(np.min(wanted, initial=0) < 0 for wanted in positives):
        raise InputError(
            f"positives: found {len(positives)} lists for {len(indices)} queries, expected one for "
            "each query, of database indices from 0, and at least one query"
        )
    pairs = zip(indices, positives, strict=True)
    return np.array([np.isin(found, wanted) for found, wanted in pairs])


def recalls(
    indices: Int[np.ndarray, "q k"],
    positives: Sequence[Int[np.ndarray, " _"]],
    ks: Sequence[int] = (1, 5, 10, 20),
) -> dict[int, float]:
    """Compute Recall@K: the share of **all** queries with a positive among their top K.

    A query without positives is a miss. If K exceeds the number of columns, all columns count:
    `search` for max(ks) neighbours returns fewer only if the database is smaller.

    Args:
        indices: database indices of each query's neighbours, best first.
        positives: correct database indices of each query, possibly none.
        ks: the values of K.

    Returns:
        Fractions of the queries, 0 to 1, by K.

    Raises:
        InputError: a K is below 1, or `right_retrievals` raises it.
    """
    for k in ks:
        check_count("ks", k)
    right = right_retrievals(indices, positives)
    return {k: float(right[:, :k].any(axis=1).mean()) for k in ks}


class Interval(NamedTuple):
    """A confidence interval, both ends included."""

    low: float
    high: float


def bootstrap_interval(hits: Int[np.ndarray, " q"], trials: int = 1) -> Interval:
    """Compute the percentile bootstrap's 95 % interval (Efron 1979) of the mean of hits / trials.

    Hits are integers, so the limit of infinitely many resamples is computed exactly, without
    drawing any. A resample sums q independent draws from the queries' hits. That sum is distributed
    as the q-fold convolution of the hit frequencies, computed by a Fourier transform; for one trial
    it is the binomial distribution.

    The queries are assumed to be independent. Frames of one camera are not, so their interval is
    too narrow. An interval of width 0, at 0 or 1, means that all of these queries agree, not that
    other queries would.

    Args:
        hits: number of trials in which each query was a hit.
        trials: number of trials per query, such as seeds; their spread is not in the interval.

    Raises:
        InputError: there are no queries, or a number of hits is below 0 or above `trials`.
    """
    require(
        np.size(hits) > 0 and bool(np.isin(hits, np.arange(trials + 1)).all()),
        f"hits: found {in_one_line(hits)}, expected numbers of hits, from 0 to {trials}",
    )
    queries = len(hits)
    size = queries * trials + 1
    frequencies = np.bincount(hits, minlength=trials + 1) / queries
    # The transform is fastest at powers of two; there is no mass beyond `size`.
    length = 1 << size.bit_length()
    sums = np.fft.irfft(np.fft.rfft(frequencies, length) ** queries, length)[:size]
    cumulative = np.cumsum(np.maximum(sums, 0))
    low, high = np.searchsorted(cumulative, [0.025, 0.975])
    return Interval(float(low) / (size - 1), float(high) / (size - 1))


@brief
class PrecisionRecall(NamedTuple):
    """Precision and recall of accepting first retrievals by similarity, strictest threshold first.

    Such curves matter for loop closure, where one accepted wrong retrieval can spoil a map.
    """

    thresholds: Float[np.ndarray, " threshold"]
    """Distinct similarities of first retrievals, descending; all at or above one are accepted."""
    precision: Float64[np.ndarray, " threshold"]
    """Share of the accepted queries whose first retrieval is correct."""
    recall: Float64[np.ndarray, " threshold"]
    """Of the queries with a positive, the share whose first retrieval is accepted and correct."""
    average_precision: float
    """Area under the step curve: each gain in recall times the precision there."""
    recall_at_full_precision: float
    """Largest recall at a precision of 1; 0 if no threshold has this precision."""


def accepted(
    similarities: Float[np.ndarray, " q"], right: Bool[np.ndarray, " q"]
) -> tuple[Float[np.ndarray, " q"], Int64[np.ndarray, " t"], Int64[np.ndarray, " t"]]:
    """Count accepted queries at each threshold on the similarity of their first retrieval.

    Args:
        similarities: similarities of the first retrievals.
        right: which first retrievals are correct.

    Returns:
        The similarities in descending order. Then, for each distinct similarity as the threshold,
        the index there of the last accepted query, and how many accepted queries are correct.

    Raises:
        InputError: a similarity is NaN.
    """
    require(not np.isnan(similarities).any(), "similarities: found NaN, expected numbers")
    order = np.argsort(-similarities, kind="stable")
    ordered = similarities[order]
    last = np.flatnonzero(np.append(ordered[1:] != ordered[:-1], True))
    return ordered, last, np.cumsum(right[order])[last]


def precision_recall(
    indices: Int[np.ndarray, "q k"],
    similarities: Float[np.ndarray, "q k"],
    positives: Sequence[Int[np.ndarray, " _"]],
) -> PrecisionRecall | None:
    """Compute precision and recall over thresholds on the first retrievals' similarity.

    This is the single-best-match evaluation of Schubert et al. 2024, "Visual Place Recognition: A
    Tutorial", at every possible threshold. Queries of equal similarity are accepted together.
    Accepting a query without positives is always wrong. The recall here leaves such queries out; if
    there are any, its last value is therefore above Recall@1, which is over all queries.

    Args:
        indices: database indices of each query's neighbours, best first; only the first counts.
        similarities: similarities of `indices`.
        positives: correct database indices of each query, possibly none.

    Returns:
        The curve, or None if no query has a positive, since recall is then undefined.

    Raises:
        InputError: a similarity is NaN, or `right_retrievals` raises it.
    """
    right = right_retrievals(indices[:, :1], positives)[:, 0]
    answerable = sum(np.size(wanted) > 0 for wanted in positives)
    if not answerable:
        return None
    ordered, last, accepted_right = accepted(similarities[:, 0], right)
    precision = accepted_right / (last + 1)
    recall = accepted_right / answerable
    return PrecisionRecall(
        thresholds=ordered[last],
        precision=precision,
        recall=recall,
        average_precision=float(np.diff(recall, prepend=0) @ precision),
        recall_at_full_precision=float(recall[precision == 1].max(initial=0)),
    )
