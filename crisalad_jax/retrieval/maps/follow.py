"""Answers of a map to consecutive frames of one camera, by a filter over its images in order."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from crisalad_jax.config.concise import brief
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.sequence import BayesFilter, SequenceState
from crisalad_jax.utils.shapes import Float32, Float64, Int64

_NUMBERS = 2**25
"""Similarities computed at a time: 128 MiB."""


@brief
class Followed(NamedTuple):
    """Images of a map at each of some frames, the most probable first."""

    numbers: Int64[np.ndarray, "frame k"]
    similarities: Float32[np.ndarray, "frame k"]
    probabilities: Float64[np.ndarray, "frame k"]
    """Probability of each image that the camera is there."""
    best: Float32[np.ndarray, " frame"]
    """Similarity of the image of the whole map that is most similar to the frame."""


class Follower:
    """A camera that is followed through a map, a few frames at a time."""

    def __init__(self, places: Map, bayes: BayesFilter) -> None:
        """Begin a sequence in a map, whose descriptors are read twice."""
        self._map, self._filter = places, bayes
        total = sum(part.sum(axis=0, dtype=np.float64) for part in places.descriptors)
        mean = total / len(places)
        common = [part.astype(np.float64) @ mean for part in places.descriptors]
        self.state: SequenceState = bayes.start(np.concatenate(common))

    def answer(self, descriptors: Float32[np.ndarray, "frame d"], k: int) -> "Followed":
        """Take the next frames into account, and rank the map's images at each of them.

        Args:
            descriptors: unit descriptors of the frames in order, of the map's model.
            k: images for each frame; all where there are fewer.

        Returns:
            The images that the camera is most probably at, best first.

        Raises:
            InputError: what `Map.similarities` raises.
        """
        rows = [self._ranked(row, k) for row in self._similarities(descriptors)]
        numbers, similarities, probabilities, best = map(np.stack, zip(*rows, strict=True))
        return Followed(numbers, similarities, probabilities, best)

    def _ranked(self, row: Float32[np.ndarray, " place"], k: int) -> tuple[np.ndarray, ...]:
        self.state = self._filter.step(self.state, row)
        belief = self.state.belief
        numbers = np.argsort(-belief, kind="stable")[:k]
        return numbers, row[numbers], belief[numbers], row.max()

    def _similarities(
        self, descriptors: Float32[np.ndarray, "frame d"]
    ) -> Iterator[Float32[np.ndarray, " place"]]:
        """Yield the similarities of each frame to all images of the map."""
        step = max(1, _NUMBERS // len(self._map))
        for start in range(0, len(descriptors), step):
            yield from self._map.similarities(descriptors[start : start + step])
