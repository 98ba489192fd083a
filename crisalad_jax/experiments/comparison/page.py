"""A comparison as one HTML page, which embeds its pictures and needs no network."""

import json
import pathlib
from typing import NamedTuple

from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from crisalad_jax.evaluation.results import percent
from crisalad_jax.experiments.comparison import tables
from crisalad_jax.experiments.comparison.paired import Difference
from crisalad_jax.experiments.comparison.summary import KS, Recall, Summary
from crisalad_jax.experiments.report.embedding import Drawing, drawing
from crisalad_jax.experiments.report.page import ESCAPED, PAGE, render
from crisalad_jax.experiments.report.style import (
    COLOURS,
    GREY,
    INK,
    NARROW,
    NARROW_DPI,
    PALE,
    plain_axes,
    save,
)
from crisalad_jax.utils.files import atomic_path

_TITLES = {"compare": "Methods compared", "ablate": "What each part brings"}


class _Cell(NamedTuple):
    text: str
    note: str = ""
    best: bool = False
    kind: str = ""
    """Class of a cell of differences: right or wrong."""


def write_page(summary: Summary, out: pathlib.Path) -> pathlib.Path:
    """Write index.html and its charts, recall_N.png, into `out`; return the page's path."""
    charts = [_chart(summary, name, out, n) for n, name in enumerate(summary.sets)]
    rows = [
        (
            [tables.title_of(row, summary.rows), *tables.described(row)],
            _recall_cells(summary, number),
        )
        for number, row in enumerate(summary.rows)
    ]
    costs = [(row.labels[0], tables.costs_of(row)) for row in tables.one_of_each(summary)]
    facts = [
        (
            name,
            f"{len(each.queries):,} queries, {len(each.database):,} database images, positive: "
            f"{each.rule}",
        )
        for name, each in summary.sets.items()
    ]
    context = {
        "title": _TITLES[summary.kind],
        "facts": facts,
        "headers": summary.headers,
        "sets": list(summary.sets),
        "ks": KS,
        "rows": rows,
        "charts": charts,
        "reference": tables.title_of_reference(summary),
        "differences": [
            (
                tables.title_of(row, summary.rows),
                [_difference(d) for by_k in found.values() for d in by_k],
            )
            for row, found in tables.compared_rows(summary)
        ],
        "cost_headers": tables.COSTS,
        "costs": costs,
        "adapter_headers": tables.ADAPTERS,
        "adapters": [(name, cells) for name, *cells in map(tables.adapter_cells, summary.adapters)],
        "notes": summary.notes,
        "settings": json.dumps(summary.settings, indent=2),
    }
    path = out / PAGE
    with atomic_path(path) as temporary:
        text = render(context, "comparison.html")
        temporary.write_text(text, encoding="utf-8", errors=ESCAPED)
    return path


def _recall_cells(summary: Summary, number: int) -> list[_Cell]:
    """Format a row's recalls; the best of each column is marked."""
    cells = []
    for name in summary.sets:
        for k in KS:
            recall = summary.rows[number].recalls[name][k]
            best = max(row.recalls[name][k].mean for row in summary.rows)
            cells.append(_cell(recall, best=recall.mean == best))
    return cells


def _cell(recall: Recall, *, best: bool) -> _Cell:
    spread = "" if recall.spread is None else f"± {percent(recall.spread)}\n"
    interval = tables.interval_words(recall).replace("-", "\N{EN DASH}")
    return _Cell(percent(recall.mean), spread + interval, best)


def _difference(difference: Difference) -> _Cell:
    low, high = map(tables.points, difference.interval)
    kind = {"better": "right", "worse": "wrong"}.get(difference.verdict, "")
    note = f"{low} to {high}\n{difference.verdict}"
    return _Cell(tables.points(difference.mean), note, kind=kind)


def _chart(summary: Summary, name: str, out: pathlib.Path, number: int) -> Drawing:
    """Draw R@1 of all rows on a set: dots for means, lines for intervals, rings for seeds."""
    rows = summary.rows
    titles = [tables.title_of(row, rows) for row in rows]
    figure = Figure(
        figsize=(NARROW, 0.8 + 0.3 * len(rows)), layout=ConstrainedLayoutEngine(w_pad=0.12)
    )
    axes = figure.add_subplot()
    plain_axes(axes)
    axes.grid(visible=False)
    axes.grid(axis="x", color=PALE, linewidth=0.8)
    for place, row in enumerate(rows):
        recall = row.recalls[name][1]
        colour = COLOURS[0] if row.name == summary.reference else INK
        low, high = (100 * end for end in recall.interval)
        axes.plot((low, high), (place, place), color=colour, linewidth=1.6, alpha=0.55)
        seeds = [100 * value for value in recall.by_seed]
        axes.plot(seeds, [place] * len(seeds), "o", markersize=4, markerfacecolor="none",
                  markeredgecolor=GREY, markeredgewidth=0.8, clip_on=False)  # fmt: skip
        axes.plot(100 * recall.mean, place, "o", color=colour, markersize=6, clip_on=False)
    axes.set_yticks(range(len(rows)), titles, fontsize=9)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter("{x:g} %")
    axes.set_xlabel(f"R@1 on {name}", fontsize=10, color=INK)
    path = out / f"recall_{number}.png"
    save(figure, path, NARROW_DPI, dark=True)
    means = "; ".join(
        f"{title} {percent(row.recalls[name][1].mean)} %"
        for title, row in zip(titles, rows, strict=True)
    )
    return drawing(path, f"R@1 on {name}: {means}")
