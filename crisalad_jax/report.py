"""What a run shows: recall tables, recall and training curves, galleries of predictions.

Pictures are drawn with matplotlib's object interface: no display, and no state outside the call.
"""

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.text import Text as Label
from matplotlib.ticker import MaxNLocator
from rich.table import Table
from rich.text import Text

from crisalad_jax.data.images import read_image, resize_image
from crisalad_jax.errors import InputError
from crisalad_jax.files import atomic_path

_INK = "#222222"
_GREY = "#757575"
_PALE = "#e4e4e4"
_RIGHT = "#2a8f3c"
_WRONG = "#c62828"
# Okabe and Ito's colours without the yellow, which is too light for lines: told apart by the
# colour-blind.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_DASHES = ("-", "--", ":")
_DPI = 120

_RECALL = re.compile(r"R@(\d+)")
# Key, title of the panel, and whether it is noise of the batches, to be smoothed.
_LOSSES = (
    ("loss", "loss", True),
    ("b_acc", "b_acc: share of anchors without a hard positive", True),
    ("learning_rate", "learning rate", False),
)


class RecallRow(NamedTuple):
    """One line of a table of recalls."""

    benchmark: str
    model: str
    """Which weights, for instance "trained, seed 0"."""
    grouping: str
    """How images were batched: single, shuffled or sequential."""
    recalls: Mapping[int, float]
    """K -> fraction of the queries, 0 to 1."""


def recall_table(rows: Sequence[RecallRow], title: str | None = None) -> Table:
    """A table for the terminal: a line per row, recalls in percent with one decimal.

    A line is ruled between data sets.

    Raises:
        InputError: no rows, or a recall outside 0 to 1.
    """
    header, body = _recall_cells(rows)
    table = Table(title=title, title_justify="left")
    for name in header:
        justify = "right" if name.startswith("R@") else "left"
        table.add_column(name, justify=justify, overflow="fold")
    for cells, following in zip(body, [*body[1:], None], strict=True):
        last = following is not None and following[0] != cells[0]
        # Text: square brackets in a name are no markup.
        table.add_row(*(Text(cell) for cell in cells), end_section=last)
    return table


def recall_markdown(rows: Sequence[RecallRow]) -> str:
    """The same table as Markdown, one line per row, ending in a newline.

    Raises:
        InputError: as `recall_table`.
    """
    header, body = _recall_cells(rows)
    rule = ["---:" if name.startswith("R@") else "---" for name in header]
    escaped = [[cell.replace("|", r"\|") for cell in cells] for cells in body]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in [header, rule, *escaped])


def _recall_cells(rows: Sequence[RecallRow]) -> tuple[list[str], list[list[str]]]:
    if not rows:
        raise InputError("rows: found none, expected at least one row of recalls")
    for row in rows:
        _check_fractions(f"{row.benchmark}, {row.model}", row.recalls)
    ks = sorted({k for row in rows for k in row.recalls})
    body = [
        [row.benchmark, row.model, row.grouping]
        + [f"{100 * row.recalls[k]:.1f}" if k in row.recalls else "-" for k in ks]
        for row in rows
    ]
    return ["data set", "model", "grouping", *(f"R@{k}" for k in ks)], body


def recall_curves(
    path: str | os.PathLike[str], curves: Mapping[str, Mapping[int, float]], title: str
) -> None:
    """Write a PNG of Recall@K in percent against K, one named line per curve.

    Args:
        path: the picture to write.
        curves: name -> K -> fraction of the queries, 0 to 1.
        title: stands above the picture.

    Raises:
        InputError: no curves, a curve without values, or a recall outside 0 to 1.
    """
    if not curves:
        raise InputError("curves: found none, expected at least one")
    for name, curve in curves.items():
        _check_fractions(name, curve)
    figure = _curves_figure(4.5, title)
    axes = figure.add_subplot()
    _draw_curves(axes, curves)
    axes.set_xticks(sorted({k for curve in curves.values() for k in curve}))
    axes.set_xlabel("K, database images retrieved", fontsize=10, color=_INK)
    axes.set_ylabel("Recall@K", fontsize=10, color=_INK)
    _save(figure, path)


