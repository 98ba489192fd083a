"""`crisalad query`."""

import contextlib
import dataclasses
import importlib
import pathlib
from typing import Annotated, Literal

import tyro

from crisalad_jax.cli import live
from crisalad_jax.cli.answers import answer_lines
from crisalad_jax.cli.common import STDOUT, RuntimeName, check_json, say, talk_beside
from crisalad_jax.cli.flags import ReadFlags
from crisalad_jax.retrieval.maps.calibration import Calibration
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.query import Answers, json_lines, query, write_answers
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, check_format, check_target, real_path
from crisalad_jax.utils.output import counted

_ROWS = 24
"""Largest number of queries in a gallery."""
_COLUMNS = 8
"""Largest number of answers to each query in a gallery."""


COMMON = (
    "images",
    "map",
    "watch",
    "camera",
    "fps",
    "window",
    "weights",
    "k",
    "min-similarity",
    "sequence",
    "json",
    "gallery",
    "map-images",
    "batch-size",
    "on-bad-image",
    "quiet",
)
EXAMPLE = "crisalad query new.jpg --map map --json -"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Query(ReadFlags):
    """Find the images of a map that are most similar to others, and say where they were taken."""

    images: Annotated[
        tuple[pathlib.Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="IMAGE...")
    ]
    """Images, or folders of them, patterns, lists, tables or videos (docs/how-to/image-sources.md).
    None with --watch and --camera."""
    map: pathlib.Path
    """Folder that `crisalad index` wrote."""
    watch: pathlib.Path | None = None
    """Folder: answer the images that appear in it as they appear, a line of JSON each."""
    camera: str | None = None
    """Number from 0, URL or video file: answer its newest frame, time and again."""
    fps: float | None = None
    """Frames a second taken of a video, by default 1; the most that --camera answers."""
    window: int = 1
    """Frames described together, each with those just before it: a moving camera's."""
    weights: pathlib.Path | None = None
    """The model that made the map, as a file or a published name; by default where it was then."""
    runtime: RuntimeName = "jax"
    """What computes the model: jax, onnxruntime or openvino (docs/export.md). Weights are exported
    for it once; --weights may be an exported folder."""
    k: int = 5
    """Answers to each query."""
    min_similarity: float | None = None
    """A query to which no image is that similar is of an unknown place; by default what `crisalad
    calibrate` measured for this map. -1 answers every query."""
    sequence: Literal["bayes"] | None = None
    """The queries are consecutive frames of one camera: bayes, a filter, weighs those so far
    (docs/maps.md)."""
    sequence_reach: float | None = None
    """How many times as fast as the map's camera this one moves, at most; by default 2. Where names
    say no times or positions, images of the map a frame."""
    exact: bool = False
    """Search exactly, although the map has an approximate search."""
    json: pathlib.Path | None = None
    """File for the answers: .jsonl, a line of JSON for each query, or .json, a list; - prints
    lines."""
    gallery: pathlib.Path | None = None
    """PNG of up to 24 queries beside up to 8 answers each."""
    map_images: pathlib.Path | None = None
    """Folder of the map's images, for the gallery, if they are not where they were."""
    verify: bool = True
    """Check the map's descriptors, and an exported model, against their checksums; --no-verify
    skips that, where files are huge."""


def needs_jax(arguments: Query) -> bool:
    """Return whether JAX describes the images: another runtime starts without importing it."""
    return arguments.runtime == "jax"


def run(arguments: Query) -> None:
    """Query the map, and print or write its answers."""
    if arguments.watch is not None or arguments.camera is not None:
        live.run(arguments)
        return
    file = None if arguments.json == STDOUT else arguments.json
    talk_beside(arguments.json)
    _check_files(file, arguments)
    sequence = live.sequence_of(arguments)
    opened = Map.open(
        arguments.map, verify=arguments.verify, calibrated=arguments.min_similarity is None
    )
    with opened as places:
        answers = query(
            places,
            arguments.images,
            model=live.model_of(places, arguments),
            k=arguments.k,
            fps=arguments.fps,
            window=arguments.window,
            exact=arguments.exact,
            min_similarity=arguments.min_similarity,
            sequence=sequence,
            reading=arguments.reading,
        )
    unknown = _unknown(answers, places.calibration)
    if answers.unreadable:
        say(f"{len(answers.unreadable)} unreadable left out, {answers.unreadable[0]} the first")
    asked = f"{len(answers.queries)} {'query' if len(answers.queries) == 1 else 'queries'}"
    of = f"in a map of {counted(len(answers.images), 'image')}{unknown}"
    if arguments.json is None:
        say(f"{arguments.map}, {counted(len(answers.images), 'image')}{unknown}")
        say("\n".join(answer_lines(answers)))
    elif file is None:
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
        say(f"{arguments.gallery}: {shown}{asked} {of}")
    if file is not None:
        say(f"{file}: {asked} {of}")


def _unknown(answers: Answers, measured: Calibration | None) -> str:
    """Say how many queries are of unknown places; nothing where any similarity counts.

    Also what the similarity rests on, where it was measured.
    """
    if answers.min_similarity is None:
        return ""
    count, least = int((~answers.known).sum()), f"{answers.min_similarity:.9g}"
    rests = "" if measured is None else f" (rests on {counted(measured.answered, 'answer')})"
    return f"; {count} of {len(answers.queries)} unknown, below similarity {least}{rests}"


def _check_files(file: pathlib.Path | None, arguments: Query) -> None:
    """Check before any work that the files can be written."""
    gallery = arguments.gallery
    check_json(file, (".json", ".jsonl"))
    if gallery is not None:
        importlib.import_module("crisalad_jax.experiments.report")  # or its extra is missing
        check_format("--gallery", gallery, ".png")
        check_target(gallery)
    elif arguments.map_images is not None:
        raise InputError("--map-images: found without --gallery, expected both")
    if gallery is not None and file is not None and real_path(file) == real_path(gallery):
        raise InputError(f"--gallery: found {gallery}, as --json, expected two files")
