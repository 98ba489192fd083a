"""Recordings for the viewer Rerun (https://rerun.io): queries, answers, similarities and the map.

A recording has a timeline `frame`, the number of the query, and a timeline `time` if the names of
queries contain the time they were taken.
"""

import contextlib
import os
import pathlib
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from crisalad_jax.data.frames import moment_of
from crisalad_jax.data.images import read_pixels
from crisalad_jax.data.positions import AXES
from crisalad_jax.data.prepare import as_rgb
from crisalad_jax.retrieval.maps.images import MapImage
from crisalad_jax.retrieval.maps.query import Answers
from crisalad_jax.retrieval.verification.results import Verification
from crisalad_jax.utils.errors import InputError, Interrupted
from crisalad_jax.utils.files import atomic_path
from crisalad_jax.utils.output import counted, warn

if TYPE_CHECKING:
    from crisalad_jax.data.benchmarks import Benchmark
    from crisalad_jax.evaluation.results import GroupingResult

_SHOWN = 3
"""Maximum number of answers per query whose images are recorded."""
_SIDE = 480
"""Pixels of a recorded image's longer side."""
_GREY, _GREEN, _RED = (150, 150, 150), (40, 160, 70), (210, 50, 40)
_SINCE_1970 = 1e9
"""Seconds from which a time is taken as a date."""

_Spot = Sequence[float]
_Colour = tuple[int, int, int]


@contextlib.contextmanager
def record(
    path: str | os.PathLike[str], *, root: str | os.PathLike[str] | None = None
) -> Iterator["Recording"]:
    """Open a recording for writing; it appears at `path` after the block, even if a signal ends it.

    Args:
        path: the file, `.rrd`.
        root: folder of the map's images; None is the folder that was indexed. Missing images are
            left out, with a warning.

    Raises:
        InputError: the file cannot be created.
    """
    interrupted = None
    with atomic_path(path) as temporary:
        stream = rr.RecordingStream("crisalad")
        stream.set_log_time_enabled(False)  # when this file was written does not matter
        stream.set_log_tick_enabled(False)
        stream.save(temporary)
        recording = Recording(stream, root)
        try:
            yield recording
        except Interrupted as error:  # the normal end of a camera stream
            interrupted = error
        finally:
            recording.finish()
            stream.disconnect()
    if interrupted is not None:
        raise interrupted


def record_results(
    path: str | os.PathLike[str], benchmark: "Benchmark", results: Sequence["GroupingResult"]
) -> None:
    """Write the results of an evaluation as a recording for Rerun.

    Args:
        path: the file, `.rrd`.
        benchmark: the evaluated benchmark, without unreadable images.
        results: what `evaluate` returned.

    Raises:
        InputError: an image cannot be read, or the file cannot be created.
    """
    truth = benchmark.ground_truth()
    spots = benchmark.database_positions
    places: Sequence = [None] * len(benchmark.database) if spots is None else spots.tolist()
    pairs = zip(benchmark.database, places, strict=True)
    images = [MapImage(str(file), 0, spot, "") for file, spot in pairs]
    axes = None if spots is None else AXES[0]
    with record(path) as recording:
        for result in results:
            answers = Answers(list(benchmark.queries), result.neighbours, images, axes)
            firsts = result.neighbours.indices[:, 0].tolist()
            right = [first in of for first, of in zip(firsts, truth, strict=True)]
            recording.add(answers, right=right, label=result.label)


