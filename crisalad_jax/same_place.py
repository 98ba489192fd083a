"""How many of the images that an image looked at show its own place: what a grouping gives away."""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int64

from crisalad_jax.groupings import Batches

SamePlace = Callable[
    [Int64[np.ndarray, " pair"], Int64[np.ndarray, " pair"]], Bool[np.ndarray, " pair"]
]
"""Whether two images of one side, by number, show the same place, pair by pair."""

# Numbers in an array of pairs: tens of megabytes, however many images there are.
_CHUNK = 2**21


def near(positions: Float64[np.ndarray, "image 2"], radius: float) -> SamePlace:
    """Two images show the same place if they were taken at most `radius` metres apart."""

    def same(a: Int64[np.ndarray, " pair"], b: Int64[np.ndarray, " pair"]) -> np.ndarray:
        return np.square(positions[a] - positions[b]).sum(axis=1) <= radius * radius

    return same


def by_truth(
    positives: Sequence[Int64[np.ndarray, " _"]], database: int
) -> tuple[SamePlace, SamePlace]:
    """Of the queries, and of the `database` images, where only the ground truth can tell.

    Two queries show the same place if some database image is right for both, and two database
    images if both are right for some query. What has no partner on the other side shows the place
    of no other image, whatever is to be seen there.
    """
    found = np.concatenate(positives) if positives else np.empty(0, np.int64)
    asking = np.repeat(np.arange(len(positives)), [len(each) for each in positives])
    queries = _Sharing(asking, found, len(positives), database)
    return queries, _Sharing(found, asking, database, len(positives))


@dataclasses.dataclass(frozen=True, eq=False)
class _Sharing:
    """Whether two owners have a thing in common. Memory is linear in entries and pairs."""

    owners: Int64[np.ndarray, " entry"]
    things: Int64[np.ndarray, " entry"]
    owner_count: int
    thing_count: int

    @functools.cached_property
    def _codes(self) -> Int64[np.ndarray, " code"]:
        """Each entry as one number, ascending: those of an owner stand together."""
        return np.unique(self.owners * self.thing_count + self.things)

    @functools.cached_property
    def _bounds(self) -> Int64[np.ndarray, " bound"]:
        """Where each owner's begin, and the end."""
        return np.searchsorted(self._codes, np.arange(self.owner_count + 1) * self.thing_count)

    def __call__(
        self, a: Int64[np.ndarray, " pair"], b: Int64[np.ndarray, " pair"]
    ) -> Bool[np.ndarray, " pair"]:
        most = int(np.diff(self._bounds).max(initial=1))
        step = max(1, _CHUNK // most)
        found = [self._part(a[i : i + step], b[i : i + step]) for i in range(0, len(a), step)]
        return np.concatenate([np.zeros(0, bool), *found])

    def _part(
        self, a: Int64[np.ndarray, " pair"], b: Int64[np.ndarray, " pair"]
    ) -> Bool[np.ndarray, " pair"]:
        """Everything that the one has, looked up at the other."""
        counts = np.diff(self._bounds)[a]
        pair = np.repeat(np.arange(len(a)), counts)
        place = np.arange(len(pair)) - np.repeat(np.cumsum(counts) - counts, counts)
        things = self._codes[self._bounds[a][pair] + place] % max(self.thing_count, 1)
        wanted = b[pair] * self.thing_count + things
        first = np.searchsorted(self._codes, wanted, side="left")
        hit = np.searchsorted(self._codes, wanted, side="right") > first
        return np.bincount(pair[hit], minlength=len(a)) > 0


def same_place_share(batches: Batches, same: SamePlace) -> float | None:
    """The share of the other images in sight that show an image's own place, 0 to 1.

    It is the mean over all images that looked at another one; None where none did.
    """
    if not batches.mutual:
        return None
    count = int(batches.kept.sum())
    share, looking = 0.0, 0
    readable = np.ones(count, bool)
    step = max(1, _CHUNK // batches.images.shape[1] ** 2)
    for start in range(0, len(batches.images), step):
        part = batches.part(start, start + step)
        others = part.looks(readable) & part.kept[:, :, None]
        others &= ~np.eye(others.shape[1], dtype=bool)
        batch, i, j = np.nonzero(others)
        image, other = part.images[batch, i], part.images[batch, j]
        place = np.ravel_multi_index((batch, i), part.images.shape)
        right = np.bincount(place[same(image, other)], minlength=part.images.size)
        seen = np.bincount(place, minlength=part.images.size)
        share += float((right[seen > 0] / seen[seen > 0]).sum())
        looking += int((seen > 0).sum())
    return share / looking if looking else None
