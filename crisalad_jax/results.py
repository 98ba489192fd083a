"""What an evaluation found under each grouping, as a table for the terminal and as JSON."""

import statistics
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int
from rich.table import Table
from rich.text import Text

from crisalad_jax.groupings import Grouping
from crisalad_jax.retrieval import Neighbours
from crisalad_jax.scores import (
    Interval,
    PrecisionRecall,
    bootstrap_interval,
    precision_recall,
    recalls,
    right_retrievals,
)

ANY = "any"
"""The grouping of a model whose descriptors depend on no batch."""


class Scores(NamedTuple):
    """What a ranking is worth, or how that spreads over rankings."""

    recalls: Mapping[int, float]
    """Recall@K as a fraction, by K."""
    average_precision: float | None
    """See `PrecisionRecall`; None where no query has a positive."""
    recall_at_full_precision: float | None
    """Likewise."""


class GroupingResult(NamedTuple):
    """A benchmark under one grouping."""

    grouping: str
    """What `Grouping.parse` reads, or `any` of a model whose descriptors depend on no batch."""
    recalls: Mapping[int, float]
    """Recall@K as a fraction, by K: the mean over the seeds."""
    neighbours: Neighbours
    """The nearest database images of every query, best first: those of the first seed."""
    intervals: Mapping[int, Interval] = MappingProxyType({})
    """95 % of Recall@K, by K, over the queries: see `scores.bootstrap_interval`."""
    query_share: float | None = None
    """The share of same-place images among the others that a query looked at, the mean over queries
    and seeds; None where none looked at another."""
    database_share: float | None = None
    """The same of the database images."""
    precision_recall: PrecisionRecall | None = None
    """The curve of the first seed; None where no query has a positive."""
    average_precision: float | None = None
    """The mean over the seeds, as is the next; None where no query has a positive."""
    recall_at_full_precision: float | None = None
    spread: Scores | None = None
    """The sample standard deviation over the seeds; None of fewer than two."""
    by_seed: Mapping[int, Scores] = MappingProxyType({})
    """Each shuffle's scores by the seed that, alone, repeats it; empty where nothing is random."""
    rerank: str | None = None
    """What put the first retrievals in their order, as `reranking.parse_reranking` reads it; the
    similarities of these are its scores. None is the first stage."""

    @property
    def label(self) -> str:
        """A name that no other result of an evaluation has."""
        return self.grouping if self.rerank is None else f"{self.grouping} + {self.rerank}"


def summarise(
    grouping: str,
    rankings: Mapping[int, Neighbours],
    positives: Sequence[Int[np.ndarray, " _"]],
    ks: Sequence[int],
    *,
    query_share: float | None,
    database_share: float | None,
    is_random: bool,
    rerank: str | None = None,
) -> GroupingResult:
    """The result of one grouping.

    Args:
        grouping: its name.
        rankings: seed -> neighbours; one ranking where nothing is random.
        positives: the database indices that are right for each query.
        ks: the values of K.
        query_share: as in `GroupingResult`.
        database_share: likewise.
        is_random: whether the seeds mean anything.
        rerank: as in `GroupingResult`.

    Raises:
        InputError: what `recalls` raises.
    """
    first = next(iter(rankings.values()))
    rights = [right_retrievals(each.indices, positives) for each in rankings.values()]
    hits = {k: np.sum([right[:, :k].any(axis=1) for right in rights], axis=0) for k in ks}
    curves = [precision_recall(*each, positives) for each in rankings.values()]
    scores = [
        Scores(
            recalls(each.indices, positives, ks),
            None if curve is None else curve.average_precision,
            None if curve is None else curve.recall_at_full_precision,
        )
        for each, curve in zip(rankings.values(), curves, strict=True)
    ]
    mean = _over(scores, statistics.mean)
    return GroupingResult(
        grouping,
        mean.recalls,
        first,
        intervals={k: bootstrap_interval(hits[k], trials=len(rights)) for k in ks},
        query_share=query_share,
        database_share=database_share,
        precision_recall=curves[0],
        average_precision=mean.average_precision,
        recall_at_full_precision=mean.recall_at_full_precision,
        spread=_over(scores, statistics.stdev) if len(scores) > 1 else None,
        by_seed=dict(zip(rankings, scores, strict=True)) if is_random else {},
        rerank=rerank,
    )


