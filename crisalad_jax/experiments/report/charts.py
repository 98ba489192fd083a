"""Pictures of a whole evaluation: a map of where images were taken, a matrix of similarities."""

import os
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.collections import LineCollection
from matplotlib.ticker import MaxNLocator

from crisalad_jax.evaluation.similarity import cells_of
from crisalad_jax.experiments.report.style import (
    GREY,
    INK,
    PLAIN,
    RIGHT,
    UNMATCHED,
    WRONG,
    label_axes,
    legend_above,
    new_figure,
    save,
)
from crisalad_jax.retrieval.neighbours import Neighbours

_TIMES, _LEAST = 10, 1000.0
_SHARE, _COUNT = 0.02, 5
_TRUTH = "#d55e00"


class Verdicts(NamedTuple):
    """Whether each query's first retrieval is right, and whether it could be."""

    right: Bool[np.ndarray, " q"]
    matched: Bool[np.ndarray, " q"]
    """Whether any database image is right for the query."""

    @property
    def wrong(self) -> Bool[np.ndarray, " q"]:
        """Mask of the queries whose first retrieval is wrong although another image is right."""
        return self.matched & ~self.right


def judge(neighbours: Neighbours, positives: Sequence[Int[np.ndarray, " _"]]) -> Verdicts:
    """Judge each query's first retrieval by the ground truth."""
    first = neighbours.indices[:, 0]
    right = [bool(np.isin(index, wanted)) for index, wanted in zip(first, positives, strict=True)]
    return Verdicts(np.array(right, bool), np.array([np.size(p) > 0 for p in positives], bool))


class Placed(NamedTuple):
    """Which images are where the others are."""

    database: Bool[np.ndarray, " n"]
    queries: Bool[np.ndarray, " q"]
    limit: float
    """Metres from the centre beyond which an image is out of place."""


def find_placed(
    database: Float[np.ndarray, "n axis"], queries: Float[np.ndarray, "q axis"]
) -> Placed:
    """Tell images with a likely position from those with a placeholder, such as (0, 0).

    An image is out of place if it is ten times farther from the median position than nine tenths
    of the images, and over a kilometre. Neither is measured by images at (0, 0), nor by those that
    share one position with many others. A second city with a tenth of the images is in place.
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
    return Placed(placed[: len(database)], placed[len(database) :], limit)


def position_map(
    path: str | os.PathLike[str],
    database: Float[np.ndarray, "n 2"],
    queries: Float[np.ndarray, "q 2"],
    first: Int[np.ndarray, " q"],
    verdicts: Verdicts,
    placed: Placed,
) -> None:
    """Write a PNG of a map in metres, with the same scale on both axes.

    The database is grey. A query is a green dot if its first retrieval is right, or a red cross,
    with a line to the retrieval, if it is wrong. It is a hollow triangle if no database image is
    right.

    Args:
        path: the picture to write.
        database: positions in metres, east and north or any two axes.
        queries: those of the queries.
        first: the first retrieval of each query, an index of the database.
        verdicts: whether it is right.
        placed: the images that are drawn.
    """
    points = np.concatenate([database[placed.database], queries[placed.queries]])
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
    there = database[placed.database]
    axes.scatter(*there.T, s=2.5 * size, c=PLAIN, linewidths=0, label="database")
    joined = verdicts.wrong & placed.queries & placed.database[first]
    lines = np.stack([queries[joined], database[first[joined]]], axis=1)
    # Paler where there are many, so that what is below them shows.
    alpha = float(np.clip(60 / max(len(lines), 1), 0.05, 0.45))
    axes.add_collection(LineCollection(lines.tolist(), colors=WRONG, linewidths=0.6, alpha=alpha))
    hollow = {"facecolors": "none", "edgecolors": UNMATCHED, "marker": "^", "linewidths": 0.8}
    for label, of_kind, marks in (
        ("right", verdicts.right, {"c": RIGHT, "marker": "o", "linewidths": 0}),
        ("wrong", verdicts.wrong, {"c": WRONG, "marker": "x", "linewidths": 1}),
        ("no positive exists", ~verdicts.matched & ~verdicts.right, hollow),
    ):
        mask = of_kind & placed.queries
        if mask.any():
            axes.scatter(*queries[mask].T, s=1.4 * size, label=f"{label} ({mask.sum()})", **marks)
    legend_above(figure)
    save(figure, path)


def truth_cells(
    positives: Sequence[Int[np.ndarray, " _"]], database: int, shape: tuple[int, int]
) -> Bool[np.ndarray, "rows columns"]:
    """Mark the cells of a similarity map that hold a query and one of its positives.

    Args:
        positives: the database indices that are right for each query.
        database: number of images in the database.
        shape: shape of the similarity map.
    """
    rows, columns = cells_of(len(positives), shape[0]), cells_of(database, shape[1])
    cells = np.zeros(shape, bool)
    for row, wanted in zip(rows, positives, strict=True):
        cells[row, columns[wanted]] = True
    return cells


def similarity_matrix(
    path: str | os.PathLike[str],
    similarities: Float[np.ndarray, "rows columns"],
    positives: Sequence[Int[np.ndarray, " _"]],
    first: Int[np.ndarray, " q"],
    right: Bool[np.ndarray, " q"],
    database: int,
) -> None:
    """Write a PNG of a similarity map, ground truth outlined, first retrievals as dots.

    Args:
        path: the picture to write.
        similarities: the map that `similarity.similarity_map` returns.
        positives: the database indices that are right for each of the q queries.
        first: the first retrieval of each query; green where right, red where wrong.
        right: whether it is right.
        database: images in the database.
    """
    queries = len(positives)
    rows, columns = similarities.shape
    # Cells are square, unless one side would be too narrow to read.
    ratio = min(max(queries / database, 0.3), 1.6)
    figure = new_figure(0.6 + 2.7 * ratio)
    axes = figure.add_subplot()
    label_axes(axes, "database image, in file order", "query, in file order")
    axes.grid(visible=False)
    drawn = axes.imshow(
        similarities,
        cmap="Greys",
        extent=(0, database, queries, 0),
        aspect=ratio * database / queries,
        interpolation="nearest",
    )
    outlines = _outlines(truth_cells(positives, database, (rows, columns)))
    outlines *= (database / columns, queries / rows)
    axes.add_collection(LineCollection(outlines.tolist(), colors=_TRUTH, linewidths=0.8))
    size = float(np.clip(600 / queries, 0.6, 30))
    colours = np.where(right, RIGHT, WRONG).tolist()
    axes.scatter(first + 0.5, np.arange(queries) + 0.5, s=size, c=colours, linewidths=0)
    bar = figure.colorbar(drawn, ax=axes, shrink=0.8, aspect=30, pad=0.02)
    bar.set_label("similarity", fontsize=9, color=INK)
    bar.ax.tick_params(labelsize=8, labelcolor=INK, color=GREY)
    save(figure, path)


def _outlines(cells: Bool[np.ndarray, "rows columns"]) -> Float[np.ndarray, "line 2 2"]:
    """Trace edges between marked and unmarked cells, as pairs of (x, y)."""
    framed = np.pad(cells, 1)
    y, x = np.nonzero(framed[1:] != framed[:-1])
    across = np.stack([np.stack([x - 1, y], -1), np.stack([x, y], -1)], 1)
    y, x = np.nonzero(framed[:, 1:] != framed[:, :-1])
    down = np.stack([np.stack([x, y - 1], -1), np.stack([x, y], -1)], 1)
    return np.concatenate([across, down]).astype(float)
