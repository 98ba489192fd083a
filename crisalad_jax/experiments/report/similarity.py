"""The matrix of similarities: queries against the database, each in its order."""

import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from crisalad_jax.evaluation.similarity import cells_of
from crisalad_jax.experiments.report.style import GREY, INK, NARROW, NARROW_DPI, RIGHT, WRONG, save
from crisalad_jax.utils.errors import InputError

_TRUTH = "#d55e00"


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
    database: int,
) -> None:
    """Write a narrow PNG of a similarity map, ground truth outlined, first retrievals as dots.

    Args:
        path: the picture to write.
        similarities: the map that `similarity.similarity_map` returns.
        positives: the database indices that are right for each of the q queries.
        first: the first retrieval of each query; green where right, red where wrong.
        database: images in the database.

    Raises:
        InputError: the map has more cells than there are images.
    """
    queries = len(positives)
    if similarities.shape[0] > queries or similarities.shape[1] > database:
        raise InputError(
            f"similarities: found {similarities.shape}, expected at most ({queries}, {database}), "
            "queries and database"
        )
    rows, columns = similarities.shape
    # Cells are square, unless one side would be too narrow to read.
    ratio = min(max(queries / database, 0.3), 1.6)
    height = 0.6 + 2.7 * ratio
    layout = ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.08)
    figure = Figure(figsize=(NARROW, height), layout=layout)
    axes = figure.add_subplot()
    drawn = axes.imshow(
        similarities,
        cmap="Greys",
        extent=(0, database, queries, 0),
        aspect=ratio * database / queries,
        interpolation="nearest",
    )
    truth = truth_cells(positives, database, (rows, columns))
    scale = np.array([database / columns, queries / rows])
    axes.add_collection(
        LineCollection((_outlines(truth) * scale).tolist(), colors=_TRUTH, linewidths=0.8)
    )
    right = [np.isin(index, wanted) for index, wanted in zip(first, positives, strict=True)]
    size = float(np.clip(600 / queries, 0.6, 30))
    colours = np.where(right, RIGHT, WRONG).tolist()
    axes.scatter(first + 0.5, np.arange(queries) + 0.5, s=size, c=colours, linewidths=0)
    axes.set_xlabel("database image, in file order", fontsize=10, color=INK)
    axes.set_ylabel("query, in file order", fontsize=10, color=INK)
    axes.spines[:].set_color(GREY)
    axes.spines[:].set_linewidth(0.6)
    axes.tick_params(colors=GREY, labelcolor=INK, labelsize=9)
    bar = figure.colorbar(drawn, ax=axes, shrink=0.8, aspect=30, pad=0.02)
    bar.set_label("similarity", fontsize=9, color=INK)
    bar.ax.tick_params(labelsize=8, labelcolor=INK, color=GREY)
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    save(figure, path, NARROW_DPI, dark=True)


def _outlines(cells: Bool[np.ndarray, "rows columns"]) -> Float[np.ndarray, "line 2 2"]:
    """Trace edges between marked and unmarked cells, as pairs of (x, y)."""
    framed = np.pad(cells, 1)
    y, x = np.nonzero(framed[1:] != framed[:-1])
    across = np.stack([np.stack([x - 1, y], -1), np.stack([x, y], -1)], 1)
    y, x = np.nonzero(framed[:, 1:] != framed[:, :-1])
    down = np.stack([np.stack([x, y - 1], -1), np.stack([x, y], -1)], 1)
    return np.concatenate([across, down]).astype(float)
