"""`crisalad query`."""

import contextlib
import dataclasses
import json
import pathlib
import sys
from collections.abc import Iterator
from typing import Annotated, Any, TextIO

import numpy as np
import rich.table
import rich.text
import tyro

from crisalad_jax.checkpoint import load_weights, model_hash
from crisalad_jax.cli.common import console
from crisalad_jax.data.images import list_images
from crisalad_jax.errors import InputError
from crisalad_jax.files import atomic_path, check_target
from crisalad_jax.groupings import check_grouping
from crisalad_jax.indexing import describe_alone
from crisalad_jax.map_description import check_model, read_description
from crisalad_jax.maps import Map, open_map
from crisalad_jax.model import Crisalad
from crisalad_jax.progress import progress_bar
from crisalad_jax.retrieval import Neighbours

_AT_ONCE = 1024
"""Queries that are searched for together: the map is read once for so many."""
_ROWS = 24
"""Queries in a gallery, at most."""
_COLUMNS = 8
"""Answers to each, at most."""


@dataclasses.dataclass(frozen=True)
class Query:
    """Find the images of a map that are most similar to others, and say where they were taken."""

    images: Annotated[
        tuple[pathlib.Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="IMAGE...")
    ]
    """Images, or folders of them."""
    map: pathlib.Path
    """Folder that `crisalad index` wrote."""
    weights: pathlib.Path | None = None
    """The model that made the map, by default where it was then."""
    k: int = 5
    """Answers to each query."""
    json: pathlib.Path | None = None
    """File for the answers, a line of JSON for each query; - prints them."""
    gallery: pathlib.Path | None = None
    """PNG of up to 24 queries beside up to 8 answers each."""
    map_images: pathlib.Path | None = None
    """Folder of the map's images, for the gallery, if they are not where they were."""
    batch_size: int = 16
    """Images described at once, each as if it were alone."""
    quiet: bool = False
    """No progress bars."""


def run(arguments: Query) -> None:
    """Describe the queries, search, and answer."""
    check_grouping((), arguments.batch_size, seed=0)
    if arguments.k < 1:
        raise InputError(f"k: found {arguments.k}, expected at least 1")
    printed = arguments.json == pathlib.Path("-")
    if arguments.json is not None and not printed:
        check_target(arguments.json)
    _check_gallery(arguments)
    paths = _listed(arguments.images)
    params = _model_of(arguments)
    with open_map(arguments.map) as opened, contextlib.ExitStack() as stack:
        lines = None
        if arguments.json is not None:
            lines = sys.stdout if printed else stack.enter_context(_written(arguments.json))
        table = None
        if arguments.json is None and arguments.gallery is None:
            table = _table(opened)
        found: list[Neighbours] = []
        for queries, neighbours in _answers(arguments, opened, params, paths):
            for path, answers in zip(queries, _answers_of(opened, neighbours), strict=True):
                if lines is not None:
                    line = {"query": path.as_posix(), "neighbours": answers}
                    print(json.dumps(line, ensure_ascii=False), file=lines, flush=printed)
                if table is not None:
                    _add_rows(table, path, answers)
            if arguments.gallery is not None:
                found.append(Neighbours(*(array[:, :_COLUMNS] for array in neighbours)))
        if arguments.gallery is not None:
            _draw(arguments, opened, paths, found)
    if table is not None:
        console.print(table)
    for path, most in ((arguments.gallery, _ROWS), (None if printed else arguments.json, None)):
        if path is not None:
            console.print(
                f"{path}: {_some(len(paths), most)} queries in a map of {len(opened)} images",
                soft_wrap=True,
            )


def _check_gallery(arguments: Query) -> None:
    if arguments.gallery is None:
        if arguments.map_images is not None:
            raise InputError("--map-images: found without --gallery, expected both")
        return
    check_target(arguments.gallery)
    if arguments.json is not None and arguments.json.resolve() == arguments.gallery.resolve():
        raise InputError(f"--gallery: found {arguments.gallery}, as --json, expected two files")


def _some(count: int, most: int | None) -> str:
    return f"{count}" if most is None or count <= most else f"{most} of {count}"


