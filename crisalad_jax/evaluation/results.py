"""Results of an evaluation under each grouping, and their form in JSON."""

import statistics
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.evaluation.difference import Difference, paired_difference
from crisalad_jax.evaluation.metrics import (
    Interval,
    PrecisionRecall,
    bootstrap_interval,
    precision_recall,
    recalls,
    right_retrievals,
)
from crisalad_jax.evaluation.operating_point import OperatingPoint, operating_point
from crisalad_jax.evaluation.operating_point import to_json as point_json
from crisalad_jax.retrieval.grouping import Grouping
from crisalad_jax.retrieval.neighbours import Neighbours

ANY = "any"
"""Grouping of a model whose descriptors do not depend on the batch."""


class Scores(NamedTuple):
    """Scores of a ranking of all queries, or their standard deviation over several rankings."""

    recalls: Mapping[int, float]
    """Recall@K as a fraction, by K."""
    average_precision: float | None
    """Area under the curve of `PrecisionRecall`; None if no query has a positive."""
    recall_at_full_precision: float | None
    """Largest recall at a precision of 1; None if no query has a positive."""


@brief
class Skipped(NamedTuple):
    """The unreadable images that an evaluation left out, by their indices in the benchmark."""

    queries: tuple[int, ...] = ()
    database: tuple[int, ...] = ()

    def rest_of(self, benchmark: Benchmark) -> Benchmark:
        """Return the benchmark without the skipped images; indices in the results refer to it."""
        queries = np.ones(len(benchmark.queries), bool)
        database = np.ones(len(benchmark.database), bool)
        queries[list(self.queries)] = database[list(self.database)] = False
        return benchmark.of_readable(queries, database)


@brief
class GroupingResult(NamedTuple):
    """The result on a benchmark under one grouping."""

    grouping: str
    """Text that `Grouping.parse` reads; `any` if descriptors do not depend on the batch."""
    recalls: Mapping[int, float]
    """Recall@K as a fraction, by K: the mean over the seeds."""
    neighbours: Neighbours
    """The nearest database images of every query, best first, for the first seed. If images were
    `skipped`, both sides are numbered without them, as in `skipped.rest_of(benchmark)`."""
    intervals: Mapping[int, Interval] = MappingProxyType({})
    """95 % intervals of Recall@K over the queries, by K: see `metrics.bootstrap_interval`."""
    query_share: float | None = None
    """Share of same-place images among the others that a query attends to: the mean over queries
    and seeds; None if no query attends to another."""
    database_share: float | None = None
    """Like `query_share`, for the images that database images attend to."""
    mirrored_share: float | None = None
    """How closely a query's batch mirrors that of its correct answer (`leakage.mirrored_share`)."""
    over_single: Difference | None = None
    """Recall@1 minus that of grouping `single`; None for `single` itself, or if it was not run."""
    precision_recall: PrecisionRecall | None = None
    """The curve of the first seed; None if no query has a positive."""
    average_precision: float | None = None
    """As in `Scores`, the mean over the seeds; None if no query has a positive."""
    recall_at_full_precision: float | None = None
    """As in `Scores`, the mean over the seeds; None if no query has a positive."""
    spread: Scores | None = None
    """Sample standard deviations over the seeds; None with fewer than two seeds."""
    by_seed: Mapping[int, Scores] = MappingProxyType({})
    """Scores of each shuffle, by the seed that reproduces it; empty if nothing is random."""
    firsts: Bool[np.ndarray, "seed q"] | None = None
    """Whether the first retrieval was correct, for each seed and query."""
    rerank: str | None = None
    """The second stage, as `reranking.parse_reranking` reads it; its scores replace the
    similarities of the retrievals that it re-ranked. None means no second stage."""
    skipped: Skipped = Skipped()
    """The unreadable images that were left out, the same under every grouping."""
    operating_point: OperatingPoint | None = None
    """Outcome at the requested precision, for the first seed; None unless requested."""

    @property
    def label(self) -> str:
        """Name that is unique among the results of an evaluation."""
        return self.grouping if self.rerank is None else f"{self.grouping} + {self.rerank}"


