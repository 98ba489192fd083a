"""`crisalad query`."""

import contextlib
import importlib
import pathlib
import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from crisalad_jax.cli.common import STDOUT, Jax, echo, find_given, pick, refuse_with, refuse_without
from crisalad_jax.cli.flags import (
    FrameFlags,
    JsonFlag,
    MapFlags,
    QueryRuntimeName,
    ReadFlags,
    Target,
)
from crisalad_jax.config.checks import require
from crisalad_jax.data.live import Camera, FolderWatch
from crisalad_jax.retrieval.maps.answer_files import (
    POSITION_SUFFIXES,
    check_positions,
    format_answers,
)
from crisalad_jax.retrieval.maps.live import latency_words, query_live
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.query import Answers, json_lines, json_rows, query
from crisalad_jax.retrieval.maps.tracking import SequenceSearch
from crisalad_jax.retrieval.maps.where import Where
from crisalad_jax.retrieval.seqslam import SeqSlam
from crisalad_jax.retrieval.sequence import BayesFilter
from crisalad_jax.retrieval.verification.camera import Intrinsics
from crisalad_jax.retrieval.verification.verify import Verify
from crisalad_jax.utils.files import atomic_path, real_path
from crisalad_jax.utils.output import counted, printable
from crisalad_jax.utils.signals import defer_signals

if TYPE_CHECKING:  # of an extra
    from crisalad_jax.experiments.rerun_log import Recording

_RECORDS = "crisalad_jax.experiments.rerun_log"
_ROWS = 24
"""Largest number of queries in a gallery."""
_COLUMNS = 8
"""Largest number of answers to each query in a gallery."""


class Query(ReadFlags, FrameFlags, MapFlags, JsonFlag):
    """Find the images of a map most similar to the queries, and print where they were taken."""

    images: Annotated[
        tuple[pathlib.Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="IMAGE...")
    ]
    """Images, or folders of them, patterns, lists, tables, videos or robot logs
    (docs/how-to/image-sources.md).
    Give none with --watch or --camera."""
    watch: pathlib.Path | None = None
    """Folder to watch: answer each new image as it appears, with a line of JSON."""
    camera: str | None = None
    """Camera number from 0, URL, video or robot log: answer its newest frame, repeatedly."""
    rate: float | None = None
    """Playback speed of a file as --camera, relative to real time; by default 1."""
    fps: float | None = None
    """Frames per second from a video or log, by default 1; with --camera, the maximum to answer."""
    window: int = 1
    """Number of frames described together: each frame of a moving camera and those before it."""
    runtime: QueryRuntimeName = "auto"
    """Engine that runs the model (docs/export.md); auto is the fastest that is installed and agrees
    with jax. Weights are exported for it once; --weights may be an exported folder."""
    k: int = 5
    """Number of answers per query."""
    min_similarity: float | None = None
    """Similarity of the best answer below which the place is unknown; by default what `crisalad
    calibrate` measured for this map. -1 answers every query."""
    sequence: Literal["bayes", "seqslam"] | None = None
    """Treat the queries as consecutive frames of one camera: bayes, a filter, weighs all frames so
    far; seqslam searches lines through the last ones (docs/maps.md)."""
    sequence_reach: float | None = None
    """For bayes: largest speed of this camera relative to the map's; by default 2. If names have no
    times or positions, it is in map images per frame."""
    sequence_length: int | None = None
    """For seqslam: length of its lines in frames; by default 10."""
    where: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Search only some of the map's images: 'folder=monday, added>=2026-05-01,
    box=west,south,east,north', each condition optional; also time>= (docs/maps.md)."""
    exact: bool = False
    """Search exactly, even if the map has an approximate search."""
    json: Annotated[pathlib.Path | None, Target((".json", ".jsonl"))] = None
    """File for the answers: .jsonl, a line of JSON for each query, or .json, a list; - prints the
    lines."""
    out: Annotated[pathlib.Path | None, Target(POSITION_SUFFIXES)] = None
    """File for the position of each query's best answer: .csv, which --positions takes, or
    .geojson, .gpx or .kml, in degrees."""
    gallery: Annotated[pathlib.Path | None, Target((".png", ".svg", ".pdf"))] = None
    """PNG, SVG or PDF of up to 24 queries with up to 8 answers each."""
    rerun: Annotated[pathlib.Path | None, Target((".rrd",))] = None
    """Recording for the viewer Rerun: queries, answers, similarities and path on the map, over time
    (docs/how-to/from-a-bag-to-a-relocalising-robot.md)."""
    map_images: pathlib.Path | None = None
    """Folder of the map's images, for --gallery, --rerun and --verify, if they were moved."""
    verify: int | None = None
    """Number of best answers to verify by local features: matches, inliers and, with --intrinsics,
    poses (docs/verification.md)."""
    min_inliers: int | None = None
    """Inliers of the best answer below which the place is unknown; by default what `crisalad
    calibrate --verify` measured for this map."""
    matcher: pathlib.Path | None = None
    """With --verify: ONNX file of features and matcher, as ALIKED + LightGlue; by default SIFT."""
    intrinsics: str | None = None
    """The camera's fx,fy,cx,cy[,width,height], or a file: YAML or JSON of ROS's camera_info."""
    map_intrinsics: str | None = None
    """Intrinsics of the map's camera, if they differ from --intrinsics."""
    map_depth: pathlib.Path | None = None
    """Folder of 16-bit PNGs, named like the map's images: depth in millimetres, for --verify."""