def training_curves(
    path: str | os.PathLike[str], records: Sequence[Mapping[str, int | float]], title: str = ""
) -> None:
    """Write a PNG of a run: loss, b_acc, learning rate and validation recalls against the step.

    A panel is drawn for each of them that the records hold. Long noisy series are drawn pale under
    their running mean.

    Args:
        path: the picture to write.
        records: the lines of metrics.jsonl, each with "step" and any of "loss", "b_acc",
            "learning_rate", and "R@K" as a fraction of the queries, 0 to 1.
        title: stands above the picture.

    Raises:
        InputError: no records, one without a step, none with a known value, or a recall outside 0
            to 1.
    """
    for number, record in enumerate(records):
        if "step" not in record:
            raise InputError(f"records: number {number} has no step, only {', '.join(record)}")
    series = {
        key: {int(record["step"]): record[key] for record in records if key in record}
        for key in dict.fromkeys(key for record in records for key in record)
    }
    losses = [panel for panel in _LOSSES if panel[0] in series]
    ks = sorted(int(match[1]) for match in map(_RECALL.fullmatch, series) if match)
    recalls = {f"R@{k}": series[f"R@{k}"] for k in ks}
    for name, curve in recalls.items():
        _check_fractions(name, curve)
    if not losses and not recalls:
        raise InputError(
            f"records: found {len(records)} without any of "
            f"{', '.join(key for key, *_ in _LOSSES)} or R@K, expected at least one"
        )

    # The recalls have names beside them, which need room.
    heights = [1.5] * len(losses) + [2.4] * bool(recalls)
    figure = _curves_figure(sum(heights) + 0.45 * len(heights) + 0.6, title)
    panels = figure.subplots(
        len(heights), sharex=True, squeeze=False, gridspec_kw={"height_ratios": heights}
    )[:, 0]
    for axes, (key, label, noisy) in zip(panels, losses, strict=False):
        _draw_series(axes, series[key], noisy)
        axes.set_title(label, fontsize=10, color=_INK, loc="left")
    if recalls:
        _draw_curves(panels[-1], recalls)
        panels[-1].set_title("validation Recall@K", fontsize=10, color=_INK, loc="left")
    panels[-1].xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    panels[-1].set_xlabel("step", fontsize=10, color=_INK)
    _save(figure, path)


def prediction_gallery(
    path: str | os.PathLike[str],
    queries: Sequence[Path],
    database: Sequence[Path],
    indices: Int[np.ndarray, "q k"],
    similarities: Float[np.ndarray, "q k"],
    positives: Sequence[Int[np.ndarray, " _"]] | None,
    *,
    rows: int = 6,
    columns: int = 4,
    title: str = "",
) -> None:
    """Write a PNG of queries, one a row, with what was retrieved for them, best first.

    Retrievals are framed green where right and red where wrong, with rank and similarity below.
    Half of the rows are queries whose first retrieval is right, half are others, as far as there
    are both, each half spread evenly over the data set: the same input gives the same picture.
    Where nothing is known to be right, all are framed grey, and queries spread evenly.

    Args:
        path: the picture to write.
        queries: image files of the q queries.
        database: image files that `indices` count.
        indices: database indices retrieved for each query, best first.
        similarities: those of `indices`.
        positives: the database indices that are right for each query; None where that is unknown.
        rows: queries shown, at most q.
        columns: retrievals shown for each, at most k.
        title: stands above the picture.

    Raises:
        InputError: no queries or retrievals, numbers of rows that differ, an index beyond the
            database, rows or columns below 1, or an image that cannot be read.
    """
    _check_gallery(queries, database, indices, similarities, positives)
    for name, value in (("rows", rows), ("columns", columns)):
        if value < 1:
            raise InputError(f"{name}: found {value}, expected at least 1")
    shown = indices[:, :columns]
    if positives is None:
        right = None
        chosen = _evenly(np.arange(len(queries)), min(rows, len(queries)))
    else:
        verdicts = zip(shown, positives, strict=True)
        right = np.stack([np.isin(row, wanted) for row, wanted in verdicts])
        chosen = _choose_queries(right[:, 0], rows)

    # Inches. Frames and captions are drawn into the gaps.
    width, gap, between, margin = 1.7, 0.16, 0.34, 0.25
    head = 0.85 if title else 0.55
    thumbnails = {
        file: _thumbnail(read_image(file), round(width * _DPI))
        for query in chosen
        for file in (queries[query], *(database[index] for index in shown[query]))
    }
    aspect = float(np.median([image.shape[0] / image.shape[1] for image in thumbnails.values()]))
    height = width * min(max(aspect, 0.5), 1.5)
    count = 1 + shown.shape[1]
    # One more gap sets the queries apart.
    size = (
        2 * margin + count * width + count * gap,
        margin + head + len(chosen) * (height + between),
    )
    figure = Figure(figsize=size)

    def place(row: int, column: int, image: UInt8[np.ndarray, "h w 3"]) -> Axes:
        left = margin + column * (width + gap) + gap * (column > 0)
        top = head + row * (height + between)
        axes = figure.add_axes(
            (left / size[0], 1 - (top + height) / size[1], width / size[0], height / size[1])
        )
        axes.imshow(image)
        axes.set(xticks=[], yticks=[], anchor="NW")
        return axes

    for row, query in enumerate(chosen):
        axes = place(row, 0, thumbnails[queries[query]])
        note = "" if positives is None or np.size(positives[query]) else ", no positive exists"
        _caption(axes, f"query {query}{note}", _INK)
        axes.spines[:].set(color=_GREY, linewidth=0.5)
        for rank, index in enumerate(shown[query]):
            axes = place(row, rank + 1, thumbnails[database[index]])
            caption = f"{rank + 1}   {similarities[query, rank]:.3f}"
            if right is None:
                axes.spines[:].set(color=_GREY, linewidth=0.5)
                _caption(axes, caption, _INK)
                continue
            good = right[query, rank]
            colour = _RIGHT if good else _WRONG
            axes.spines[:].set(color=colour, linewidth=3)
            # A sign too, for those who cannot tell green from red.
            sign = "\N{CHECK MARK}" if good else "\N{BALLOT X}"
            _caption(axes, f"{caption}   {sign}", colour)

    left = margin / size[0]
    top = 1 - 0.2 / size[1]
    if title:
        _fit(figure.text(left, top, title, fontsize=13, color=_INK, va="top"), figure)
        top -= 0.3 / size[1]
    parts = [("query, then retrievals: rank, similarity", _GREY)]
    if right is not None:
        parts += [
            (", ", _GREY),
            ("\N{CHECK MARK} right   ", _RIGHT),
            ("\N{BALLOT X} wrong", _WRONG),
        ]
    for text, colour in parts:
        drawn = figure.text(left, top, text, fontsize=9, color=colour, va="top")
        left += drawn.get_window_extent().width / figure.bbox.width
    _save(figure, path)


