"""A comparison as tables: for the terminal, as Markdown, as CSV and as JSON."""

import csv
import io
import pathlib
from collections.abc import Sequence
from typing import Any

from rich.table import Table
from rich.text import Text

from crisalad_jax.evaluation.results import percent
from crisalad_jax.experiments.comparison.ablation import AdapterCost
from crisalad_jax.experiments.comparison.paired import Difference
from crisalad_jax.experiments.comparison.summary import KS, Recall, Row, Spread, Summary
from crisalad_jax.experiments.report.page import ESCAPED
from crisalad_jax.experiments.report.tables import no_formula
from crisalad_jax.utils.files import atomic_path, split_markers, write_json

NOTHING = "-"


def title_of(row: Row, rows: Sequence[Row]) -> str:
    """Return a row's first label, with its grouping if the method has several."""
    several = sum(other.name == row.name for other in rows) > 1
    return f"{row.labels[0]}, {row.grouping}" if several else row.labels[0]


def described(row: Row) -> list[str]:
    """Return a row's labels after the first, for a reader: a hyphen stands where there is none."""
    return [label or NOTHING for label in row.labels[1:]]


def mean_words(recall: Recall) -> str:
    """Format the mean, and the standard deviation if there is one."""
    spread = "" if recall.spread is None else f" ± {percent(recall.spread)}"
    return percent(recall.mean) + spread


def interval_words(recall: Recall) -> str:
    """Format both ends of the interval."""
    return f"{percent(recall.interval.low)}-{percent(recall.interval.high)}"


def difference_words(difference: Difference) -> str:
    """Format a difference in points, its interval and what that decides."""
    low, high = map(points, difference.interval)
    return f"{points(difference.mean)} ({low} to {high}), {difference.verdict}"


def points(fraction: float) -> str:
    """Format a difference in percentage points, with its sign."""
    # Adding 0 makes a rounded -0.0 positive.
    return f"{round(100 * fraction, 1) + 0:+.1f}"


def costs_of(row: Row) -> list[str]:
    """Format a row's costs, in the columns of `COSTS`."""
    speed = f"{row.speed:.2f} x"
    if row.images_per_second is not None:
        speed = f"{row.images_per_second:.0f}"
    training = NOTHING
    if row.images_per_second is None:
        if row.training is not None:
            training = ratio_words(row.training)
    elif row.training_seconds is not None:
        minutes = (f"{seconds / 60:.1f}" for seconds in row.training_seconds)
        training = "{} min ({} to {})".format(*minutes)
    trained = NOTHING if row.trained is None else f"{row.trained:,}"
    return [f"{row.dimension:,}", speed, f"{row.parameters:,}", trained, training]


def ratio_words(times: tuple[float, float, float]) -> str:
    """Format the median, the least and the most of ratios."""
    return "{:.2f} x ({:.2f} to {:.2f})".format(*times)


COSTS = ("dimension", "images/s", "parameters", "trained", "training time")


def recall_table(summary: Summary) -> Table:
    """Make the terminal's table of recalls: R@1, R@5 and R@10 below each other in each cell."""
    table = Table(show_lines=True)
    for header in summary.headers:
        table.add_column(header, overflow="fold")
    table.add_column("R@", justify="right")
    for name in summary.sets:
        table.add_column(f"{name}\nmean ± sd, 95 %", no_wrap=True, justify="right")
    for row in summary.rows:
        cells = [title_of(row, summary.rows), *described(row), "\n".join(map(str, KS))]
        for recalls in row.recalls.values():
            lines = (f"{mean_words(r)}  {interval_words(r):>10}" for r in recalls.values())
            cells.append("\n".join(lines))
        table.add_row(*map(Text, cells))
    return table


def compared_rows(summary: Summary) -> list[tuple[Row, dict[str, Sequence[Difference]]]]:
    """Return the rows that have differences, with those of each set by K."""
    return [
        (row, {name: list(by_k.values()) for name, by_k in row.differences.items()})
        for row in summary.rows
        if row.differences is not None
    ]