def _over(scores: Sequence[Scores], combine: Callable[[Sequence[float]], float]) -> Scores:
    """A statistic of each of the scores."""
    numbers = [(each.average_precision, each.recall_at_full_precision) for each in scores]
    return Scores(
        {k: combine([each.recalls[k] for each in scores]) for k in scores[0].recalls},
        *(
            None if None in column else combine([x for x in column if x is not None])
            for column in zip(*numbers, strict=True)
        ),
    )


def grouping_table(results: Sequence[GroupingResult]) -> Table:
    """A table for the terminal, all numbers in percent, of about 97 columns.

    Below each recall stands its interval, and behind a mean over shuffles their spread.
    """
    table = Table(show_lines=True)
    table.add_column("queries/\ndatabase", no_wrap=True)
    recall_names = [f"R@{k}\n95 %" for k in results[0].recalls]
    for name in ("same place\nq / db", *recall_names, "AP", "R at\n100 % P"):
        table.add_column(name, justify="right", overflow="fold")
    for result in results:
        spread = result.spread or _NO_SPREAD
        recall_cells = (
            f"{_or_dash(value)}{_spread(spread.recalls.get(k))}\n"
            f"{_or_dash(result.intervals[k].low)}-{_or_dash(result.intervals[k].high)}"
            for k, value in result.recalls.items()
        )
        cells = (
            result.grouping + (f"\n+ {result.rerank}" if result.rerank else ""),
            f"{_or_dash(result.query_share)} / {_or_dash(result.database_share)}",
            *recall_cells,
            f"{_or_dash(result.average_precision)}\n{_spread(spread.average_precision)}",
            f"{_or_dash(result.recall_at_full_precision)}\n"
            f"{_spread(spread.recall_at_full_precision)}",
        )
        table.add_row(*map(Text, cells))
    return table


_NO_SPREAD = Scores({}, None, None)


def percent(fraction: float) -> str:
    """A fraction in percent, with one decimal."""
    return f"{100 * fraction:.1f}"


def _or_dash(fraction: float | None) -> str:
    return "-" if fraction is None else percent(fraction)


def _spread(fraction: float | None) -> str:
    return "" if fraction is None else f" ±{percent(fraction)}"


def to_json(result: GroupingResult) -> dict[str, Any]:
    """All of a result but the neighbours, as JSON values; recalls and shares are fractions."""
    sides = (ANY, ANY)
    if result.grouping != ANY:
        grouping = Grouping.parse(result.grouping)
        sides = grouping.queries, grouping.database
    curve = result.precision_recall
    return {
        "grouping": result.grouping,
        "rerank": result.rerank,
        "queries": sides[0],
        "database": sides[1],
        "same_place": {"queries": result.query_share, "database": result.database_share},
        **_scores_json(
            Scores(result.recalls, result.average_precision, result.recall_at_full_precision)
        ),
        "intervals": {f"R@{k}": list(ends) for k, ends in result.intervals.items()},
        "spread": None if result.spread is None else _scores_json(result.spread),
        "by_seed": {str(seed): _scores_json(each) for seed, each in result.by_seed.items()},
        "precision_recall": None
        if curve is None
        else {
            name: getattr(curve, name).tolist() for name in ("thresholds", "precision", "recall")
        },
    }


def _scores_json(scores: Scores) -> dict[str, Any]:
    return scores._asdict() | {"recalls": {f"R@{k}": v for k, v in scores.recalls.items()}}
