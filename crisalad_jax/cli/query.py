"""`crisalad query`."""

import contextlib
import dataclasses
import pathlib
from typing import Annotated

import tyro

from crisalad_jax.cli.common import STDOUT, console, find_given, say, talk_beside
from crisalad_jax.cli.tables import answers_table
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.query import json_lines, query, write_answers
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, check_target, real_path

_ROWS = 24
"""Largest number of queries in a gallery."""
_COLUMNS = 8
"""Largest number of answers to each query in a gallery."""


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
    """The model that made the map, as a file or a published name; by default where it was then."""
    k: int = 5
    """Answers to each query."""
    exact: bool = False
    """Search exactly, although the map has an approximate search."""
    json: pathlib.Path | None = None
    """File for the answers, a line of JSON for each query; - prints them."""
    gallery: pathlib.Path | None = None
    """PNG of up to 24 queries beside up to 8 answers each."""
    map_images: pathlib.Path | None = None
    """Folder of the map's images, for the gallery, if they are not where they were."""
    batch_size: int = 16
    """Images described at once, each as if it were alone."""
    verify: bool = True
    """Check the map's descriptors against their checksums; --no-verify skips that, where files are
    huge."""
    max_pixels: int = 2**28
    """Pixels that an image file may have; larger ones are not decoded."""
    plugin: tuple[str, ...] = ()
    """Files FILE.py or modules that register parts of your own; their code is run."""
    quiet: bool = False
    """No progress bars."""


def run(arguments: Query) -> None:
    """Query the map, and print or write its answers."""
    file = None if arguments.json == STDOUT else arguments.json
    talk_beside(arguments.json)
    _check_files(file, arguments)
    with Map.open(arguments.map, verify=arguments.verify) as places:
        answers = query(
            places,
            places.load_params(find_given(arguments.weights, quiet=arguments.quiet)),
            arguments.images,
            k=arguments.k,
            exact=arguments.exact,
            batch_size=arguments.batch_size,
            quiet=arguments.quiet,
        )
    of = f"in a map of {len(answers.images)} images"
    if arguments.json is None and arguments.gallery is None:
        title = f"{arguments.map}, {len(answers.images)} images"
        console.print(answers_table(answers, title))
    elif file is None and arguments.json is not None:
        for line in json_lines(answers):
            print(line)
    with contextlib.ExitStack() as staged:  # so that both files appear, or none
        if arguments.gallery is not None:
            from crisalad_jax.experiments.report import answers_gallery

            answers_gallery(
                staged.enter_context(atomic_path(arguments.gallery)),
                answers,
                root=arguments.map_images,
                rows=_ROWS,
                columns=_COLUMNS,
                title=str(arguments.map),
            )
        if file is not None:
            write_answers(file, answers)
    if arguments.gallery is not None:
        shown = f"{_ROWS} of " if len(answers.queries) > _ROWS else ""
        say(f"{arguments.gallery}: {shown}{len(answers.queries)} queries {of}")
    if file is not None:
        say(f"{file}: {len(answers.queries)} queries {of}")


def _check_files(file: pathlib.Path | None, arguments: Query) -> None:
    """Check before any work that the files can be written."""
    gallery = arguments.gallery
    if file is not None:
        check_target(file)
    if gallery is not None:
        check_target(gallery)
    elif arguments.map_images is not None:
        raise InputError("--map-images: found without --gallery, expected both")
    if gallery is not None and file is not None and real_path(file) == real_path(gallery):
        raise InputError(f"--gallery: found {gallery}, as --json, expected two files")