def _check_fractions(name: str, recalls: Mapping[int, float]) -> None:
    if not recalls:
        raise InputError(f"{name}: found no recalls, expected at least one")
    for at, value in recalls.items():
        if not 0 <= value <= 1:
            raise InputError(f"{name}: found recall {value} at {at}, expected a fraction, 0 to 1")


def _check_gallery(
    queries: Sequence[Path],
    database: Sequence[Path],
    indices: Int[np.ndarray, "q k"],
    similarities: Float[np.ndarray, "q2 k2"],
    positives: Sequence[Int[np.ndarray, " _"]] | None,
) -> None:
    if not indices.size:
        raise InputError(f"indices: found shape {indices.shape}, expected queries and retrievals")
    if similarities.shape != indices.shape:
        raise InputError(
            f"similarities: found shape {similarities.shape}, expected {indices.shape} "
            "as of the indices"
        )
    for name, found in (("queries", queries), ("positives", positives)):
        if found is not None and len(found) != len(indices):
            raise InputError(f"{name}: found {len(found)}, expected {len(indices)} as of indices")
    if indices.min() < 0 or indices.max() >= len(database):
        raise InputError(
            f"indices: found {indices.min()} to {indices.max()}, expected 0 to "
            f"{len(database) - 1}, positions in the database"
        )


