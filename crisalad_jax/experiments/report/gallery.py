"""Galleries of queries and what was retrieved for them."""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from matplotlib.axes import Axes

from crisalad_jax.config.checks import check_count
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.images import read_image
from crisalad_jax.data.resize import resize_image
from crisalad_jax.evaluation.results import GroupingResult
from crisalad_jax.experiments.report.style import (
    DPI,
    GREY,
    INK,
    RIGHT,
    WRONG,
    Picture,
    fit_width,
    save,
)
from crisalad_jax.retrieval.maps.query import Answers
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.locks import staged_folder
from crisalad_jax.utils.output import counted, warn

_BOX = 0xC4
"""Grey of a picture that is not there."""
_NAME = 28
"""Largest number of characters of a name: at 7 points they are as wide as a picture."""


def prediction_gallery(path: str | os.PathLike[str], *found: Any, **options: Any) -> None:
    """Write a PNG of queries with what was retrieved for them: see `retrieval_figure`."""
    save(retrieval_figure(*found, **options), path)


def retrieval_figure(
    queries: Sequence[Path],
    database: Sequence[Path],
    indices: Int[np.ndarray, "q k"],
    similarities: Float[np.ndarray, "q k"],
    positives: Sequence[Int[np.ndarray, " _"]] | None,
    *,
    rows: int = 6,
    columns: int = 4,
    chosen: Sequence[int] | None = None,
    title: str = "",
    names: tuple[Sequence[str], Sequence[str]] | None = None,
    elsewhere: str | None = None,
) -> Picture:
    """Draw queries, one a row, with what was retrieved for them, best first.

    Retrievals are framed green where right and red where wrong, with rank and similarity below.
    Unless queries are `chosen`, half of the rows have a right first retrieval and half a wrong one,
    as far as there are both. Each half is spread evenly over the data set, so that the same input
    gives the same picture. Without `positives` all are framed grey, and queries spread evenly.

    Args:
        queries: image files of the q queries.
        database: image files that `indices` count.
        indices: database indices retrieved for each query, best first.
        similarities: those of `indices`.
        positives: the database indices that are right for each query; None where that is unknown.
        rows: queries shown, at most q, where none are chosen.
        columns: retrievals shown for each, at most k.
        chosen: the queries shown, in their order.
        title: stands above the picture.
        names: of the queries and of the database, to stand below each, shortened in the middle.
        elsewhere: what says where else the database's images may be. With it, one that cannot be
            read is a grey box, and a note says so.

    Returns:
        The figure.

    Raises:
        InputError: no queries or retrievals, numbers of rows that differ, an index beyond the
            database, rows or columns below 1, or another image that cannot be read.
    """
    _check_gallery(queries, database, indices, similarities, positives)
    for name, value in (("rows", rows), ("columns", columns)):
        check_count(name, value)
    shown = indices[:, :columns]
    right = None
    if positives is not None:
        verdicts = zip(shown, positives, strict=True)
        right = np.stack([np.isin(row, wanted) for row, wanted in verdicts])
    if chosen is None and right is not None:
        chosen = _choose_queries(right[:, 0], rows)
    elif chosen is None:
        chosen = _evenly(np.arange(len(queries)), min(rows, len(queries)))

    # In inches. Frames and captions are drawn into the gaps.
    width, gap, margin = 1.7, 0.16, 0.25
    between = 0.34 if names is None else 0.48
    head = 0.85 if title else 0.55
    side = round(width * DPI)
    thumbnails = {
        queries[i]: thumbnail(read_image(queries[i], bit_depth="contrast-stretch"), side)
        for i in chosen
    }
    lost: dict[Path, InputError] = {}
    for file in dict.fromkeys(database[index] for query in chosen for index in shown[query]):
        try:
            thumbnails[file] = thumbnail(read_image(file, bit_depth="contrast-stretch"), side)
        except InputError as error:
            if elsewhere is None:
                raise
            lost[file] = error
    aspect = float(np.median([image.shape[0] / image.shape[1] for image in thumbnails.values()]))
    height = width * min(max(aspect, 0.5), 1.5)
    if lost:
        box = np.full((round(height * DPI), side, 3), _BOX, np.uint8)
        thumbnails |= dict.fromkeys(lost, box)
        warn(
            f"{counted(len(lost), 'picture')} shown as a grey box, as of "
            f"{next(iter(lost.values()))}; {elsewhere} says where else"
        )
    count = 1 + shown.shape[1]
    # One more gap sets the queries apart.
    size = (
        2 * margin + count * width + count * gap,
        margin + head + len(chosen) * (height + between),
    )
    figure = Picture(figsize=size)

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
        _caption(axes, f"query {query}{note}", INK)
        axes.spines[:].set(color=GREY, linewidth=0.5)
        if names is not None:
            _name(axes, names[0][query])
        for rank, index in enumerate(shown[query]):
            axes = place(row, rank + 1, thumbnails[database[index]])
            if names is not None:
                _name(axes, names[1][int(index)])
            caption = f"{rank + 1}   {similarities[query, rank]:.3f}"
            if right is None:
                axes.spines[:].set(color=GREY, linewidth=0.5)
                _caption(axes, caption, INK)
                continue
            good = right[query, rank]
            colour = RIGHT if good else WRONG
            axes.spines[:].set(color=colour, linewidth=3)
            # The sign is for readers who cannot tell green from red.
            sign = "\N{CHECK MARK}" if good else "\N{BALLOT X}"
            _caption(axes, f"{caption}   {sign}", colour)

    left = margin / size[0]
    top = 1 - 0.2 / size[1]
    if title:
        fit_width(figure.text(left, top, title, fontsize=13, color=INK, va="top"), figure)
        top -= 0.3 / size[1]
    parts = [("query, then retrievals: rank, similarity", GREY)]
    if right is not None:
        parts += [
            (", ", GREY),
            ("\N{CHECK MARK} right   ", RIGHT),
            ("\N{BALLOT X} wrong", WRONG),
        ]
    for text, colour in parts:
        drawn = figure.text(left, top, text, fontsize=9, color=colour, va="top")
        left += drawn.get_window_extent().width / figure.bbox.width
    return figure


