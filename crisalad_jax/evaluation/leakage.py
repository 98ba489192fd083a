"""Leakage of a grouping: how much the images of a batch reveal about each other's place."""

from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float64, Int64

from crisalad_jax.retrieval.grouping import MASKED, Batches

SamePlace = Callable[
    [Int64[np.ndarray, " pair"], Int64[np.ndarray, " pair"]], Bool[np.ndarray, " pair"]
]
"""A test of which pairs of queries, or of database images, given by index, share a place."""

# Elements in an array of pairs: tens of megabytes, for any number of images.
_CHUNK = 2**21


def near(positions: Float64[np.ndarray, "image axis"], radius: float) -> SamePlace:
    """Return a test of whether two images were taken at most `radius` metres apart."""

    def same(a: Int64[np.ndarray, " pair"], b: Int64[np.ndarray, " pair"]) -> np.ndarray:
        return np.square(positions[a] - positions[b]).sum(axis=1) <= radius * radius

    return same


def by_truth(
    positives: Sequence[Int64[np.ndarray, " _"]], database: int
) -> tuple[SamePlace, SamePlace]:
    """Return tests of whether two queries, or two of the database images, show the same place.

    The tests use only ground truth: `positives`, the indices of each query's correct images among
    `database` images. Two queries share a place if some image is correct for both, and two database
    images if both are correct for some query. An image without a match shares its place with none.
    """
    truth = _truth(positives, database)
    return _sharing(truth), _sharing(truth.T.tocsr())


def _truth(positives: Sequence[Int64[np.ndarray, " _"]], database: int) -> scipy.sparse.csr_array:
    """Return which database images are correct for each query, as a sparse matrix of ones."""
    right = np.concatenate(positives) if positives else np.empty(0, np.int64)
    asking = np.repeat(np.arange(len(positives)), [len(each) for each in positives])
    entries = np.ones(len(right), np.int32), (asking, right)
    return scipy.sparse.csr_array(entries, shape=(len(positives), database))


def _sharing(owned: scipy.sparse.csr_array) -> SamePlace:
    """Return a test of whether two rows share an entry; memory is linear in the pairs."""
    step = max(1, _CHUNK // int(np.diff(owned.indptr).max(initial=1)))

    def same(a: Int64[np.ndarray, " pair"], b: Int64[np.ndarray, " pair"]) -> np.ndarray:
        pieces = (slice(i, i + step) for i in range(0, len(a), step))
        counts = [owned[a[piece]].multiply(owned[b[piece]]).sum(axis=1) for piece in pieces]
        return np.concatenate([np.zeros(0), *counts]) > 0

    return same


def masked(batches: Batches, same: SamePlace) -> Batches:
    """Let each image attend only to itself and to images of its batch that show other places.

    Each image gets its own batch. In a shared batch with a mask, an image would still see others of
    its place in the second layer, through a third image.

    Args:
        batches: batches in which all images are kept (`Batches.kept`), as in `sequential`.
        same: test of whether two images show the same place.
    """
    batch, place = np.nonzero(batches.kept)
    images, filled = batches.images[batch], batches.filled[batch].copy()
    own = images[np.arange(len(batch)), place]
    row, column = np.nonzero(filled)
    filled[row, column] = ~same(own[row], images[row, column])
    kept = np.zeros_like(filled)
    kept[np.arange(len(batch)), place] = True
    return Batches(images, filled | kept, kept, MASKED)


def mirrored_share(
    queries: Batches, database: Batches, positives: Sequence[Int64[np.ndarray, " _"]]
) -> float | None:
    """Measure how closely a query's batch mirrors the batch of its correct answer, 0 to 1.

    For a query and one of its positives, this is the share of the other queries in the query's
    batch that have a positive in the batch of that positive; the largest share counts. It is 1 if
    queries and database have the same file order: both batches then show the same places, and what
    their images share identifies that part of the sequence. The result is the mean over queries
    with a positive that attend to others; None without such queries, or if a grouping is `single`.
    """
    if "single" in (queries.grouping, database.grouping):
        return None
    seen, others = _sight(database), _sight(queries)
    others.setdiag(0)
    others.eliminate_zeros()
    truth = _truth(positives, int(database.kept.sum()))
    at_answer = (truth @ seen.T).astype(bool).astype(np.int32)  # has a positive in sight of it
    shares = (others @ at_answer).multiply(truth).max(axis=1).toarray().ravel()
    counts = np.diff(others.indptr)
    asked = (counts > 0) & (np.diff(truth.indptr) > 0)
    return float((shares[asked] / counts[asked]).mean()) if asked.any() else None


def _sight(batches: Batches) -> scipy.sparse.csr_array:
    """Return which images each image attends to, itself included, as a matrix of ones."""
    batch, place = np.nonzero(batches.kept)
    row, column = np.nonzero(batches.filled[batch])
    seen = batches.images[batch[row], column]
    count = len(batch)
    entries = np.ones(len(row), np.int32), (batches.images[batch, place][row], seen)
    return scipy.sparse.csr_array(entries, shape=(count, count))


def same_place_share(batches: Batches, same: SamePlace) -> float | None:
    """Measure the share of same-place images among the others that an image attends to, 0 to 1.

    The result is the mean over images that attend to another image; None if no image does.
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