def title_of_reference(summary: Summary) -> str:
    """Return the label of the row that the others are compared with."""
    return next(row.labels[0] for row in summary.rows if row.name == summary.reference)


def difference_table(summary: Summary) -> Table:
    """Make the terminal's table of differences to the reference."""
    table = Table(f"{summary.headers[0]}, less {title_of_reference(summary)}", show_lines=True)
    table.add_column("R@", justify="right")
    for name in summary.sets:
        table.add_column(f"{name}\nΔ (95 %)", no_wrap=True)
    for row, differences in compared_rows(summary):
        lines = ("\n".join(map(difference_words, each)) for each in differences.values())
        ks = "\n".join(map(str, KS))
        table.add_row(*map(Text, [title_of(row, summary.rows), ks, *lines]))
    return table


def cost_table(summary: Summary) -> Table:
    """Make the terminal's table of each model's costs."""
    table = Table(summary.headers[0])
    for name in COSTS:
        table.add_column(name, justify="right")
    for row in one_of_each(summary):
        table.add_row(*map(Text, [row.labels[0], *costs_of(row)]))
    return table


def one_of_each(summary: Summary) -> list[Row]:
    """Choose one row of each name, because a model's costs do not depend on the grouping."""
    return list({row.name: row for row in reversed(summary.rows)}.values())[::-1]


ADAPTERS = (
    "adapter",
    "parameters, paper",
    "parameters here",
    "MACs, paper (M)",
    "FLOPs, paper (M)",
    "true MACs (M)",
    "time",
)


def adapter_cells(cost: AdapterCost) -> list[str]:
    """Format the cost of an adapter, in the columns of `ADAPTERS`."""
    time = NOTHING if cost.time is None else ratio_words(cost.time)
    # The only figure of the paper that no way of counting gives.
    printed = " (printed: 2,356,080)" if cost.adapter == "mlp" else ""
    return [
        cost.adapter,
        f"{cost.paper_parameters:,}{printed}",
        f"{cost.parameters:,}",
        f"{cost.paper_macs / 1e6:.3f}",
        f"{2 * cost.paper_macs / 1e6:.3f}",
        f"{cost.macs / 1e6:.1f}",
        time,
    ]


def adapter_table(costs: Sequence[AdapterCost]) -> Table:
    """Make Table 3 for the terminal."""
    table = Table("adapter")
    for name in ADAPTERS[1:]:
        table.add_column(name, justify="right")
    for cost in costs:
        table.add_row(*map(Text, adapter_cells(cost)))
    return table


def terminal_tables(summary: Summary) -> list[Table]:
    """Make all tables of a comparison for the terminal."""
    tables = [recall_table(summary), cost_table(summary)]
    if compared_rows(summary):
        tables.insert(1, difference_table(summary))
    return [*tables, adapter_table(summary.adapters)] if summary.adapters else tables


def markdown(summary: Summary) -> str:
    """Write all tables and notes as Markdown, in the shape of the paper's Table 1, or 2 and 3."""
    header = [*summary.headers, COSTS[0]]
    header += [f"{name} R@{k}" for name in summary.sets for k in KS] + list(COSTS[1:])
    rows = []
    for row in summary.rows:
        costs = costs_of(row)
        recalls = (r for by_k in row.recalls.values() for r in by_k.values())
        cells = [f"{mean_words(r)} ({interval_words(r)})" for r in recalls]
        title = title_of(row, summary.rows)
        rows.append([title, *described(row), costs[0], *cells, *costs[1:]])
    text = _markdown(header, rows, labels=len(summary.headers))
    if compared := compared_rows(summary):
        header = [f"{summary.headers[0]}, less {title_of_reference(summary)}"]
        header += [f"{name} Δ R@{k}" for name in summary.sets for k in KS]
        rows = [
            [title_of(row, summary.rows)]
            + [difference_words(each) for by_k in differences.values() for each in by_k]
            for row, differences in compared
        ]
        text += "\n" + _markdown(header, rows, labels=1)
    if summary.adapters:
        text += "\n" + _markdown(ADAPTERS, list(map(adapter_cells, summary.adapters)), labels=1)
    return text + "".join(f"\n{note}\n" for note in summary.notes)


