"""Leakage of a grouping: the share of images in sight of an image that show its own place."""

from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float64, Int64

from crisalad_jax.retrieval.grouping import Batches

SamePlace = Callable[
    [Int64[np.ndarray, " pair"], Int64[np.ndarray, " pair"]], Bool[np.ndarray, " pair"]
]
"""Tests pair by pair whether two images of one side, by number, show the same place."""

# Numbers in an array of pairs: tens of megabytes, whatever the number of images.
_CHUNK = 2**21


def near(positions: Float64[np.ndarray, "image axis"], radius: float) -> SamePlace:
    """Make the test that two images were taken at most `radius` metres apart."""

    def same(a: Int64[np.ndarray, " pair"], b: Int64[np.ndarray, " pair"]) -> np.ndarray:
        return np.square(positions[a] - positions[b]).sum(axis=1) <= radius * radius

    return same


def by_truth(
    positives: Sequence[Int64[np.ndarray, " _"]], database: int
) -> tuple[SamePlace, SamePlace]:
    """Make the tests of the queries and of the `database` images from the ground truth alone.

    Two queries show the same place if some database image is right for both, and two database
    images if both are right for some query. An image without any positive shares its place with
    no other image, whatever it shows.
    """
    right = np.concatenate(positives) if positives else np.empty(0, np.int64)
    asking = np.repeat(np.arange(len(positives)), [len(each) for each in positives])
    entries = np.ones(len(right), np.int8), (asking, right)
    truth = scipy.sparse.csr_array(entries, shape=(len(positives), database), dtype=bool)
    return _sharing(truth), _sharing(truth.T.tocsr())


def _sharing(owned: scipy.sparse.csr_array) -> SamePlace:
    """Make the test that two rows have an entry in common; memory is linear in pairs."""
    step = max(1, _CHUNK // int(np.diff(owned.indptr).max(initial=1)))

    def same(a: Int64[np.ndarray, " pair"], b: Int64[np.ndarray, " pair"]) -> np.ndarray:
        pieces = (slice(i, i + step) for i in range(0, len(a), step))
        counts = [owned[a[piece]].multiply(owned[b[piece]]).sum(axis=1) for piece in pieces]
        return np.concatenate([np.zeros(0), *counts]) > 0

    return same


def same_place_share(batches: Batches, same: SamePlace) -> float | None:
    """Measure which share of the other images in a batch show an image's own place, 0 to 1.

    The share is averaged over all images that looked at another one; None where none did.
    """
    if batches.grouping == "single":
        return None
    share, looking = 0.0, 0
    step = max(1, _CHUNK // batches.images.shape[1] ** 2)
    for start in range(0, len(batches.images), step):
        part = batches.part(start, start + step)
        others = part.attention_mask & part.kept[:, :, None]
        others &= ~np.eye(others.shape[1], dtype=bool)
        batch, i, j = np.nonzero(others)
        image, other = part.images[batch, i], part.images[batch, j]
        place = np.ravel_multi_index((batch, i), part.images.shape)
        right = np.bincount(place[same(image, other)], minlength=part.images.size)
        seen = np.bincount(place, minlength=part.images.size)
        share += float((right[seen > 0] / seen[seen > 0]).sum())
        looking += int((seen > 0).sum())
    return share / looking if looking else None
