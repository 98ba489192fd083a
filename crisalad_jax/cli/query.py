"""`crisalad query`."""

import contextlib
import dataclasses
import importlib
import pathlib
import sys
from collections.abc import Iterator
from typing import Annotated, Literal

import tyro

from crisalad_jax.cli.common import STDOUT, echo, find_given, pick, refuse_with, refuse_without
from crisalad_jax.cli.flags import FrameFlags, JsonFlag, ReadFlags, RuntimeName, Target
from crisalad_jax.config.checks import require
from crisalad_jax.data.live import Camera, FolderWatch
from crisalad_jax.retrieval.maps.live import latency_words, query_live
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.query import Answers, json_lines, json_rows, query, write_answers
from crisalad_jax.retrieval.maps.tracking import SequenceSearch
from crisalad_jax.retrieval.seqslam import SeqSlam
from crisalad_jax.retrieval.sequence import BayesFilter
from crisalad_jax.utils.files import atomic_path, real_path
from crisalad_jax.utils.output import counted, printable
from crisalad_jax.utils.signals import defer_signals

_ROWS = 24
"""Largest number of queries in a gallery."""
_COLUMNS = 8
"""Largest number of answers to each query in a gallery."""


COMMON = (
    "images map watch camera fps window weights k min-similarity sequence json gallery map-images "
    "batch-size on-bad-image quiet"
)
EXAMPLE = "crisalad query new.jpg --map map --json -"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Query(ReadFlags, FrameFlags, JsonFlag):
    """Find the images of a map that are most similar to others, and say where they were taken."""

    images: Annotated[
        tuple[pathlib.Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="IMAGE...")
    ]
    """Images, or folders of them, patterns, lists, tables, videos or robot logs
    (docs/how-to/image-sources.md).
    None with --watch and --camera."""
    map: pathlib.Path
    """Folder that `crisalad index` wrote."""
    watch: pathlib.Path | None = None
    """Folder: answer the images that appear in it as they appear, a line of JSON each."""
    camera: str | None = None
    """Number from 0, URL or video file: answer its newest frame, time and again."""
    fps: float | None = None
    """Frames a second taken of a video or log, by default 1; the most that --camera answers."""
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
    sequence: Literal["bayes", "seqslam"] | None = None
    """The queries are consecutive frames of one camera: bayes, a filter, weighs those so far;
    seqslam searches lines through the last ones (docs/maps.md)."""
    sequence_reach: float | None = None
    """How many times as fast as the map's camera this one moves, at most; by default 2. Where names
    say no times or positions, images of the map a frame."""
    sequence_length: int | None = None
    """Frames that seqslam's lines go through; by default 10."""
    exact: bool = False
    """Search exactly, although the map has an approximate search."""
    json: Annotated[pathlib.Path | None, Target((".json", ".jsonl"))] = None
    """File for the answers: .jsonl, a line of JSON for each query, or .json, a list; - prints
    lines."""
    gallery: Annotated[pathlib.Path | None, Target((".png", ".svg", ".pdf"))] = None
    """PNG, SVG or PDF of up to 24 queries beside up to 8 answers each."""
    map_images: pathlib.Path | None = None
    """Folder of the map's images, for the gallery, if they are not where they were."""
    verify: bool = True
    """Check the map's descriptors, and an exported model, against their checksums; --no-verify
    skips that, where files are huge."""


def needs_jax(arguments: Query) -> bool:
    """Return whether JAX describes the images: another runtime starts without importing it."""
    return arguments.runtime == "jax"


def run(arguments: Query) -> None:
    """Query the map, and print or write its answers, also as images come."""
    if arguments.watch is not None or arguments.camera is not None:
        _run_live(arguments)
        return
    _check_files(arguments)
    sequence = _sequence_of(arguments)
    with _opened(arguments) as places:
        answers = query(
            places,
            arguments.images,
            sequence=sequence,
            **pick(arguments, "k", "fps", "topic", "window", "exact", "min_similarity", "reading"),
        )
    if answers.unreadable:
        echo(f"{len(answers.unreadable)} unreadable left out, {answers.unreadable[0]} the first")
    asked = f"{len(answers.queries)} {'query' if len(answers.queries) == 1 else 'queries'}"
    images = counted(len(answers.images), "image")
    unknown = _unknown_words(answers, places)
    file, gallery = arguments.json, arguments.gallery
    if file is None:
        echo(f"{arguments.map}, {images}{unknown}")
        echo("\n".join(answer_lines(answers)))
    elif file == STDOUT:
        for line in json_lines(answers):
            print(line)
    written = {}
    with contextlib.ExitStack() as staged:  # so that both files appear, or none
        if gallery is not None:
            from crisalad_jax.experiments.report import save, show_retrievals

            figure = show_retrievals(
                answers,
                root=arguments.map_images,
                rows=_ROWS,
                columns=_COLUMNS,
                title=str(arguments.map),
            )
            save(figure, staged.enter_context(atomic_path(gallery)))
            written[gallery] = f"{_ROWS} of {asked}" if len(answers.queries) > _ROWS else asked
        if file not in (None, STDOUT):
            write_answers(file, answers)
            written[file] = asked
    for path, words in written.items():
        echo(f"{path}: {words} in a map of {images}{unknown}")


