"""Galleries of queries and their retrievals."""

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int, UInt8
from matplotlib.axes import Axes
from matplotlib.patches import ConnectionPatch

from crisalad_jax.config.checks import takes
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.images import read_image
from crisalad_jax.data.resize import resize_image
from crisalad_jax.evaluation.metrics import right_retrievals
from crisalad_jax.evaluation.results import GroupingResult
from crisalad_jax.experiments.report.style import (
    GREY,
    INK,
    RIGHT,
    WRONG,
    Picture,
    new_figure,
    save,
)
from crisalad_jax.retrieval.maps.query import Answers
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import counted, warn

_DPI = 120
_WIDTH, _GAP = 1.7, 0.26
"""Inches of a picture, and between pictures."""
_LINES = 40
"""Largest number of lines between inliers."""
_BOX = 0xC4
"""Grey level of a missing picture."""
_NAME = 28
"""Largest number of characters of a name: at 7 points they are as wide as a picture."""


@takes(found=(Answers, GroupingResult), benchmark=(Benchmark, type(None)))
def show_retrievals(
    found: Answers | GroupingResult,
    benchmark: Benchmark | None = None,
    *,
    queries: Sequence[int] | None = None,
    rows: int = 4,
    columns: int = 4,
    root: str | os.PathLike[str] | None = None,
    title: str = "",
) -> Picture:
    """Draw queries, one per row, with their retrievals, best first.

    Results of an evaluation are framed green if correct and red if wrong, with a mark for readers
    who cannot see the difference. Answers of a map are framed grey, as their correctness is
    unknown. If answers are verified, lines join the inliers of a query and its best answer.

    Args:
        found: answers of `query`, or one of the results of `evaluate`.
        benchmark: for a result, the evaluated benchmark without unreadable images; else None.
        queries: indices of the queries to show, in this order. None takes evenly spaced ones; of a
            result, half of them correct and half wrong.
        rows: maximum number of queries shown if `queries` is None.
        columns: maximum number of retrievals shown for each query.
        root: for answers, folder of the map's images; None is the one that was indexed. A missing
            image is a grey box, with a warning.
        title: title above the picture.

    Returns:
        A figure for notebooks; `figure.savefig(path)` writes it as PNG, SVG or PDF.

    Raises:
        InputError: `found` is of another class; a result has no benchmark, or answers have one; no
            query is chosen, or an index is out of range; or an image cannot be read.

    Example:
        >>> import numpy as np, pathlib
        >>> from crisalad_jax import MapImage, Neighbours
        >>> near = Neighbours(np.array([[0, 1]]), np.array([[1.0, 0.5]]))
        >>> images = [MapImage(f"{n}.png", 1, None, str(pictures)) for n in range(4)]
        >>> figure = show_retrievals(Answers([pictures / "0.png"], near, images, None))
        >>> [axes.get_xlabel() for axes in figure.axes]
        ['query 0', '1   1.000', '2   0.500']
    """
    is_result = isinstance(found, GroupingResult)
    if is_result != (benchmark is not None):
        raise InputError(
            f"benchmark: found {'none' if is_result else 'one'} for "
            f"{'a result of evaluate' if is_result else 'answers of a map'}, expected it only "
            "for results"
        )
    count = len(found.neighbours.indices)
    right = np.ones(count, bool)
    if benchmark is not None:
        right = first_right_ranks(found.neighbours, benchmark.ground_truth()) == 1
    chosen = _half_right(right, rows) if queries is None else list(queries)
    if not chosen or not all(0 <= query < count for query in chosen):
        raise InputError(f"queries: found {chosen}, expected numbers from 0 to {count - 1}")
    if isinstance(found, Answers):
        tiles = [list(_answers(found, query, columns, root)) for query in chosen]
    else:
        assert benchmark is not None
        tiles = [list(_results(found, benchmark, query, columns)) for query in chosen]
    return _draw(tiles, title, strict=is_result)


