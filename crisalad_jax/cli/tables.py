"""Tables that the commands print."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.table import Column, Table
from rich.text import Text

from crisalad_jax.checkpoints.cache import is_cached
from crisalad_jax.checkpoints.published import GITHUB, Published
from crisalad_jax.evaluation.operating_point import OperatingPoint
from crisalad_jax.evaluation.results import GroupingResult, Scores, percent
from crisalad_jax.training.summary import ModelSummary
from crisalad_jax.utils.output import printable


def grouping_table(results: Sequence[GroupingResult]) -> Table:
    """Make a table of results for the terminal, in percent, about 97 columns wide.

    Each recall stands above its interval, and a mean over shuffles before their spread.
    """
    recall_names = [f"R@{k}\n95 %" for k in results[0].recalls]
    names = ("same place\nq / db", *recall_names, "AP", "R at\n100 % P")
    table = Table("queries/\ndatabase", *map(_right, names), show_lines=True)
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


def points_table(points: Mapping[str, OperatingPoint]) -> Table:
    """Make a table of operating points by name: the similarity to ask for, and what that leaves."""
    names = (
        "similarity\nto ask for",
        "precision\n95 % sure of",
        "recall left,\nof all queries",
        "right of\nanswered",
        "unknown places\nanswered",
    )
    table = Table("queries/\ndatabase", *map(_right, names))
    for name, point in points.items():
        cells = (
            f"{point.min_similarity:.9g}" if point.reached else "none",
            f"{percent(point.precision)}\n{percent(point.lower_bound)}",
            f"{percent(point.recall)}\n{point.right} of {point.queries}" if point.reached else "-",
            f"{point.right} of {point.answered}",
            f"{point.unknown_answered} of {point.unknown}",
        )
        table.add_row(*map(Text, (name.replace(" + ", "\n+ "), *cells)))
    return table


_NO_SPREAD = Scores({}, None, None)


def _or_dash(fraction: float | None) -> str:
    return "-" if fraction is None else percent(fraction)


def _spread(fraction: float | None) -> str:
    return "" if fraction is None else f" ±{percent(fraction)}"


def summary_table(summary: ModelSummary, name: str) -> Table:
    """Make a table of a model's parts for the terminal; `name` is the model's."""
    height, width = summary.image_size
    columns = map(_right, ("parameters", "multiply-accumulates an image"))
    table = Table("part", *columns, title=printable(f"{name} at {height} x {width}"))
    for cost in summary.parts:
        table.add_row(cost.part, f"{cost.parameters:,}", f"{cost.macs:,}")
    table.add_section()
    parameters = sum(cost.parameters for cost in summary.parts)
    table.add_row("all", f"{parameters:,}", f"{sum(cost.macs for cost in summary.parts):,}")
    return table


def models_table(models: Sequence[Published]) -> Table:
    """Make a table of published models for the terminal; those in the cache have a star."""
    table = Table("name", _right("descriptor"), _right("parameters"), "licence", "images", "GitHub")
    for model in models:
        table.add_row(
            f"{model.name} *" if is_cached(model) else model.name,
            f"{model.descriptor:,}",
            f"{model.parameters / 1e6:,.1f} M",
            model.licence.name,
            model.images,
            model.repository.removeprefix(GITHUB),
        )
    return table


def _right(header: str) -> Column:
    return Column(header, justify="right")


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
