"""Tables that the commands print."""

import itertools
from collections.abc import Mapping, Sequence

import rich.box
from rich.table import Table
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


def points_table(points: Mapping[str, OperatingPoint]) -> Table:
    """Make a table of operating points by name: the similarity to ask for, and what that leaves."""
    table = Table()
    table.add_column("queries/\ndatabase", no_wrap=True)
    for name in (
        "similarity\nto ask for",
        "precision\n95 % sure of",
        "recall left,\nof all queries",
        "right of\nanswered",
        "unknown places\nanswered",
    ):
        table.add_column(name, justify="right")
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
    table = Table("part", title=printable(f"{name} at {height} x {width}"))
    table.add_column("parameters", justify="right")
    table.add_column("multiply-accumulates an image", justify="right")
    for cost in summary.parts:
        table.add_row(cost.part, f"{cost.parameters:,}", f"{cost.macs:,}")
    table.add_section()
    parameters = sum(cost.parameters for cost in summary.parts)
    table.add_row("all", f"{parameters:,}", f"{sum(cost.macs for cost in summary.parts):,}")
    return table


def models_table(models: Sequence[Published], width: int | None) -> Table:
    """Make a table of published models for the terminal; those in the cache have a star.

    Args:
        models: its rows.
        width: the terminal's. Columns at the right that it has no room for are left out. None
            leaves out none, for a file or a pipe.

    Returns:
        A table that is printed without wrapping.
    """
    rows = [_model_cells(model) for model in models]
    lengths = (max(map(len, cells)) for cells in zip(MODEL_COLUMNS, *rows, strict=True))
    # One space before the first column, and two after each.
    ends = list(itertools.accumulate((length + 2 for length in lengths), initial=1))
    shown = max(1, sum(width is None or end <= width for end in ends[1:]))
    # Without lines between the columns, longer names fit.
    table = Table(box=rich.box.SIMPLE_HEAD, padding=(0, 1, 0, 0), width=ends[shown])
    for name in MODEL_COLUMNS[:shown]:
        right = name in ("descriptor", "parameters")
        table.add_column(name, no_wrap=True, justify="right" if right else "left")
    for cells in rows:
        table.add_row(*cells[:shown])
    return table


MODEL_COLUMNS = ("name", "descriptor", "parameters", "licence", "images", "on GitHub")


def _model_cells(model: Published) -> tuple[str, ...]:
    """Return what is told of a model, a text for each of `MODEL_COLUMNS`."""
    return (
        f"{model.name} *" if is_cached(model) else model.name,
        f"{model.descriptor:,}",
        f"{model.parameters / 1e6:,.1f} M",
        model.licence.name,
        model.images,
        model.repository.removeprefix(GITHUB),
    )
