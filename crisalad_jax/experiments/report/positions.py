"""The map of where queries and database were photographed, and how far off wrong retrievals are."""

import os

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import MaxNLocator

from crisalad_jax.experiments.report.placeholders import Placed
from crisalad_jax.experiments.report.style import (
    GREY,
    INK,
    NARROW,
    NARROW_DPI,
    PALE,
    PLAIN,
    RIGHT,
    UNMATCHED,
    WRONG,
    save,
)
from crisalad_jax.utils.errors import InputError


def position_map(
    path: str | os.PathLike[str],
    database: Float[np.ndarray, "n 2"],
    queries: Float[np.ndarray, "q 2"],
    first: Int[np.ndarray, " q"],
    right: Bool[np.ndarray, " q"],
    matched: Bool[np.ndarray, " q"],
    placed: Placed | None = None,
) -> None:
    """Write a narrow PNG of a map in metres, with the same scale on both axes.

    The database is grey. A query is a green dot if its first retrieval is right, or a red cross,
    with a line to the retrieval, if it is wrong. It is a hollow triangle if no database image is
    right.

    Args:
        path: the picture to write.
        database: positions in metres, east and north or any two axes.
        queries: those of the queries.
        first: the first retrieval of each query, an index of the database.
        right: whether it is right.
        matched: whether any database image is right for the query.
        placed: the images that are drawn; None draws all.

    Raises:
        InputError: numbers of queries that differ, or a position that is not finite.
    """
    for name, array in (("database", database), ("queries", queries)):
        if not np.isfinite(array).all():
            raise InputError(f"{name}: found a position that is not finite, expected metres")
    for name, array in (("first", first), ("right", right), ("matched", matched)):
        if len(array) != len(queries):
            raise InputError(f"{name}: found {len(array)}, expected {len(queries)} as of queries")
    if placed is None:
        placed = Placed(np.ones(len(database), bool), np.ones(len(queries), bool), np.inf)
    points = np.concatenate([database[placed.database], queries[placed.queries]])
    low, span = points.min(axis=0), np.ptp(points, axis=0)
    # A narrow place gets room around it, so that nothing is squeezed into a line.
    widened = np.maximum(span, max(span.max() / 2.5, 1))
    margin = (widened - span) / 2 + 0.04 * widened.max()
    limits = np.stack([-margin, span + margin], 1)
    ratio = np.ptp(limits[1]) / np.ptp(limits[0])
    layout = ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.08)
    figure = Figure(figsize=(NARROW, 1.0 + 3.2 * ratio), layout=layout)
    axes = figure.add_subplot()
    axes.set(xlim=limits[0], ylim=limits[1], aspect="equal")

    database, queries = database - low, queries - low
    size = float(np.clip(4000 / len(points), 2, 18))
    axes.scatter(
        *database[placed.database].T, s=2.5 * size, c=PLAIN, linewidths=0, label="database"
    )
    wrong = matched & ~right
    joined = wrong & placed.queries & placed.database[first]
    lines = np.stack([queries[joined], database[first[joined]]], axis=1)
    # Paler where there are many, so that what is below them shows.
    alpha = float(np.clip(60 / max(len(lines), 1), 0.05, 0.45))
    axes.add_collection(LineCollection(lines.tolist(), colors=WRONG, linewidths=0.6, alpha=alpha))
    kinds = (
        ("right", right, {"c": RIGHT, "marker": "o", "linewidths": 0}),
        ("wrong", wrong, {"c": WRONG, "marker": "x", "linewidths": 1}),
        (
            "no positive exists",
            ~matched & ~right,
            {"facecolors": "none", "edgecolors": UNMATCHED, "marker": "^", "linewidths": 0.8},
        ),
    )
    for label, of_kind, marks in kinds:
        mask = of_kind & placed.queries
        if mask.any():
            axes.scatter(*queries[mask].T, s=1.4 * size, label=f"{label} ({mask.sum()})", **marks)
    axes.set_xlabel("metres east of the westernmost image", fontsize=10, color=INK)
    axes.set_ylabel("metres north", fontsize=10, color=INK)
    axes.tick_params(colors=GREY, labelcolor=INK, labelsize=9)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.grid(color=PALE, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[:].set_color(PALE)
    where = {"loc": "outside upper left", "ncols": 2, "markerscale": 1.3}
    figure.legend(frameon=False, fontsize=9, labelcolor=INK, **where)
    save(figure, path, NARROW_DPI, dark=True)