def write_galleries(
    out: str | os.PathLike[str],
    benchmark: Benchmark,
    results: Sequence[GroupingResult],
    *,
    model_name: str,
) -> list[Path]:
    """Write a gallery of retrievals for each result of an evaluation.

    Args:
        out: the folder, made where it is missing.
        benchmark: what was evaluated on.
        results: what `evaluate` returned.
        model_name: which weights, for the titles.

    Returns:
        The pictures, gallery_GROUPING.png.

    Raises:
        InputError: an image cannot be read, or a picture not be written.
    """
    names = []
    with staged_folder(out) as folder:
        for result in results:
            label = re.sub(r"[/:]", "-", result.label).replace(" + ", "_")
            names.append(f"gallery_{label}.png")
            prediction_gallery(
                folder / names[-1],
                benchmark.queries,
                benchmark.database,
                *result.neighbours,
                benchmark.ground_truth(),
                title=f"{benchmark.name}, {model_name}, {result.label}",
            )
    return [Path(out) / name for name in names]


def answers_gallery(path: str | os.PathLike[str], answers: Answers, **options: Any) -> None:
    """Write a PNG of queries to a map, one a row, beside their answers: see `answers_figure`."""
    save(answers_figure(answers, **options), path)


def answers_figure(
    answers: Answers,
    *,
    root: str | os.PathLike[str] | None = None,
    rows: int = 24,
    columns: int = 8,
    chosen: Sequence[int] | None = None,
    title: str = "",
) -> Picture:
    """Draw queries to a map, one a row, beside their answers.

    Args:
        answers: what `retrieval.maps.query.query` returned.
        root: folder of the map's images; None is where they were. One that is not there is a grey
            box, and a note says so.
        rows: number of queries shown, at most.
        columns: number of answers to each, at most.
        chosen: the queries shown, in their order.
        title: stands above the picture.

    Returns:
        The figure.

    Raises:
        InputError: rows or columns below 1, or a query that cannot be read.
    """
    indices, similarities = (part[:, :columns] for part in answers.neighbours)
    used, places = np.unique(indices, return_inverse=True)
    images = [answers.images[number] for number in used]
    asked = [
        name if known else f"unknown: {name}"
        for name, known in zip(answers.names, answers.known, strict=True)
    ]
    return retrieval_figure(
        answers.queries,
        [Path(image.root if root is None else root) / image.name for image in images],
        places.reshape(indices.shape),
        similarities,
        None,
        rows=rows,
        columns=columns,
        chosen=chosen,
        names=(asked, [image.name for image in images]),
        title=title,
        elsewhere="--map-images (root=)",
    )


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
    for name, given in (("queries", queries), ("positives", positives)):
        if given is not None and len(given) != len(indices):
            raise InputError(f"{name}: found {len(given)}, expected {len(indices)} as of indices")
    if indices.min() < 0 or indices.max() >= len(database):
        raise InputError(
            f"indices: found {indices.min()} to {indices.max()}, expected 0 to "
            f"{len(database) - 1}, positions in the database"
        )


def _choose_queries(right: Bool[np.ndarray, " q"], rows: int) -> list[int]:
    """Choose right queries, then wrong ones: half each, more of one kind if the other is short."""
    good, bad = np.flatnonzero(right), np.flatnonzero(~right)
    good_count = min(len(good), max(rows - rows // 2, rows - len(bad)))
    bad_count = min(len(bad), rows - good_count)
    return _evenly(good, good_count) + _evenly(bad, bad_count)


def _evenly(queries: Int[np.ndarray, " n"], count: int) -> list[int]:
    """Choose `count` queries, evenly spaced from the first to the last."""
    places = np.linspace(0, len(queries) - 1, count).round().astype(int)
    return queries[places].tolist()


def thumbnail(image: UInt8[np.ndarray, "h w 3"], side: int) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Shrink a photograph to at most `side` pixels, so that a page of them fits in memory."""
    factor = side / max(image.shape)
    if factor >= 1:
        return image
    height, width = (max(1, round(factor * length)) for length in image.shape[:2])
    return resize_image(image, (height, width))


def _caption(axes: Axes, text: str, colour: str) -> None:
    axes.set_xlabel(text, fontsize=9, color=colour, loc="left", labelpad=4)


def _name(axes: Axes, name: str) -> None:
    # The name stands below the caption; a dollar sign in it starts no formula.
    axes.annotate(
        shortened(name, _NAME),
        (0, 0),
        xycoords="axes fraction",
        xytext=(0, -18),
        textcoords="offset points",
        va="top",
        fontsize=7,
        family="monospace",
        color=GREY,
        parse_math=False,
    )


def shortened(text: str, most: int) -> str:
    """Shorten a text to at most `most` characters, of its beginning and its end."""
    if len(text) <= most:
        return text
    end = (most - 1) // 2
    return f"{text[: most - 1 - end]}\N{HORIZONTAL ELLIPSIS}{text[len(text) - end :]}"
