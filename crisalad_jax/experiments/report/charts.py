"""Charts: recall, precision and training curves, a map of positions, a matrix of similarities."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.ticker import MaxNLocator

from crisalad_jax.data.metres import flattened
from crisalad_jax.evaluation.metrics import PrecisionRecall, right_retrievals
from crisalad_jax.evaluation.similarity import cells_of
from crisalad_jax.experiments.report.style import (
    COLOURS,
    GREY,
    INK,
    PLAIN,
    RIGHT,
    UNMATCHED,
    WIDE,
    WRONG,
    Picture,
    label_axes,
    legend_below,
    new_figure,
)
from crisalad_jax.retrieval.neighbours import Neighbours

OUTCOMES = ("wrong", "no positive", "right")
"""Possible outcomes of a query: "wrong" if its first retrieval is not correct but another database
image is, "no positive" if none is, and "right" if the first retrieval is correct."""
_DASHES = ("-", "--", ":")
# Key, title of the panel, and whether to smooth it because batches make it noisy.
_LOSSES = (
    ("loss", "loss", True),
    ("easy_anchor_fraction", "share of anchors without a hard positive", True),
    ("accuracy", "share of images nearest to their class", True),
    ("learning_rate", "learning rate", False),
)
_TIMES, _LEAST = 10, 1000.0
_SHARE, _COUNT = 0.02, 5
_TRUTH = "#d55e00"
_MANY = 20_000
"""Number of images above which marks are rasterised in vector files too, to limit their size."""


def recall_curves(
    curves: Mapping[str, Mapping[int, float]], title: str = "", *, wide: bool = False
) -> Picture:
    """Draw Recall@K in percent against K, one named line per curve.

    Args:
        curves: fractions of the queries, 0 to 1, by name, then by K.
        title: title above the picture.
        wide: whether the figure stands alone, rather than in a page that is also read on phones.

    Returns:
        The figure.
    """
    figure = new_figure(4.5, title, **WIDE) if wide else new_figure(3.4, title)
    axes = figure.add_subplot()
    label_axes(axes, "K, database images retrieved", "Recall@K")
    _draw_recalls(axes, curves)
    axes.set_xticks(sorted({k for curve in curves.values() for k in curve}))
    legend_below(figure)
    return figure


def precision_curves(curves: Mapping[str, PrecisionRecall]) -> Picture:
    """Draw precision against recall in percent, one named line per curve."""
    figure = new_figure(3.4)
    axes = figure.add_subplot()
    label_axes(axes, "recall", "precision")
    for number, (name, curve) in enumerate(curves.items()):
        _draw_line(axes, number, name, 100 * curve.recall, 100 * curve.precision)
    axes.set(xlim=(0, 100), ylim=(0, 100))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:.0f} %")
    legend_below(figure)
    return figure


def training_curves(records: Sequence[Mapping[str, int | float]]) -> Picture:
    """Draw the loss, learning rate and validation recalls of a training run against its steps.

    Each series has a panel; recalls share one. A long noisy series is pale, under a running mean.

    Args:
        records: the lines of metrics.jsonl (`read_metrics`), each with "step" and any of "loss",
            "easy_anchor_fraction", "accuracy", "learning_rate", and recalls such as "R@1" as
            fractions of the queries, 0 to 1.

    Returns:
        The figure.
    """
    series = {
        key: {int(record["step"]): record[key] for record in records if key in record}
        for key in dict.fromkeys(key for record in records for key in record)
    }
    losses = [panel for panel in _LOSSES if panel[0] in series]
    recalls = {key: series[key] for key in series if key.startswith("R@")}
    heights = [1.5] * len(losses) + [2.4] * bool(recalls)
    figure = new_figure(sum(heights) + 0.45 * len(heights) + 0.6, **WIDE)
    panels = figure.subplots(len(heights), sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    for axes, (key, label, noisy) in zip(panels, losses, strict=False):
        label_axes(axes, "", "", title=label)
        _draw_series(axes, series[key], noisy)
    if recalls:
        label_axes(panels[-1], "", "", title="validation Recall@K")
        _draw_recalls(panels[-1], recalls)
        panels[-1].legend(frameon=False, fontsize=9, loc="center left", bbox_to_anchor=(1, 0.5))
    panels[-1].xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    panels[-1].set_xlabel("step", fontsize=10)
    return figure


def _draw_recalls(axes: Axes, curves: Mapping[str, Mapping[int, float]]) -> None:
    """Draw fractions in percent; each line's name ends with its last value."""
    for number, (name, curve) in enumerate(curves.items()):
        at, values = zip(*sorted(curve.items()), strict=True)
        percent = 100 * np.array(values)
        _draw_line(axes, number, f"{name}  {percent[-1]:.1f}", at, percent, marker="o")
    least = 100 * min(value for curve in curves.values() for value in curve.values())
    # The scale starts at 0 unless the lines are high, where that would hide their differences.
    axes.set_ylim(0 if least < 50 else None, None)
    axes.yaxis.set_major_locator(MaxNLocator(6, integer=True, steps=(1, 2, 5, 10)))
    axes.yaxis.set_major_formatter("{x:g} %")