def needs_jax(arguments: Query) -> bool:
    """Return whether JAX is chosen to describe images; other runtimes start without it."""
    return arguments.runtime == "jax"


def run(arguments: Query) -> None:
    """Query the map, and print or write the answers: of all images, or of each as it arrives."""
    if arguments.watch is not None or arguments.camera is not None:
        _run_live(arguments)
        return
    refuse_without("--camera", None, rate=arguments.rate)
    _check_files(arguments)
    sequence, where = _sequence_of(arguments), _where_of(arguments)
    with _opened(arguments) as (places, by):
        if arguments.out is not None:
            check_positions(arguments.out, places.axes, places.zone)
        answers = query(
            places,
            arguments.images,
            sequence=sequence,
            where=where,
            verify=_verify_of(arguments),
            **pick(arguments, "k", "fps", "topic", "window", "exact", "min_similarity", "reading"),
        )
    if answers.unreadable:
        echo(f"{len(answers.unreadable)} unreadable left out, {answers.unreadable[0]} the first")
    asked = f"{len(answers.queries)} {'query' if len(answers.queries) == 1 else 'queries'}"
    images = counted(len(answers.images), "image")
    unknown = _unknown_words(answers, places)
    file, gallery = arguments.json, arguments.gallery
    if file is None:
        echo(f"{arguments.map}, {images}; {by}{unknown}")
        echo("\n".join(answer_lines(answers)))
    elif file == STDOUT:
        for line in json_lines(answers):
            print(line)
    written = {}
    with contextlib.ExitStack() as staged:  # so that all files appear, or none
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
        if arguments.rerun is not None:
            staged.enter_context(_recording(arguments)).add(answers)
            written[arguments.rerun] = asked
        for path in (file, arguments.out):
            if path not in (None, STDOUT):
                text, count = format_answers(path, answers)
                staged.enter_context(atomic_path(path)).write_text(text, "utf-8", newline="")
                written[path] = asked if count == len(answers.queries) else f"{count} of {asked}"
    for path, words in written.items():
        echo(f"{path}: {words} in a map of {images}; {by}{unknown}")


def _check_files(arguments: Query) -> None:
    """Check that output flags fit together, and that their extras are installed."""
    gallery, file, rerun, out = arguments.gallery, arguments.json, arguments.rerun, arguments.out
    require(
        out is None or out.suffix != "",
        f"--out: found {out}, expected a name that ends in {' or '.join(POSITION_SUFFIXES)}",
    )
    if arguments.verify is None:
        needs = "--gallery, --rerun or --verify"
        refuse_without(needs, gallery or rerun, map_images=arguments.map_images)
    if rerun is not None:
        importlib.import_module(_RECORDS)  # raises if its extra is missing
    if gallery is None:
        return
    importlib.import_module("crisalad_jax.experiments.report")
    require(
        file in (None, STDOUT) or real_path(file) != real_path(gallery),
        f"--gallery: found {gallery}, as --json, expected two files",
    )


def _sequence_of(arguments: Query) -> SequenceSearch | None:
    """Make the search that the flags ask for; None if they ask for none."""
    reach, length = arguments.sequence_reach, arguments.sequence_length
    if arguments.sequence == "seqslam":
        refuse_with("--sequence seqslam", sequence_reach=reach)
        return SeqSlam() if length is None else SeqSlam(length=length)
    refuse_without("--sequence seqslam", None, sequence_length=length)
    refuse_without("--sequence bayes", arguments.sequence, sequence_reach=reach)
    if arguments.sequence is None:
        return None
    return BayesFilter() if reach is None else BayesFilter(reach=reach)


def _where_of(arguments: Query) -> Where | None:
    """Read the conditions on the map's images, before a model is loaded."""
    if arguments.sequence is not None:
        refuse_with("--sequence", where=arguments.where or None)
    return Where.parse(",".join(arguments.where)) if arguments.where else None


def _verify_of(arguments: Query) -> Verify | None:
    """Make the verification that the flags ask for; None if they ask for none."""
    flags = ("matcher", "intrinsics", "map_intrinsics", "map_depth", "min_inliers")
    given = pick(arguments, *flags)
    if arguments.verify is None:
        refuse_without("--verify", None, **given)
        return None
    for name in ("intrinsics", "map_intrinsics"):
        given[name] = given[name] and Intrinsics.parse(given[name])
    return Verify(answers=arguments.verify, map_images=arguments.map_images, **given)


