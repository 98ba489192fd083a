"""Locate a camera in a map from its consecutive frames and the order of the map's images."""

import itertools
import math
import pathlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.frames import moment_of
from crisalad_jax.data.metres import comparable
from crisalad_jax.data.positions import AXES, utm_positions
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.seqslam import SeqSlam
from crisalad_jax.retrieval.sequence import BayesFilter
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.shapes import Float32, Float64, Int64

SequenceSearch = BayesFilter | SeqSlam
"""A method that locates a camera from all of its frames so far."""
_NUMBERS = 2**25
"""Similarities computed at a time: 128 MiB."""
_GAP = 1e9
"""Seconds from one video of a map to the next: more than any camera moves."""

_Spot = tuple[str, tuple[float, ...]]
"""When an image was taken, as a clock and its seconds; or where, as a zone or "" and metres."""


@brief
class TrackResult(NamedTuple):
    """The k most probable images of a map for each frame, by number, the most probable first."""

    numbers: Int64[np.ndarray, "frame k"]
    similarities: Float32[np.ndarray, "frame k"]
    probabilities: Float64[np.ndarray, "frame k"]
    """Probability that the camera is at each image, given all frames up to this one."""
    best: Float32[np.ndarray, " frame"]
    """Largest similarity of each frame to any image of the map, however improbable."""


class SequenceTracker:
    """Tracks a camera through a map, a few frames at a time."""

    def __init__(self, places: Map, search: SequenceSearch) -> None:
        """Start a sequence anywhere in a map; all of its descriptors are read twice."""
        self._map = places
        self._filter: Any = search
        total = sum(part.sum(axis=0, dtype=np.float64) for part in places.descriptors)
        mean = total / len(places)
        common = [part.astype(np.float64) @ mean for part in places.descriptors]
        self.state = self._filter.start(np.concatenate(common))
        self._read: Callable[[str], _Spot | None] | None = None
        self._before: _Spot | None = None

    def answer(
        self, descriptors: Float32[np.ndarray, "frame d"], k: int, frames: Sequence[pathlib.Path]
    ) -> "TrackResult":
        """Update the camera's state with the next frames, and rank the map's images for each.

        The first call decides how motion is measured: in metres if all images of the map have
        positions and the names of all its frames contain @UTM positions; else in seconds if all
        names contain times; else as one image per frame, with a warning. `SeqSlam` counts images.

        Args:
            descriptors: unit descriptors of the frames, in order, by the map's model.
            k: number of images per frame; all if the map has fewer.
            frames: names of the frames.

        Returns:
            For each frame, the images that the camera is most probably at, best first.

        Raises:
            InputError: the descriptors do not fit the map, or its store is damaged or missing.
        """
        if self.state.frames == 0 and not self._filter.counts_images:
            self._choose_unit(frames)
        found = []
        step = max(1, _NUMBERS // len(self._map))
        for start in range(0, len(descriptors), step):
            part = self._map.similarities(descriptors[start : start + step])
            for row, frame in zip(part, frames[start : start + step], strict=True):
                self.state = self._filter.step(self.state, row, self._moved(frame))
                belief = self.state.belief
                numbers = np.argsort(-belief, kind="stable")[:k]
                found.append((numbers, row[numbers], belief[numbers], row.max()))
        return TrackResult(*map(np.stack, zip(*found, strict=True)))

    def _choose_unit(self, frames: Sequence[pathlib.Path]) -> None:
        moments = [_when(image.name) for image in self._map.images]
        for read, spots in ((_where, _metres(self._map)), (_when, moments)):
            if None not in spots and all(read(str(frame)) is not None for frame in frames):
                steps = [_apart(*pair) for pair in itertools.pairwise(spots)]
                along = np.cumsum([0.0, *np.minimum(steps, _GAP)])
                self.state = self._filter.start(self.state.common, along)
                self._read = read
                return
        warn(
            "sequence: not all names of the map and of the queries say when or where they were "
            "taken, so a frame counts as an image of the map, and the camera moves by at most "
            f"{self._filter.reach:g} images a frame; where the map has more frames a second, raise "
            "--sequence-reach"
        )

    def _moved(self, frame: pathlib.Path) -> float:
        """Return how far the camera moved since the previous frame; infinity if unknown."""
        if self._read is None:
            return 1.0
        before, self._before = self._before, self._read(str(frame))
        return _apart(before, self._before)


def _apart(first: _Spot | None, second: _Spot | None) -> float:
    """Return the seconds or metres between two images; infinity if unknown."""
    if first is None or second is None or first[0] != second[0]:
        return math.inf
    return math.dist(first[1], second[1])


def _when(name: str) -> _Spot | None:
    moment = moment_of(name)
    return moment and (moment.clock, (moment.seconds,))


def _where(name: str) -> _Spot | None:
    found = utm_positions([pathlib.PurePath(name).name])
    # Two zones are like two clocks: their metres do not show how far the camera moved.
    return (str(found.zone), next(iter(found.of.values()))) if found.of else None


def _metres(places: Map) -> Sequence[_Spot | None]:
    positions = [image.position for image in places.images]
    if places.axes == AXES[1] and None not in positions:
        positions = map(tuple, comparable(*np.array(positions).T).tolist())
    return [each and ("", each) for each in positions]