class Recording:
    """A recording of queries and their answers that is being written."""

    def __init__(self, stream: rr.RecordingStream, root: str | os.PathLike[str] | None) -> None:
        """Start without queries; see `record`."""
        self._stream, self._root = stream, root
        self._scenes: dict[str, _Scene] = {}
        self._lost: dict[pathlib.Path, InputError] = {}

    def add(
        self,
        answers: Answers,
        images: Sequence[np.ndarray] | None = None,
        *,
        right: Sequence[bool] | None = None,
        label: str = "",
    ) -> None:
        """Add queries with their answers, each query as the next frame.

        Args:
            answers: what `query` found; calls with the same label must query the same map.
            images: pixels of the queries; None reads their files.
            right: whether each first answer is correct; None treats known places as correct.
            label: start of the path of these entities in Rerun, such as a grouping; "" for none.

        Raises:
            InputError: a query's file cannot be read.
        """
        if label not in self._scenes:
            self._scenes[label] = _Scene(self._stream, label, answers)
        scene = self._scenes[label]
        log, known = scene.log, answers.known.tolist()
        for number, (file, ranked) in enumerate(answers.rows()):
            scene.next_frame(file)
            name = answers.names[number]
            words = [name if known[number] else f"{name}: unknown"]
            pixels = read_pixels(file) if images is None else images[number]
            query = as_rgb(pixels, "contrast-stretch", name)
            log("query", _encoded(_small(query)[0]))
            for answer in ranked[:_SHOWN]:
                picture = self._map_picture(answer.image)
                nothing = rr.Clear(recursive=False)
                log(
                    f"answers/{answer.rank}",
                    nothing if picture is None else _encoded(_small(picture)[0]),
                )
                words.append(f"{answer.rank}. {answer.similarity:.3f} {answer.image.name}")
                if answer.rank == 1 and answers.checks and picture is not None:
                    scene.log_matches(query, picture, answers.checks[number][0])
            log("words", rr.TextDocument("\n".join(words)))
            best, least = ranked[0].similarity, answers.min_similarity
            log(
                "similarity/best",
                rr.Scalars(best if answers.best is None else answers.best[number]),
            )
            if least is not None:
                log("similarity/least", rr.Scalars(least))
            if ranked[0].probability is not None:
                log("similarity/probability", rr.Scalars(ranked[0].probability))
            is_good = known[number] if right is None else right[number]
            if known[number] and ranked[0].image.position is not None:
                scene.move(ranked[0].image.position, _GREEN if is_good else _RED)

    def _map_picture(self, image: MapImage) -> np.ndarray | None:
        """Read an image of the map; None if it is missing."""
        file = pathlib.Path(image.root if self._root is None else self._root, image.name)
        if file not in self._lost:
            try:
                return as_rgb(read_pixels(file), "contrast-stretch", str(file))
            except InputError as error:
                self._lost[file] = error
        return None

    def finish(self) -> None:
        """Log the trajectories and the layout of the viewer; `record` calls this at the end."""
        if self._lost:
            first = next(iter(self._lost.values()))
            warn(
                f"{counted(len(self._lost), 'picture')} left out (first: {first}); --map-images "
                "(root=) sets another folder"
            )
        views = [scene.finish() for scene in self._scenes.values()]
        if views:
            panel = rrb.TimePanel(timeline="frame")
            self._stream.send_blueprint(rrb.Blueprint(rrb.Tabs(*views), panel))


