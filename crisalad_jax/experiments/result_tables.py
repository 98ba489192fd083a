"""Tables of an evaluation, for the terminal and for its page."""

from collections.abc import Mapping, Sequence

from crisalad_jax.evaluation.operating_point import OperatingPoint
from crisalad_jax.evaluation.results import ANY, GroupingResult, Scores, percent
from crisalad_jax.experiments.tables import NOTHING, Cell, Table


def result_tables(results: Sequence[GroupingResult]) -> list[Table]:
    """Make the tables of an evaluation: recalls, and leakage and operating points if measured."""
    tables = [grouping_table(results)]
    if any(each.grouping != ANY for each in results):
        tables.append(leakage_table(results))
    if points := {each.label: each.operating_point for each in results if each.operating_point}:
        tables.append(points_table(points))
    return tables


def grouping_table(results: Sequence[GroupingResult]) -> Table:
    """Make a table of recalls and precisions in percent, about 85 characters wide in the terminal.

    Each recall is above its 95 % interval; a standard deviation follows a mean over shuffles.
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
    """Make a table of what each grouping gains over single-image descriptors, and what it leaks."""
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
    """Make a table of operating points by name; `asked` is what their thresholds apply to."""
    names = (
        f"{asked}\nthreshold",
        "precision,\n95 % bound",
        "recall left,\nof all queries",
        "correct of\nanswered",
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