def _check_files(arguments: Query) -> None:
    """Check that the gallery has what it needs, and a file of its own."""
    gallery, file = arguments.gallery, arguments.json
    refuse_without("--gallery", gallery, map_images=arguments.map_images)
    if gallery is None:
        return
    importlib.import_module("crisalad_jax.experiments.report")  # or its extra is missing
    require(
        file in (None, STDOUT) or real_path(file) != real_path(gallery),
        f"--gallery: found {gallery}, as --json, expected two files",
    )


def _sequence_of(arguments: Query) -> SequenceSearch | None:
    """Make the search that the flags ask for; None where they ask for none."""
    reach, length = arguments.sequence_reach, arguments.sequence_length
    if arguments.sequence == "seqslam":
        refuse_with("--sequence seqslam", sequence_reach=reach)
        return SeqSlam() if length is None else SeqSlam(length=length)
    refuse_without("--sequence seqslam", None, sequence_length=length)
    refuse_without("--sequence bayes", arguments.sequence, sequence_reach=reach)
    if arguments.sequence is None:
        return None
    return BayesFilter() if reach is None else BayesFilter(reach=reach)


@contextlib.contextmanager
def _opened(arguments: Query) -> Iterator[Map]:
    """Open the map, and its model in the engine that the flags ask for."""
    verify, runtime = arguments.verify, arguments.runtime
    calibrated = arguments.min_similarity is None
    with Map.open(arguments.map, verify=verify, calibrated=calibrated) as places:
        places.load_model(
            find_given(arguments.weights, runtime=runtime, quiet=arguments.quiet),
            engine=runtime,
            groupings=["single" if arguments.window == 1 else "window"],
            verify=verify,
        )
        yield places


def _unknown_words(answers: Answers, places: Map) -> str:
    """Say how many queries are of unknown places, and what their similarity rests on.

    Nothing where any similarity counts.
    """
    if answers.min_similarity is None:
        return ""
    count, least = int((~answers.known).sum()), f"{answers.min_similarity:.9g}"
    measured = places.calibration
    rests = "" if measured is None else f" (rests on {counted(measured.answered, 'answer')})"
    return f"; {count} of {len(answers.queries)} unknown, below similarity {least}{rests}"


def answer_lines(answers: Answers) -> Iterator[str]:
    """Yield the name of each query, and below it its answers; an unknown place has one line.

    Numbers stand in columns, and names at the ends of lines: a name that a terminal has no room for
    runs on in its next line, and is copied whole.
    """
    found = list(json_rows(answers))
    position = ", ".join(answers.axes or ("position",))
    if "zone" in found[0]:
        position += f" (zone {found[0]['zone']})"
    numbers = ["similarity"] if answers.probabilities is None else ["similarity", "probability"]
    queries: list[str | None] = [None]
    rows = [["rank", *numbers, position, "name"]]
    for row in found:
        known = row.get("known", True)
        for answer in row["neighbours"] if known else row["neighbours"][:1]:
            at = answer["position"] if known else None
            queries.append(row["query"] if answer["rank"] == 1 else None)
            rows.append(
                [
                    str(answer["rank"]) if known else "-",
                    *(f"{answer[name]:.3f}" for name in numbers),
                    "-" if at is None else ", ".join(f"{value:.9g}" for value in at.values()),
                    answer["name"] if known else "unknown",
                ]
            )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)][:-1]
    for name, cells in zip(queries, rows, strict=True):
        if name is not None:
            yield name
        padded = (cell.rjust(width) for cell, width in zip(cells, widths, strict=False))
        yield "  ".join((*padded, cells[-1]))


def _run_live(arguments: Query) -> None:
    """Print an answer for each image that comes, until a signal or the end of a video."""
    name = "--camera" if arguments.watch is None else "--watch"
    require(not arguments.images, f"IMAGE: found with {name}, expected only one of the two")
    refuse_with(name, **pick(arguments, "gallery", "map_images", "topic"))
    if name == "--watch":
        refuse_with(name, **pick(arguments, "camera", "fps"))
    require(
        arguments.json in (None, STDOUT),
        f"--json: found {arguments.json} with {name}, expected -: answers go to the standard "
        "output as they come",
    )
    sequence = _sequence_of(arguments)
    with contextlib.ExitStack() as stack:
        # First, for its errors: loading a model takes seconds.
        if arguments.watch is not None:
            source = FolderWatch(arguments.watch)
            verb = "is" if source.there == 1 else "are"
            there = f"{counted(source.there, 'image')} {verb} there"
            words = f"watching {arguments.watch} ({there}, and left out)"
        else:
            assert arguments.camera is not None
            source = stack.enter_context(Camera(arguments.camera, fps=arguments.fps))
            words = f"taking frames from {source.name}"
        places = stack.enter_context(_opened(arguments))
        latencies: list[float] = []
        state = stack.enter_context(defer_signals())

        def ready() -> None:
            state.has_work = True  # the summary
            _log(f"ready, {words}")

        answers = query_live(
            places,
            source,
            sequence=sequence,
            ready=ready,
            check=state.check,
            **pick(arguments, "k", "window", "min_similarity"),
        )
        try:
            for answer in answers:
                print(answer.json_line(), flush=True)
                latencies.append(answer.latency_ms)
        finally:
            dropped = f"; {source.dropped} frames passed over" if source.dropped else ""
            _log(f"{latency_words(latencies)}{dropped}")


def _log(line: str) -> None:
    print(f"crisalad: {printable(line)}", file=sys.stderr, flush=True)