def _listed(images: tuple[pathlib.Path, ...]) -> list[pathlib.Path]:
    if not images:
        raise InputError("IMAGE: found none, expected images or folders of them")
    return [
        path for image in images for path in (list_images(image) if image.is_dir() else [image])
    ]


def _model_of(arguments: Query) -> Crisalad:
    description = read_description(arguments.map)
    if description is None:
        raise InputError(
            f"{arguments.map}: found no map, expected a folder that `crisalad index` wrote"
        )
    weights = arguments.weights or pathlib.Path(description.weights)
    if arguments.weights is None and not weights.is_file():
        raise InputError(
            f"{arguments.map}: found no {weights}, which made this map, expected it there or as "
            "--weights"
        )
    params, config = load_weights(weights)
    check_model(description, arguments.map, model_hash(params, config), weights)
    return params


def _answers(
    arguments: Query, opened: Map, params: Crisalad, paths: list[pathlib.Path]
) -> Iterator[tuple[list[pathlib.Path], Neighbours]]:
    """Queries and what was found, `_AT_ONCE` at a time or a batch more."""
    done = 0
    waiting: list[np.ndarray] = []
    stream = describe_alone(
        params, opened.description.config, paths, batch_size=arguments.batch_size
    )
    with progress_bar("queries", len(paths), "images", quiet=arguments.quiet) as bar:
        for part in stream:
            waiting.append(part.descriptors)
            bar.advance(len(part.indices))
            described = done + sum(map(len, waiting))
            if described - done >= _AT_ONCE or described == len(paths):
                neighbours = opened.search(np.concatenate(waiting), arguments.k)
                yield paths[done:described], neighbours
                done = described
                waiting.clear()


def _answers_of(opened: Map, neighbours: Neighbours) -> Iterator[list[dict[str, Any]]]:
    """For each query, its answers as JSON has them."""
    for indices, similarities in zip(*neighbours, strict=True):
        answers = []
        for rank, (index, similarity) in enumerate(zip(indices, similarities, strict=True), 1):
            image = opened.images[index]
            position = None
            if image.position is not None and opened.axes is not None:
                position = dict(zip(opened.axes, image.position, strict=True))
            answers.append(
                {
                    "rank": rank,
                    "name": image.name,
                    "similarity": round(float(similarity), 6),
                    "position": position,
                }
            )
        yield answers


@contextlib.contextmanager
def _written(path: pathlib.Path) -> Iterator[TextIO]:
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        yield file


def _table(opened: Map) -> rich.table.Table:
    table = rich.table.Table(title=f"{opened.folder}, {len(opened)} images", title_justify="left")
    table.add_column("query", overflow="fold")
    table.add_column("rank", justify="right")
    table.add_column("name", overflow="fold")
    table.add_column("similarity", justify="right", no_wrap=True)
    table.add_column(", ".join(opened.axes or ("position",)), justify="right", overflow="fold")
    return table


def _add_rows(table: rich.table.Table, query: pathlib.Path, answers: list[dict[str, Any]]) -> None:
    for answer in answers:
        rank, position = answer["rank"], answer["position"]
        cells = (
            query.as_posix() if rank == 1 else "",
            str(rank),
            answer["name"],
            f"{answer['similarity']:.3f}",
            "-" if position is None else ", ".join(f"{value:.9g}" for value in position.values()),
        )
        # Text: square brackets in a name are no markup.
        table.add_row(*map(rich.text.Text, cells), end_section=rank == len(answers))


def _draw(
    arguments: Query, opened: Map, paths: list[pathlib.Path], found: list[Neighbours]
) -> None:
    from crisalad_jax.report import prediction_gallery

    assert arguments.gallery is not None
    indices, similarities = map(np.concatenate, zip(*found, strict=True))
    used, places = np.unique(indices, return_inverse=True)
    images = [opened.images[number] for number in used]
    roots = [arguments.map_images or pathlib.Path(image.root) for image in images]
    prediction_gallery(
        arguments.gallery,
        paths,
        [root / image.name for root, image in zip(roots, images, strict=True)],
        places.reshape(indices.shape),
        similarities,
        None,
        rows=_ROWS,
        columns=_COLUMNS,
        names=([path.as_posix() for path in paths], [image.name for image in images]),
        title=str(arguments.map),
    )