def summarise(
    grouping: str,
    rankings: Mapping[int, Neighbours],
    positives: Sequence[Int[np.ndarray, " _"]],
    ks: Sequence[int],
    *,
    is_random: bool,
    precision: float | None = None,
    **known: Any,
) -> GroupingResult:
    """Make the result of one grouping from its rankings.

    Args:
        grouping: name of the grouping.
        rankings: the neighbours of all queries, by seed; only one if nothing is random.
        positives: correct database indices of each query.
        ks: the values of K.
        is_random: whether the rankings differ between seeds.
        precision: precision of the operating point; None for no operating point.
        **known: other fields of `GroupingResult`, such as `query_share`.

    Raises:
        InputError: there are no queries, a similarity is NaN, or a K or `precision` is invalid.
    """
    first = next(iter(rankings.values()))
    rights = [right_retrievals(each.indices, positives) for each in rankings.values()]
    hits = {k: np.sum([right[:, :k].any(axis=1) for right in rights], axis=0) for k in ks}
    curves = [precision_recall(*each, positives) for each in rankings.values()]
    scores = [
        Scores(
            recalls(each.indices, positives, ks),
            *(getattr(curve, name, None) for name in Scores._fields[1:]),
        )
        for each, curve in zip(rankings.values(), curves, strict=True)
    ]
    mean = _over(scores, statistics.mean)
    return GroupingResult(
        grouping,
        neighbours=first,
        **mean._asdict(),
        intervals={k: bootstrap_interval(hits[k], trials=len(rights)) for k in ks},
        precision_recall=curves[0],
        spread=_over(scores, statistics.stdev) if len(scores) > 1 else None,
        by_seed=dict(zip(rankings, scores, strict=True)) if is_random else {},
        firsts=np.array([right[:, 0] for right in rights]),
        operating_point=None
        if precision is None
        else operating_point(*first, positives, precision),
        **known,
    )


def over_single(results: Sequence[GroupingResult]) -> list[GroupingResult]:
    """Return results with `over_single` set, relative to `single` with the same second stage."""
    alone = {each.rerank: each.firsts for each in results if each.grouping == "single"}

    def difference(result: GroupingResult) -> Difference | None:
        reference = alone.get(result.rerank)
        if result.firsts is None or reference is None or result.grouping == "single":
            return None
        return paired_difference(result.firsts, reference, same_seeds=False)

    return [each._replace(over_single=difference(each)) for each in results]


def _over(scores: Sequence[Scores], combine: Callable[[Sequence[float]], float]) -> Scores:
    """Apply a statistic over rankings to each of the scores."""
    numbers = [(each.average_precision, each.recall_at_full_precision) for each in scores]
    return Scores(
        {k: combine([each.recalls[k] for each in scores]) for k in scores[0].recalls},
        *(
            None if None in column else combine([x for x in column if x is not None])
            for column in zip(*numbers, strict=True)
        ),
    )


def percent(fraction: float) -> str:
    """Format a fraction in percent, with one decimal."""
    return f"{100 * fraction:.1f}"


def to_json(result: GroupingResult) -> dict[str, Any]:
    """Convert a result, without its neighbours, to JSON; recalls and shares are fractions."""
    sides, size, gain = (ANY, ANY), None, result.over_single
    if result.grouping != ANY:
        grouping = Grouping.parse(result.grouping)
        sides, size = (grouping.queries, grouping.database), grouping.batch_size
    curve, point = result.precision_recall, result.operating_point
    return {
        "grouping": result.grouping,
        "rerank": result.rerank,
        "queries": sides[0],
        "database": sides[1],
        "batch_size": size,
        "same_place": {"queries": result.query_share, "database": result.database_share},
        "mirrored": result.mirrored_share,
        "over_single": gain and {"R@1": gain.mean, "interval": list(gain.interval)},
        **_scores_json(Scores(*(getattr(result, name) for name in Scores._fields))),
        "intervals": {f"R@{k}": list(ends) for k, ends in result.intervals.items()},
        "spread": result.spread and _scores_json(result.spread),
        "by_seed": {str(seed): _scores_json(each) for seed, each in result.by_seed.items()},
        "precision_recall": curve
        and {name: getattr(curve, name).tolist() for name in ("thresholds", "precision", "recall")},
    } | ({} if point is None else {"operating_point": point_json(point)})


def _scores_json(scores: Scores) -> dict[str, Any]:
    return scores._asdict() | {"recalls": {f"R@{k}": v for k, v in scores.recalls.items()}}