def write_galleries(
    out: Path, benchmark: Benchmark, results: Sequence[GroupingResult], *, model_name: str
) -> None:
    """Write a gallery of queries and retrievals, gallery_GROUPING.png, for each result.

    Args:
        out: the folder, created if missing.
        benchmark: the evaluated benchmark, without unreadable images.
        results: what `evaluate` returned.
        model_name: name of the model, for the titles.

    Raises:
        InputError: an image cannot be read, or a picture cannot be written.
    """
    for result in results:
        label = re.sub(r"[/:]", "-", result.label).replace(" + ", "_")
        title = f"{benchmark.name}, {model_name}, {result.label}"
        figure = show_retrievals(result, benchmark, rows=6, title=title)
        save(figure, out / f"gallery_{label}.png")


def first_right_ranks(
    neighbours: Neighbours, positives: Sequence[Int[np.ndarray, " _"]]
) -> Int[np.ndarray, " q"]:
    """Find the rank of each query's first correct retrieval, from 1; 0 if none is correct."""
    right = right_retrievals(neighbours.indices, positives)
    return np.where(right.any(axis=1), right.argmax(axis=1) + 1, 0)


def thumbnail(image: UInt8[np.ndarray, "h w 3"], side: int) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Shrink a photograph until its longer side has at most `side` pixels; never enlarge it."""
    factor = side / max(image.shape)
    if factor >= 1:
        return image
    height, width = (max(1, round(factor * length)) for length in image.shape[:2])
    return resize_image(image, (height, width))


def evenly(queries: Int[np.ndarray, " n"], most: int) -> list[int]:
    """Choose at most `most` queries, evenly spaced from the first to the last."""
    places = np.linspace(0, len(queries) - 1, min(most, len(queries))).round().astype(int)
    return queries[places].tolist()


def _half_right(right: Bool[np.ndarray, " q"], rows: int) -> list[int]:
    """Choose correct queries, then wrong ones: half each, more of one if the other is short."""
    good, bad = np.flatnonzero(right), np.flatnonzero(~right)
    good_count = min(len(good), max(rows - rows // 2, rows - len(bad)))
    return evenly(good, good_count) + evenly(bad, rows - good_count)


class _Tile(NamedTuple):
    """A picture of a gallery, with the text below it."""

    file: Path
    caption: str
    colour: str = INK
    """Colour of the caption, and of the frame of a correct or wrong retrieval."""
    name: str = ""
    joined: tuple[np.ndarray, np.ndarray] | None = None
    """Pixels of inliers in the query's file and in this one."""


class _Shown(NamedTuple):
    """A picture as it is drawn."""

    pixels: UInt8[np.ndarray, "h w 3"]
    factor: float
    """Its pixels per pixel of the file."""


def _captions(found: Answers | GroupingResult, query: int, columns: int) -> Iterator[tuple]:
    """Yield the index of each retrieval, and its rank and similarity as text."""
    pairs = zip(*(each[query, :columns] for each in found.neighbours), strict=True)
    for rank, (index, similarity) in enumerate(pairs, 1):
        yield index, f"{rank}   {similarity:.3f}"


def _answers(
    found: Answers, query: int, columns: int, root: str | os.PathLike[str] | None
) -> Iterator[_Tile]:
    """Yield the tiles of a query and of a map's answers."""
    name = found.names[query] if found.known[query] else f"unknown: {found.names[query]}"
    yield _Tile(found.queries[query], f"query {query}", name=name)
    checks, is_best = iter(found.checks[query] if found.checks else ()), True
    for index, caption in _captions(found, query, columns):
        image = found.images[index]
        file = Path(image.root if root is None else root) / image.name
        check = next(checks, None)
        joined = None
        if check is not None:
            caption = f"{caption}   {counted(check.inliers, 'inlier')}"
            joined = (check.query_points, check.database_points) if is_best else None
        yield _Tile(file, caption, name=image.name, joined=joined)
        is_best = False


def _results(
    found: GroupingResult, benchmark: Benchmark, query: int, columns: int
) -> Iterator[_Tile]:
    """Yield the tiles of a query and its retrievals, correct and wrong."""
    positives = benchmark.ground_truth()[query]
    note = "" if len(positives) else ", no positive exists"
    yield _Tile(benchmark.queries[query], f"query {query}{note}")
    for index, caption in _captions(found, query, columns):
        # The sign is for readers who cannot tell green from red.
        is_right = index in positives
        sign, colour = ("\N{CHECK MARK}", RIGHT) if is_right else ("\N{BALLOT X}", WRONG)
        yield _Tile(benchmark.database[index], f"{caption}   {sign}", colour)