@contextlib.contextmanager
def _opened(arguments: Query) -> Iterator[tuple[Map, str]]:
    """Open the map, and its model in the engine that the flags ask for, or in the fastest.

    Yields:
        (map, text that names the engine).
    """
    verify, runtime = arguments.checksums, arguments.runtime
    calibrated = arguments.min_similarity is None
    groupings = ["single" if arguments.window == 1 else "window"]
    with Map.open(arguments.map, verify=verify, calibrated=calibrated) as places:
        file = find_given(arguments.weights, runtime=runtime, quiet=arguments.quiet)
        if runtime == "auto":
            runtime = places.fastest_engine(file, groupings=groupings)
            if runtime == "jax":
                Jax.set_up()
        places.load_model(file, engine=runtime, groupings=groupings, verify=verify)
        yield places, f"by {runtime}"


def _unknown_words(answers: Answers, places: Map) -> str:
    """Describe how many queries are of unknown places, and how the threshold was measured.

    The text is empty if no threshold is set.
    """
    below = []
    if answers.min_similarity is not None:
        measured = places.calibration
        rests = "" if measured is None else f" (rests on {counted(measured.answered, 'answer')})"
        below.append(f"below similarity {answers.min_similarity:.9g}{rests}")
    if answers.min_inliers is not None:
        below.append(f"with fewer than {counted(answers.min_inliers, 'inlier')}")
    count = int((~answers.known).sum())
    unknown = f"; {count} of {len(answers.queries)} unknown, {' or '.join(below)}"
    return unknown if below else ""


def answer_lines(answers: Answers) -> Iterator[str]:
    """Yield lines to print: each query's name, then its answers, or one line if it is unknown.

    Numbers are in columns, and names at the ends of lines: a name that is too long for a terminal
    wraps there, and can still be copied in one piece.
    """
    found = list(json_rows(answers))
    position = ", ".join(answers.axes or ("position",))
    if "zone" in found[0]:
        position += f" (zone {found[0]['zone']})"
    numbers = ["similarity"] if answers.probabilities is None else ["similarity", "probability"]
    queries: list[str | None] = [None]
    checked = [] if answers.checks is None else ["inliers", "confidence"]
    rows = [["rank", *numbers, *checked, position, "name"]]
    for row in found:
        known = row.get("known", True)
        for answer in row["neighbours"] if known else row["neighbours"][:1]:
            at = answer["position"] if known else None
            queries.append(row["query"] if answer["rank"] == 1 else None)
            rows.append(
                [
                    str(answer["rank"]) if known else "-",
                    *(f"{answer[name]:.3f}" for name in numbers),
                    *_verified_cells(answer, checked),
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


def _verified_cells(answer: dict[str, Any], columns: Sequence[str]) -> list[str]:
    verified = answer.get("verified")
    return [f"{verified[name]:.4g}" if verified else "-" for name in columns]


def _run_live(arguments: Query) -> None:
    """Print an answer for each image as it arrives, until a signal or the end of a video."""
    name = "--camera" if arguments.watch is None else "--watch"
    require(not arguments.images, f"IMAGE: found with {name}, expected only one of the two")
    refuse_with(name, gallery=arguments.gallery, out=arguments.out)
    if name == "--watch":
        refuse_with(name, **pick(arguments, "camera", "fps", "rate", "topic"))
    require(
        arguments.json in (None, STDOUT),
        f"--json: found {arguments.json} with {name}, expected -: answers go to the standard "
        "output as they come",
    )
    _check_files(arguments)
    sequence, where = _sequence_of(arguments), _where_of(arguments)
    with contextlib.ExitStack() as stack:
        # First, so that its errors come early: loading a model takes seconds.
        if arguments.watch is not None:
            source = FolderWatch(arguments.watch)
            verb = "is" if source.there == 1 else "are"
            there = f"{counted(source.there, 'image')} {verb} there already"
            words = f"watching {arguments.watch} ({there}, and left out)"
        else:
            assert arguments.camera is not None
            more = pick(arguments, "fps", "topic")
            rate = 1.0 if arguments.rate is None else arguments.rate
            source = stack.enter_context(Camera(arguments.camera, rate=rate, **more))
            words = f"taking frames from {source.name}"
        places, by = stack.enter_context(_opened(arguments))
        latencies: list[float] = []
        state = stack.enter_context(defer_signals())
        recording = None
        if arguments.rerun is not None:
            recording = stack.enter_context(_recording(arguments))

        def ready() -> None:
            state.has_work = True  # the summary is still to print
            _log(f"ready, {words}; {by}")

        answers = query_live(
            places,
            source,
            sequence=sequence,
            where=where,
            verify=_verify_of(arguments),
            ready=ready,
            check=state.check,
            **pick(arguments, "k", "window", "min_similarity"),
        )
        try:
            for answer in answers:
                print(answer.json_line(), flush=True)
                latencies.append(answer.latency_ms)
                if recording is not None:
                    recording.add(answer.answers, [answer.frame.image])
        finally:
            _log(latency_words(latencies, source.dropped))


def _recording(arguments: Query) -> "contextlib.AbstractContextManager[Recording]":
    from crisalad_jax.experiments.rerun_log import record

    assert arguments.rerun is not None
    return record(arguments.rerun, root=arguments.map_images)


def _log(line: str) -> None:
    print(f"crisalad: {printable(line)}", file=sys.stderr, flush=True)
