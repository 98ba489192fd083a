"""Tables that the commands print."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from crisalad_jax.checkpoints.cache import is_cached
from crisalad_jax.checkpoints.published import GITHUB, Published
from crisalad_jax.data.sets import CheckedPart, PublishedSet
from crisalad_jax.evaluation.operating_point import OperatingPoint
from crisalad_jax.evaluation.results import GroupingResult, Scores, percent
from crisalad_jax.experiments.tables import NOTHING, Cell, Table
from crisalad_jax.nn.costs import PartCost
from crisalad_jax.training.summary import ModelSummary
from crisalad_jax.utils.output import printable


def grouping_table(results: Sequence[GroupingResult]) -> Table:
    """Make a table of results in percent, in the terminal about 85 columns wide.

    Each recall is above its interval, and a mean over shuffles before their spread.
    """
    recall_names = [f"R@{k}\n95 %" for k in results[0].recalls]
    names = (*recall_names, "AP", "R at\n100 % P")
    rows = []
    for result in results:
        spread = result.spread or _NO_SPREAD
        recall_cells = (
            Cell(
                f"{_or_dash(value)}{_spread(spread.recalls.get(k))}",
                f"{_or_dash(result.intervals[k].low)}-{_or_dash(result.intervals[k].high)}",
            )
            for k, value in result.recalls.items()
        )
        full = result.recall_at_full_precision
        rows.append(
            [
                Cell(result.grouping, f"+ {result.rerank}" if result.rerank else ""),
                *recall_cells,
                Cell(_or_dash(result.average_precision), _spread(spread.average_precision)),
                Cell(_or_dash(full), _spread(spread.recall_at_full_precision)),
            ]
        )
    return Table(["queries/\ndatabase", *names], rows, stacked=True)


def leakage_table(results: Sequence[GroupingResult]) -> Table:
    """Make a table of what groupings give over images described alone, and of what they leak."""
    rows = []
    for result in results:
        gain = result.over_single
        points = Cell(NOTHING)
        if gain is not None:
            points = Cell(_points(gain.mean), " to ".join(map(_points, gain.interval)))
        rows.append(
            [
                Cell(result.grouping, f"+ {result.rerank}" if result.rerank else ""),
                Cell(_or_dash(result.recalls.get(1))),
                points,
                Cell(f"{_or_dash(result.query_share)} / {_or_dash(result.database_share)}"),
                Cell(_or_dash(result.mirrored_share)),
            ]
        )
    names = ("R@1", "points over\nsingle, 95 %", "same place\nq / db", "mirrored")
    return Table(["queries/\ndatabase", *names], rows, stacked=True)


def _points(difference: float) -> str:
    return f"{100 * difference:+.1f}"


def points_table(points: Mapping[str, OperatingPoint], asked: str = "similarity") -> Table:
    """Make a table of operating points by name: what to ask for, and what that leaves."""
    names = (
        f"{asked}\nto ask for",
        "precision\n95 % sure of",
        "recall left,\nof all queries",
        "right of\nanswered",
        "unknown places\nanswered",
    )
    rows = []
    for name, point in points.items():
        grouping, plus, rerank = name.partition(" + ")
        left = Cell(percent(point.recall), f"{point.right} of {point.queries}")
        rows.append(
            [
                Cell(grouping, f"+ {rerank}" if plus else ""),
                Cell(f"{point.min_similarity:.9g}" if point.reached else "none"),
                Cell(percent(point.precision), percent(point.lower_bound)),
                left if point.reached else Cell(NOTHING),
                Cell(f"{point.right} of {point.answered}"),
                Cell(f"{point.unknown_answered} of {point.unknown}"),
            ]
        )
    return Table(["queries/\ndatabase", *names], rows, stacked=True)


_NO_SPREAD = Scores({}, None, None)


def _or_dash(fraction: float | None) -> str:
    return NOTHING if fraction is None else percent(fraction)


def _spread(fraction: float | None) -> str:
    return "" if fraction is None else f" ±{percent(fraction)}"


def summary_table(summary: ModelSummary, name: str) -> Table:
    """Make a table of a model's parts; `name` is the model's."""
    height, width = summary.image_size
    whole = PartCost("all", *(sum(each) for each in list(zip(*summary.parts, strict=True))[1:]))
    rows = [
        [Cell(cost.part), Cell(f"{cost.parameters:,}"), Cell(f"{cost.macs:,}")]
        for cost in (*summary.parts, whole)
    ]
    headers = ["part", "parameters", "multiply-accumulates an image"]
    return Table(headers, rows, title=printable(f"{name} at {height} x {width}"), summed=True)


def models_table(models: Sequence[Published]) -> Table:
    """Make a table of published models; those in the cache have a star."""
    rows = [
        (
            f"{model.name} *" if is_cached(model) else model.name,
            model.licence.name,
            model.images,
            model.repository.removeprefix(GITHUB),
            f"{model.descriptor:,}",
            f"{model.parameters / 1e6:,.1f} M",
        )
        for model in models
    ]
    headers = ["name", "licence", "images", "GitHub", "descriptor", "parameters"]
    return Table(headers, [list(map(Cell, row)) for row in rows], labels=4)


def sets_table(sets: Sequence[PublishedSet]) -> Table:
    """Make a table of public data sets."""
    rows = []
    for each in sets:
        counts = [
            " + ".join(NOTHING if count is None else f"{count:,}" for count in numbers)
            for part in each.parts
            if any(numbers := (part.database, part.queries))
        ]
        size = "not known" if each.gigabytes is None else f"{each.gigabytes} GB"
        fetched = "fetch" if each.is_fetched else "by hand"
        licence = each.licence or "not known"
        rows.append([each.name, each.title, fetched, each.host, licence, size, "; ".join(counts)])
    headers = ["name", "set", "how", "where", "licence", "size", "database + queries"]
    return Table(headers, [list(map(Cell, row)) for row in rows], labels=5)


def checked_table(parts: Sequence[CheckedPart]) -> Table:
    """Make a table of what a folder is, a row for each part."""
    rows = []
    for part in parts:
        counts = [
            NOTHING if count is None else f"{count:,}" for count in (part.database, part.queries)
        ]
        verdict = (
            "does not match"
            if part.problem
            else "as published"
            if part.known
            else "nothing to compare"
        )
        rows.append([Cell(each) for each in (part.name, part.known or NOTHING, verdict, *counts)])
    headers = ["part", "published as", "verdict", "images", "queries or places"]
    return Table(headers, rows, labels=2 + 1)


_MOST = 10
"""Most rows of a fact that are listed."""


def fact_lines(facts: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each fact, and one for each of the first rows of a list of objects."""
    width = max(map(len, facts))
    for name, value in facts.items():
        is_table = isinstance(value, list) and all(isinstance(each, dict) for each in value)
        rows = value if is_table else [value]
        more = [f"and {len(rows) - _MOST} more"] if len(rows) > _MOST else []
        for number, row in enumerate([*rows[:_MOST], *more]):
            yield f"{'' if number else name:<{width}}  {_words(row)}"


def _words(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_words(each)}" for name, each in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_words, value))
    if value is None:
        return "not said"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.9g}"
    return f"{value:,}" if isinstance(value, int) else value or "-"