class _Scene:
    """The part of a recording for one map: its positions, and the trajectory through it."""

    def __init__(self, stream: rr.RecordingStream, label: str, answers: Answers) -> None:
        """Log the positions of the map's images, which do not change."""
        self._stream, self._label = stream, label
        self._at = rr.new_entity_path([label]) if label else ""
        self._frames = 0
        self._has_matches = False
        self._in_degrees = answers.axes == AXES[1]
        self._way: list[tuple[_Spot, _Colour]] = []
        known = [image.position for image in answers.images if image.position is not None]
        self._has_map = bool(known)
        # The viewer's points have 24 bits of precision, and UTM metres need more.
        self._origin = np.round(np.median(known, axis=0)) if known else 0
        if known:
            self.log("map/images", self._points(known, [_GREY], 2), static=True)

    def log(self, name: str, entity: rr.AsComponents, *, static: bool = False) -> None:
        """Log an entity at the current frame."""
        self._stream.log(f"{self._at}/{name}", entity, static=static)

    def next_frame(self, file: pathlib.Path) -> None:
        """Start the next frame, and set its times."""
        self._stream.reset_time()
        self._stream.set_time("frame", sequence=self._frames)
        self._frames += 1
        if (moment := moment_of(file)) is None:
            return
        if moment.seconds < _SINCE_1970:
            self._stream.set_time("time", duration=moment.seconds)
        else:
            self._stream.set_time("time", timestamp=moment.seconds)

    def move(self, spot: _Spot, colour: _Colour) -> None:
        """Log where the camera is."""
        self._way.append((spot, colour))
        self.log("map/here", self._points([spot], [colour], 7))

    def log_matches(self, query: np.ndarray, answer: np.ndarray, check: Verification) -> None:
        """Log two images side by side, and lines between matching points."""
        self._has_matches = True
        (left, ours), (right, theirs) = _small(query), _small(answer)
        both = np.zeros((max(len(left), len(right)), left.shape[1] + right.shape[1], 3), np.uint8)
        both[: len(left), : left.shape[1]] = left
        both[: len(right), left.shape[1] :] = right
        starts = ours * check.query_points
        ends = theirs * check.database_points + (left.shape[1], 0)
        self.log("matches/images", _encoded(both))
        self.log(
            "matches/lines",
            rr.LineStrips2D(np.stack([starts, ends], 1, dtype=np.float32), colors=[_GREEN]),
        )
        self.log("inliers", rr.Scalars(check.inliers))

    def finish(self) -> rrb.Container:
        """Log the trajectory so far, and return the views."""
        at = self._at or "/"
        if self._way:
            spots, colours = zip(*self._way, strict=True)
            self.log("map/way", self._line(spots), static=True)
            self.log("map/found", self._points(spots, colours, 4), static=True)
        answers = [
            rrb.Spatial2DView(origin=f"{self._at}/answers/{rank}", name=f"answer {rank}")
            for rank in range(1, _SHOWN + 1)
        ]
        pictures = rrb.Grid(rrb.Spatial2DView(origin=f"{self._at}/query", name="query"), *answers)
        if self._has_matches:
            pictures = rrb.Vertical(
                pictures, rrb.Spatial2DView(origin=f"{self._at}/matches", name="matches")
            )
        view = rrb.MapView if self._in_degrees else rrb.Spatial3DView
        numbers = [
            rrb.TimeSeriesView(origin=f"{self._at}/similarity", name="similarity"),
            rrb.TextDocumentView(origin=f"{self._at}/words", name="names"),
        ]
        if self._has_matches:
            numbers.append(rrb.TimeSeriesView(origin=f"{self._at}/inliers", name="inliers"))
        below = [view(origin=f"{self._at}/map", name="map")] if self._has_map else []
        return rrb.Horizontal(pictures, rrb.Vertical(*below, *numbers), name=self._label or at)

    def _points(
        self, spots: Sequence[_Spot], colours: Sequence[_Colour], pixels: float
    ) -> rr.AsComponents:
        radii = rr.Radius.ui_points(pixels)
        if self._in_degrees:
            return rr.GeoPoints(lat_lon=spots, colors=colours, radii=radii)
        return rr.Points3D(self._flat(spots), colors=colours, radii=radii)

    def _line(self, spots: Sequence[_Spot]) -> rr.AsComponents:
        if self._in_degrees:
            return rr.GeoLineStrings(lat_lon=[spots], colors=[_GREEN])
        return rr.LineStrips3D([self._flat(spots)], colors=[_GREEN])

    def _flat(self, spots: Sequence[_Spot]) -> np.ndarray:
        """Return positions in metres from the middle of the map, with a height of 0."""
        moved = np.asarray(spots) - self._origin
        return np.pad(moved, ((0, 0), (0, 3 - moved.shape[1])))


def _small(image: np.ndarray) -> tuple[np.ndarray, float]:
    """Shrink an image, and return it with the scale factor."""
    factor = min(1.0, _SIDE / max(image.shape[:2]))
    return cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), factor


def _encoded(image: np.ndarray) -> rr.EncodedImage:
    """Encode an image as JPEG."""
    _, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return rr.EncodedImage(contents=data.tobytes(), media_type="image/jpeg")