def _draw(rows: Sequence[Sequence[_Tile]], title: str, *, strict: bool) -> Picture:
    """Draw tiles in rows; unless `strict`, a retrieval that cannot be read is a grey box."""
    images = {row[0].file: _read(row[0].file) for row in rows}
    lost = []
    for file in dict.fromkeys(tile.file for row in rows for tile in row[1:]):
        try:
            images[file] = _read(file)
        except InputError as error:
            if strict:
                raise
            lost.append(error)
            box = np.full((round(90 * _WIDTH), round(_DPI * _WIDTH), 3), _BOX, np.uint8)
            images[file] = _Shown(box, 1.0)
    if lost:
        warn(
            f"{counted(len(lost), 'picture')} shown as a grey box (first: {lost[0]}); --map-images "
            "(root=) sets another folder"
        )
    shapes = [image.pixels.shape for image in images.values()]
    aspect = float(np.median([shape[0] / shape[1] for shape in shapes]))
    height = _WIDTH * min(max(aspect, 0.5), 1.5)
    # Frames and captions are drawn between the rows.
    below = 0.6 if any(tile.name for row in rows for tile in row) else 0.44
    size = len(rows) * (height + below) + (0.65 if title else 0.35)
    columns = len(rows[0])
    figure = new_figure(size, title, width=columns * (_WIDTH + _GAP), dpi=_DPI)
    legend = "query, then retrievals: rank, similarity"
    legend += ", \N{CHECK MARK} right, \N{BALLOT X} wrong" if strict else ""
    figure.supxlabel(legend, fontsize=9, color=GREY, x=0.02, ha="left")
    panels = figure.subplots(len(rows), columns, squeeze=False)
    for row, of_row in zip(rows, panels, strict=True):
        for tile, axes in zip(row, of_row, strict=True):
            _draw_tile(axes, tile, images[tile.file].pixels)
        if len(row) > 1 and row[1].joined is not None:
            factors = (images[tile.file].factor for tile in row[:2])
            points = [p * factor for p, factor in zip(row[1].joined, factors, strict=True)]
            _join(figure, of_row[:2], points)
    return figure


def _join(figure: Picture, panels: Sequence[Axes], points: Sequence[np.ndarray]) -> None:
    """Draw the inliers of two pictures, and lines between some of them."""
    for axes, each in zip(panels, points, strict=True):
        axes.plot(*each.T, ".", color=RIGHT, markersize=2)
    every = -(-len(points[0]) // _LINES) or 1
    look: Any = {"color": RIGHT, "linewidth": 0.4, "alpha": 0.7}
    axes = [panel.transData for panel in panels]
    for ours, theirs in zip(*(each[::every] for each in points), strict=True):
        figure.add_artist(ConnectionPatch(ours, theirs, *axes, **look))


def _draw_tile(axes: Axes, tile: _Tile, image: UInt8[np.ndarray, "h w 3"]) -> None:
    axes.imshow(image)
    axes.set(xticks=[], yticks=[], anchor="NW")
    axes.set_xlabel(tile.caption, fontsize=9, color=tile.colour, loc="left", labelpad=4)
    plain = tile.colour == INK
    axes.spines[:].set(color=GREY if plain else tile.colour, linewidth=0.5 if plain else 3)
    if tile.name:
        below = {"xycoords": "axes fraction", "xytext": (0, -18), "textcoords": "offset points"}
        # A dollar sign in a name must not start a formula.
        how = {"va": "top", "fontsize": 7, "family": "monospace", "parse_math": False}
        axes.annotate(shortened(tile.name, _NAME), (0, 0), color=GREY, **below, **how)


def _read(file: Path) -> _Shown:
    image = read_image(file, bit_depth="contrast-stretch")
    small = thumbnail(image, round(_DPI * _WIDTH))
    return _Shown(small, small.shape[1] / image.shape[1])


def shortened(text: str, most: int) -> str:
    """Shorten a text to at most `most` characters: an ellipsis replaces its middle."""
    if len(text) <= most:
        return text
    end = (most - 1) // 2
    return f"{text[: most - 1 - end]}\N{HORIZONTAL ELLIPSIS}{text[len(text) - end :]}"