def _choose_queries(right: Bool[np.ndarray, " q"], rows: int) -> list[int]:
    """Right queries, then wrong ones: half each, or more of one where the other is short."""
    good, bad = np.flatnonzero(right), np.flatnonzero(~right)
    good_count = min(len(good), max(rows - rows // 2, rows - len(bad)))
    bad_count = min(len(bad), rows - good_count)
    return _evenly(good, good_count) + _evenly(bad, bad_count)


def _evenly(queries: Int[np.ndarray, " n"], count: int) -> list[int]:
    """So many of them, from the first to the last."""
    places = np.linspace(0, len(queries) - 1, count).round().astype(int)
    return queries[places].tolist()


def _thumbnail(image: UInt8[np.ndarray, "h w 3"], side: int) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Shrunk to at most `side` pixels either way, so that a page of photographs fits in memory."""
    factor = side / max(image.shape)
    if factor >= 1:
        return image
    height, width = (max(1, round(factor * length)) for length in image.shape[:2])
    return resize_image(image, (height, width))


def _caption(axes: Axes, text: str, colour: str) -> None:
    axes.set_xlabel(text, fontsize=9, color=colour, loc="left", labelpad=4)


def _draw_curves(axes: Axes, curves: Mapping[str, Mapping[int, float]]) -> None:
    """Fractions in percent, each line named at its right end."""
    lines = {
        name: sorted((at, 100 * value) for at, value in curve.items())
        for name, curve in curves.items()
    }
    values = [value for line in lines.values() for _, value in line]
    # The whole scale from 0 unless the lines lie high, where it would hide their differences.
    low = 0.0 if min(values) < 50 else 10 * ((min(values) - 2) // 10)
    high = min(100.0, 10 * -((max(values) + 2) // -10))
    _style(axes)
    axes.set_ylim(low, high)
    axes.yaxis.set_major_locator(MaxNLocator(6, integer=True, steps=(1, 2, 5, 10)))
    axes.yaxis.set_major_formatter("{x:.0f} %")

    ends = _spread([line[-1][1] for line in lines.values()], 0.065 * (high - low), low, high)
    right = max(at for line in lines.values() for at, _ in line)
    for number, ((name, line), end) in enumerate(zip(lines.items(), ends, strict=True)):
        colour = _COLOURS[number % len(_COLOURS)]
        at, percent = zip(*line, strict=True)
        axes.plot(
            at,
            percent,
            color=colour,
            linestyle=_DASHES[number // len(_COLOURS) % len(_DASHES)],
            linewidth=1.8,
            marker="o",
            markersize=4.5,
            # Markers at 100 % stay whole.
            clip_on=False,
        )
        axes.annotate(
            f"{name}  {percent[-1]:.1f}",
            (right, end),
            xytext=(9, 0),
            textcoords="offset points",
            color=colour,
            fontsize=9,
            va="center",
            annotation_clip=False,
        )


def _spread(places: Sequence[float], gap: float, low: float, high: float) -> list[float]:
    """Places moved apart to about `gap`, in their order, within `low` to `high`."""
    order = np.argsort(places, kind="stable")
    moved = np.array(places, float)[order]
    gap = min(gap, (high - low) / len(places))
    # Each round pushes close neighbours apart; a dozen names settle within a hundredth of the gap.
    for _ in range(300):
        push = np.maximum(gap - np.diff(moved), 0) / 2
        moved[:-1] -= push
        moved[1:] += push
        moved = moved.clip(low, high)
    spread = np.empty_like(moved)
    spread[order] = moved
    return spread.tolist()


def _draw_series(axes: Axes, series: Mapping[int, float], noisy: bool) -> None:
    steps, values = list(series), np.array(list(series.values()), float)
    _style(axes)
    axes.yaxis.set_major_formatter("{x:g}")
    window = len(values) // 20
    if not noisy or window < 3:
        marker = "o" if len(values) == 1 else None
        axes.plot(steps, values, color=_COLOURS[0], linewidth=1.8, marker=marker, markersize=4.5)
        return
    ones = np.ones(window)
    counts = np.convolve(np.ones_like(values), ones, mode="same")
    means = np.convolve(values, ones, mode="same") / counts
    axes.plot(steps, values, color=_COLOURS[0], linewidth=0.7, alpha=0.3)
    axes.plot(steps, means, color=_COLOURS[0], linewidth=1.8)


def _curves_figure(height: float, title: str) -> Figure:
    # Inches around everything, so that no name touches the edge.
    layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.1)
    figure = Figure(figsize=(7, height), layout=layout)
    if title:
        _fit(figure.suptitle(title, fontsize=12, color=_INK, x=0.02, ha="left"), figure)
    return figure


def _fit(label: Label, figure: Figure) -> None:
    """Shrink a line of text so that its right margin is at least its left one."""
    extent = label.get_window_extent()
    room = figure.bbox.width - 2 * extent.x0
    label.set_fontsize(float(label.get_fontsize()) * min(1, room / extent.width))


def _style(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_GREY)
    axes.tick_params(colors=_GREY, labelcolor=_INK, labelsize=9)
    axes.grid(axis="y", color=_PALE, linewidth=0.8)
    axes.set_axisbelow(True)


def _save(figure: Figure, path: str | os.PathLike[str]) -> None:
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=_DPI, facecolor="white")