def _draw_line(axes: Axes, number: int, name: str, x: Any, y: Any, marker: str = "") -> None:
    dashes, colour = divmod(number, len(COLOURS))
    style: Any = {"color": COLOURS[colour], "linestyle": _DASHES[dashes % len(_DASHES)]}
    style |= {"linewidth": 1.8, "marker": marker, "markersize": 4.5}
    axes.plot(x, y, label=name, clip_on=False, **style)  # markers at 100 % are not cut in half


def _draw_series(axes: Axes, series: Mapping[int, float], noisy: bool) -> None:
    steps, values = list(series), np.array(list(series.values()), float)
    axes.yaxis.set_major_formatter("{x:g}")
    window = len(values) // 20
    if noisy and window >= 3:
        axes.plot(steps, values, color=COLOURS[0], linewidth=0.7, alpha=0.3)
        ones = np.ones(window)
        counts = np.convolve(np.ones_like(values), ones, mode="same")
        values = np.convolve(values, ones, mode="same") / counts
    marker = "o" if len(values) == 1 else ""
    axes.plot(steps, values, color=COLOURS[0], linewidth=1.8, marker=marker, markersize=4.5)


def outcomes_of(neighbours: Neighbours, positives: Sequence[Int[np.ndarray, " _"]]) -> np.ndarray:
    """Return the outcome of each query, one of `OUTCOMES`, as an array of texts."""
    right = right_retrievals(neighbours.indices[:, :1], positives)[:, 0]
    matched = [len(wanted) > 0 for wanted in positives]
    return np.where(right, "right", np.where(matched, "wrong", "no positive"))


class Positions(NamedTuple):
    """Positions of images in metres, and which images have a plausible position."""

    database: Float[np.ndarray, "n axis"]
    queries: Float[np.ndarray, "q axis"]
    database_placed: Bool[np.ndarray, " n"]
    queries_placed: Bool[np.ndarray, " q"]
    limit: float
    """Metres from the median position beyond which an image is not placed."""


def find_placed(
    database: Float[np.ndarray, "n axis"], queries: Float[np.ndarray, "q axis"]
) -> Positions:
    """Separate images with a plausible position in metres from those with a placeholder.

    A position is implausible if it is over a kilometre from the median position, and over ten times
    as far as the nearest nine tenths of the images. Images at (0, 0), or at a position shared with
    many others, count for neither limit. A second city with a tenth of the images is plausible.
    """
    points = np.concatenate([database, queries])
    _, which, counts = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    many = counts[which.reshape(-1)] >= max(_COUNT, _SHARE * len(points))
    trusted = points[~(many | (points == 0).all(axis=1))]
    trusted = trusted if len(trusted) else points
    centre = np.median(trusted, axis=0)
    reach = np.quantile(np.linalg.norm(trusted - centre, axis=1), 0.9)
    limit = max(_TIMES * float(reach), _LEAST)
    placed = np.linalg.norm(points - centre, axis=1) <= limit
    count = len(database)
    return Positions(database, queries, placed[:count], placed[count:], limit)