def _markdown(header: Sequence[str], rows: list[list[str]], *, labels: int) -> str:
    rule = ["---"] * labels + ["---:"] * (len(header) - labels)
    escaped = [[cell.replace("|", r"\|") for cell in cells] for cells in (header, rule, *rows)]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in escaped)


_COLUMNS = (
    *("name", "grouping", "set", "k", "recall", "standard_deviation", "low", "high", "seeds"),
    *("dimension", "speed", "images_per_second", "parameters", "trained", "training"),
    *("training_least", "training_most", "training_seconds", "training_seconds_least"),
    *("training_seconds_most", "difference", "difference_low", "difference_high", "verdict"),
)


_NO_SPREAD = (None,) * 3


def comma_separated(summary: Summary) -> str:
    """Write a CSV line for each row, set and K: recalls as fractions, missing values empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    labels = [header.replace(" ", "_") for header in summary.headers]
    writer.writerow([*labels, *_COLUMNS])
    for row in summary.rows:
        costs = (row.dimension, row.speed, row.images_per_second, row.parameters)
        costs += (row.trained, *(row.training or _NO_SPREAD), *(_absolute(row) or _NO_SPREAD))
        for name, recalls in row.recalls.items():
            for k, recall in recalls.items():
                difference = None if row.differences is None else row.differences[name][k]
                if difference is None:
                    differs = (None,) * 4
                else:
                    differs = (difference.mean, *difference.interval, difference.verdict)
                values = (recall.mean, recall.spread, *recall.interval, len(recall.by_seed))
                texts = map(no_formula, (*row.labels, row.name, row.grouping, name))
                writer.writerow([*texts, k, *values, *costs, *differs])
    return text.getvalue()


def _absolute(row: Row) -> Spread | None:
    """Return the seconds of training if they are comparable, which they are not on a CPU."""
    return None if row.images_per_second is None else row.training_seconds


def as_json(summary: Summary) -> dict[str, Any]:
    """Put everything into JSON values; recalls are fractions."""
    rows = [
        row._asdict()
        | {
            "recalls": {
                name: {
                    f"R@{k}": recall._asdict() | {"interval": list(recall.interval)}
                    for k, recall in recalls.items()
                }
                for name, recalls in row.recalls.items()
            },
            "differences": None
            if row.differences is None
            else {
                name: {
                    f"R@{k}": {
                        "mean": each.mean,
                        "interval": list(each.interval),
                        "verdict": each.verdict,
                    }
                    for k, each in by_k.items()
                }
                for name, by_k in row.differences.items()
            },
        }
        for row in summary.rows
    ]
    return {
        "settings": summary.settings,
        "sets": {name: each.name for name, each in summary.sets.items()},
        "reference": summary.reference,
        "rows": rows,
        "adapters": [cost._asdict() for cost in summary.adapters],
        "notes": summary.notes,
    }


def write_tables(summary: Summary, out: pathlib.Path) -> None:
    """Write table.md, table.csv and results.json."""
    for name, text in (("table.md", markdown(summary)), ("table.csv", comma_separated(summary))):
        with atomic_path(out / name) as temporary:
            temporary.write_text(text, encoding="utf-8", errors=ESCAPED)
    write_json(out / "results.json", as_json(summary))


def put_in_page(page: pathlib.Path, name: str, text: str) -> None:
    """Put a text between its marks in a page; raises as `files.around`."""
    before, after = split_markers(page, name)
    with atomic_path(page) as temporary:
        whole = f"{before}\n{text}\n{after}"
        temporary.write_text(whole, encoding="utf-8", errors=ESCAPED)
