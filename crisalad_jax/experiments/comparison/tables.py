"""A comparison as tables: for the terminal, as Markdown, CSV and JSON, and as one HTML page."""

import itertools
import json
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from crisalad_jax.evaluation.difference import Difference
from crisalad_jax.evaluation.results import percent
from crisalad_jax.experiments.comparison.costs import AdapterCost
from crisalad_jax.experiments.comparison.results import KS, Row, Summary
from crisalad_jax.experiments.report.page import PAGE, render
from crisalad_jax.experiments.report.style import (
    COLOURS,
    GREY,
    INK,
    Drawing,
    chart,
    label_axes,
    new_figure,
)
from crisalad_jax.experiments.tables import NOTHING, Cell, Table, write_csv, write_text
from crisalad_jax.utils.files import write_json

_PAGE_TITLES = {"compare": "Methods compared", "ablate": "What each part brings"}


def write_tables(summary: Summary, out: pathlib.Path) -> None:
    """Write table.md, table.csv, results.json, index.html, and a chart recall_N for each set."""
    write_text(out / "table.md", markdown(summary))
    write_csv(out / "table.csv", list(csv_rows(summary)))
    write_json(out / "results.json", as_json(summary))
    charts = [_chart(summary, name, out, number) for number, name in enumerate(summary.sets)]
    context = {
        "title": _PAGE_TITLES[summary.kind],
        "charts": charts,
        "tables": tables_of(summary),
        "settings": json.dumps(summary.settings, indent=2),
    }
    write_text(out / PAGE, render("comparison.html", summary._asdict() | context))


def markdown(summary: Summary) -> str:
    """Return all tables and notes as Markdown."""
    tables = [table.markdown() for table in tables_of(summary).values()]
    return "\n".join([*tables, *(f"{note}\n" for note in summary.notes)])


def tables_of(summary: Summary) -> dict[str, Table]:
    """Make the tables of a comparison, by name; tables without rows are left out."""
    first = summary.headers[0]
    recalls, differences, costs = [], [], {}
    for row in summary.rows:
        title = _title(row, summary.rows)
        labels = (title, *(label or NOTHING for label in row.labels[1:]))
        line: dict[str, str | Cell] = dict(zip(summary.headers, labels, strict=True))
        difference: dict[str, str | Cell] = {f"{first}, less {summary.reference}": title}
        for name, k in itertools.product(summary.sets, KS):
            line[f"{name} R@{k}"] = _recall(row, name, k, summary.rows)
            difference[f"{name} Δ R@{k}"] = _difference(row.recalls[name][k].difference)
        recalls.append(line)
        if any(each.difference for by_k in row.recalls.values() for each in by_k.values()):
            differences.append(difference)
        # A model's costs do not depend on the grouping.
        costs.setdefault(row.name, {first: row.labels[0]} | costs_of(row))
    tables = {
        "recall": _table_of(recalls, labels=len(summary.headers)),
        "differences": _table_of(differences),
        "costs": _table_of(list(costs.values())),
        "adapters": _table_of(list(map(adapter_cells, summary.adapters))),
    }
    return {name: table for name, table in tables.items() if table.rows}


def _table_of(rows: Sequence[Mapping[str, str | Cell]], labels: int = 1) -> Table:
    """Make a table whose headers are the names of the rows' cells."""
    cells = [
        [Cell(each) if isinstance(each, str) else each for each in row.values()] for row in rows
    ]
    return Table(list(rows[0]) if rows else [], cells, labels)


def _title(row: Row, rows: Sequence[Row]) -> str:
    """Return a row's first label, with its grouping if the method has several."""
    several = sum(other.name == row.name for other in rows) > 1
    return f"{row.labels[0]}, {row.grouping}" if several else row.labels[0]


def _recall(row: Row, name: str, k: int, rows: Sequence[Row]) -> Cell:
    """Format a recall with its deviation and interval; the best of its column is marked."""
    recall = row.recalls[name][k]
    spread = "" if recall.spread is None else f"± {percent(recall.spread)}\n"
    note = f"{spread}({percent(recall.interval.low)}-{percent(recall.interval.high)})"
    best = max(each.recalls[name][k].mean for each in rows)
    return Cell(percent(recall.mean), note, "best" if recall.mean == best else "")


def _difference(difference: Difference | None) -> Cell:
    if difference is None:
        return Cell(NOTHING)
    mean, (low, high), verdict = difference
    kind = {"better": "right", "worse": "wrong"}.get(verdict, "")
    return Cell(_points(mean), f"({_points(low)} to {_points(high)})\n{verdict}", kind)


def _points(fraction: float) -> str:
    """Format a difference in percentage points, with its sign."""
    # Adding 0 makes a rounded -0.0 positive.
    return f"{round(100 * fraction, 1) + 0:+.1f}"