def position_map(
    positions: Positions, first: Int[np.ndarray, " q"], outcomes: np.ndarray
) -> Picture:
    """Draw a map, in metres and to scale, of the images that have a plausible position.

    The database is grey. A query is a green dot if its first retrieval is correct, or a red cross,
    with a line to the retrieval, if it is wrong. It is a hollow triangle if no database image is
    correct.

    Args:
        positions: positions of all images, from `find_placed`.
        first: index in the database of each query's first retrieval.
        outcomes: outcome of each query, from `outcomes_of`.
    """
    points = flattened(np.concatenate([positions.database, positions.queries]))
    database, queries = np.split(points, [len(positions.database)])
    database_placed, queries_placed = positions.database_placed, positions.queries_placed
    points = np.concatenate([database[database_placed], queries[queries_placed]])
    low, span = points.min(axis=0), np.ptp(points, axis=0)
    # A narrow place gets room around it, so that nothing is squeezed into a line.
    widened = np.maximum(span, max(span.max() / 2.5, 1))
    margin = (widened - span) / 2 + 0.04 * widened.max()
    limits = np.stack([-margin, span + margin], 1)
    figure = new_figure(1.0 + 3.2 * np.ptp(limits[1]) / np.ptp(limits[0]))
    axes = figure.add_subplot()
    label_axes(axes, "metres east of the westernmost image", "metres north", grid="both")
    axes.set(xlim=limits[0], ylim=limits[1], aspect="equal")
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_locator(MaxNLocator(5))

    database, queries = database - low, queries - low
    size = float(np.clip(4000 / len(points), 2, 18))
    there, pixels = database[database_placed], len(points) > _MANY
    plain: Any = {"c": PLAIN, "linewidths": 0, "label": "database", "rasterized": pixels}
    axes.scatter(*there.T, s=2.5 * size, **plain)
    joined = (outcomes == "wrong") & queries_placed & database_placed[first]
    lines = np.stack([queries[joined], database[first[joined]]], axis=1)
    # Paler where there are many, so that what is below them shows.
    alpha = float(np.clip(60 / max(len(lines), 1), 0.05, 0.45))
    thin: Any = {"colors": WRONG, "linewidths": 0.6, "alpha": alpha, "rasterized": pixels}
    axes.add_collection(LineCollection(lines.tolist(), **thin))
    hollow = {"facecolors": "none", "edgecolors": UNMATCHED, "marker": "^", "linewidths": 0.8}
    styles: dict[str, dict[str, Any]] = {
        "right": {"c": RIGHT, "marker": "o", "linewidths": 0},
        "wrong": {"c": WRONG, "marker": "x", "linewidths": 1},
        "no positive": hollow,
    }
    for outcome, marks in styles.items():
        mask = (outcomes == outcome) & queries_placed
        if mask.any():
            marks |= {"label": f"{outcome} ({mask.sum()})", "rasterized": pixels}
            axes.scatter(*queries[mask].T, s=1.4 * size, **marks)
    legend_below(figure)
    return figure


def truth_cells(
    positives: Sequence[Int[np.ndarray, " _"]], database: int, shape: tuple[int, ...]
) -> Bool[np.ndarray, "rows columns"]:
    """Mark the cells of a similarity map that hold a query and one of its positives.

    Args:
        positives: correct database indices of each query.
        database: number of images in the database.
        shape: shape of the map, (rows, columns), from `similarity_map`.
    """
    rows, columns = cells_of(len(positives), shape[0]), cells_of(database, shape[1])
    cells = np.zeros(shape, bool)
    for row, wanted in zip(rows, positives, strict=True):
        cells[row, columns[wanted]] = True
    return cells


def similarity_matrix(
    similarities: Float[np.ndarray, "rows columns"],
    positives: Sequence[Int[np.ndarray, " _"]],
    first: Int[np.ndarray, " q"],
    outcomes: np.ndarray,
    database: int,
) -> Picture:
    """Draw a similarity map, with tinted ground truth and first retrievals as dots.

    Args:
        similarities: the map, from `similarity.similarity_map`.
        positives: correct database indices of each of the q queries.
        first: index in the database of each query's first retrieval; green if correct, else red.
        outcomes: outcome of each query, from `outcomes_of`.
        database: number of images in the database.
    """
    queries = len(positives)
    # Cells are square, unless one side would be too narrow to read.
    ratio = min(max(queries / database, 0.3), 1.6)
    figure = new_figure(0.6 + 2.7 * ratio)
    axes = figure.add_subplot()
    label_axes(axes, "database image, in file order", "query, in file order")
    axes.grid(visible=False)
    where: Any = {"extent": (0, database, queries, 0), "aspect": ratio * database / queries}
    drawn = axes.imshow(similarities, cmap="Greys", interpolation="nearest", **where)
    truth = truth_cells(positives, database, similarities.shape)
    tint = ListedColormap([_TRUTH])
    axes.imshow(truth, tint, alpha=0.9 * truth, interpolation="nearest", **where)
    size = float(np.clip(600 / queries, 0.6, 30))
    colours = np.where(outcomes == "right", RIGHT, WRONG).tolist()
    dots: Any = {"c": colours, "linewidths": 0, "rasterized": queries > _MANY}
    axes.scatter(first + 0.5, np.arange(queries) + 0.5, s=size, **dots)
    bar = figure.colorbar(drawn, ax=axes, shrink=0.8, aspect=30, pad=0.02)
    bar.set_label("similarity", fontsize=9, color=INK)
    bar.ax.tick_params(labelsize=8, labelcolor=INK, color=GREY)
    return figure