def costs_of(row: Row) -> dict[str, str]:
    """Format a row's costs by header; on a CPU, times are relative to the reference's."""
    if row.images_per_second is None:
        speed = f"{row.speed:.2f} x"
        training = NOTHING if row.training is None else _ratios(row.training)
    else:
        speed, training = f"{row.images_per_second:.0f}", NOTHING
        if row.training_seconds is not None:
            minutes = (seconds / 60 for seconds in row.training_seconds)
            training = "{:.1f} min ({:.1f} to {:.1f})".format(*minutes)
    return {
        "dimension": f"{row.dimension:,}",
        "images/s": speed,
        "parameters": f"{row.parameters:,}",
        "trained": NOTHING if row.trained is None else f"{row.trained:,}",
        "training time": training,
    }


def _ratios(times: Sequence[float]) -> str:
    """Format the median, minimum and maximum of ratios."""
    return "{:.2f} x ({:.2f} to {:.2f})".format(*times)


def adapter_cells(cost: AdapterCost) -> dict[str, str]:
    """Format the costs of an adapter as cells, by header; "-" where the paper or run has none."""
    paper = parameters = flops = NOTHING
    if cost.paper_macs is not None:
        paper, flops = (f"{count * cost.paper_macs / 1e6:.3f}" for count in (1, 2))
        # The only figure of the paper that no way of counting reproduces.
        printed = " (printed: 2,356,080)" if cost.adapter == "mlp" else ""
        parameters = f"{cost.paper_parameters:,}{printed}"
    return {
        "adapter": cost.adapter,
        "parameters, paper": parameters,
        "parameters here": f"{cost.parameters:,}",
        "MACs, paper (M)": paper,
        "FLOPs, paper (M)": flops,
        "true MACs (M)": f"{cost.macs / 1e6:.1f}",
        "time of a block": NOTHING if cost.time is None else _ratios(cost.time),
        "memory of a block": NOTHING if cost.memory is None else f"{cost.memory:.2f} x",
    }


def as_json(summary: Summary) -> dict[str, Any]:
    """Convert a summary to JSON values; recalls are fractions, and sets become their names."""
    names = {name: each.name for name, each in summary.sets.items()}
    return _plain(summary) | {"sets": names}


def _plain(value: Any) -> Any:
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {f"R@{key}" if isinstance(key, int) else key: _plain(value[key]) for key in value}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return value


_COLUMNS = (
    *("name", "grouping", "set", "k", "recall", "standard_deviation", "low", "high", "seeds"),
    *("difference", "difference_low", "difference_high", "verdict"),
    *("dimension", "speed", "images_per_second", "parameters", "trained"),
    *("training", "training_least", "training_most"),
    *("training_seconds", "training_seconds_least", "training_seconds_most"),
)


def csv_rows(summary: Summary) -> Iterator[dict[str, Any]]:
    """Yield a line of table.csv for each row, set and K, by column; recalls are fractions."""
    columns, nothing = [*summary.headers, *_COLUMNS], (None,) * 3
    for row in summary.rows:
        costs = (row.dimension, row.speed, row.images_per_second, row.parameters, row.trained)
        times = (*(row.training or nothing), *(row.training_seconds or nothing))
        for name, by_k in row.recalls.items():
            for k, recall in by_k.items():
                names = (*row.labels, row.name, row.grouping, name, k)
                values = (recall.mean, recall.spread, *recall.interval, len(recall.by_seed))
                mean, interval, verdict = recall.difference or (None, (None, None), None)
                line = (*names, *values, mean, *interval, verdict, *costs, *times)
                yield dict(zip(columns, line, strict=True))


def _chart(summary: Summary, name: str, out: pathlib.Path, number: int) -> Drawing:
    """Draw R@1 of all rows on a set: dots for means, lines for intervals, rings for seeds."""
    titles = [_title(row, summary.rows) for row in summary.rows]
    figure = new_figure(0.8 + 0.3 * len(titles))
    axes = figure.add_subplot()
    label_axes(axes, f"R@1 on {name}", "", grid="x")
    for place, row in enumerate(summary.rows):
        recall = row.recalls[name][1]
        colour = COLOURS[0] if row.labels[0] == summary.reference else INK
        low, high = (100 * end for end in recall.interval)
        axes.plot((low, high), (place, place), color=colour, linewidth=1.6, alpha=0.55)
        ring = {"markersize": 4, "markerfacecolor": "none", "markeredgewidth": 0.8}
        for value in recall.by_seed:
            axes.plot(100 * value, place, "o", color=GREY, clip_on=False, **ring)
        axes.plot(100 * recall.mean, place, "o", color=colour, markersize=6, clip_on=False)
    axes.set_yticks(range(len(titles)), titles, fontsize=9)
    axes.set_ylim(len(titles) - 0.5, -0.5)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter("{x:g} %")
    means = "; ".join(
        f"{title} {percent(row.recalls[name][1].mean)} %"
        for title, row in zip(titles, summary.rows, strict=True)
    )
    return chart(figure, out / f"recall_{number}.png", f"R@1 on {name}: {means}")
