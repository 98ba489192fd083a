"""Exact search over descriptors and Recall@K: the one copy of each.

The protocol is the public one of visual place recognition: exact nearest neighbours in float32, and
a recall that counts every query.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int, Int32, Int64

from crisalad_jax.errors import InputError

# Queries compared at a time: with 8,192 database rows a block of similarities is 32 MiB.
_QUERY_CHUNK = 1024
_MAP_CHUNK = 8192
# Descriptors may arrive as float16, whose unit vectors are off by up to 1e-3.
_UNIT_TOLERANCE = 1e-2


class Neighbours(NamedTuple):
    """The most similar database images of each query, best first."""

    indices: Int64[np.ndarray, "q k"]
    similarities: Float32[np.ndarray, "q k"]


def search(
    database: Float[np.ndarray, "n d"],
    queries: Float[np.ndarray, "q d"],
    k: int,
    *,
    chunk: int = 8192,
) -> Neighbours:
    """Exact search by inner product, which for unit vectors orders as the L2 distance does.

    The database may be a memory map: it is read once, `chunk` rows at a time, and beyond the inputs
    memory depends on `chunk` and on the number of queries, not on the size of the database. Equal
    similarities are ordered by database index, lower first, whatever the chunk.

    Args:
        database: unit descriptors of the n database images.
        queries: unit descriptors of the q queries.
        k: neighbours per query; a database of fewer images gives all of them, min(k, n).
        chunk: database rows compared at a time.

    Raises:
        InputError: an array that is empty, no matrix, or holds a row that is not finite or not of
            unit length; descriptors of two lengths; k or chunk below 1.
    """
    for name, value in (("k", k), ("chunk", chunk)):
        if value < 1:
            raise InputError(f"{name}: found {value}, expected at least 1")
    _check_sides(database, queries)
    count, k = len(database), min(k, len(database))
    chunk = min(chunk, count)
    indices = np.empty((len(queries), 0), np.int64)
    similarities = np.empty((len(queries), 0), np.float32)
    for start in range(0, count, chunk):
        block = jnp.asarray(_block(database, "database", start, chunk))
        valid = min(chunk, count - start)
        found = _search_block(block, valid, queries, k)
        # Earlier blocks stand first and the sort is stable: a tie goes to the lower index.
        similarities = np.concatenate([similarities, found.similarities], axis=1)
        indices = np.concatenate([indices, found.indices + start], axis=1)
        order = np.argsort(-similarities, axis=1, kind="stable")[:, :k]
        similarities = np.take_along_axis(similarities, order, axis=1)
        indices = np.take_along_axis(indices, order, axis=1)
    return Neighbours(indices, similarities)


def similarity_map(
    database: Float[np.ndarray, "n d"], queries: Float[np.ndarray, "q d"], *, most: int = 400
) -> Float32[np.ndarray, "rows columns"]:
    """All similarities of queries (rows) and database (columns), in their order, for a picture.

    Where there are more than `most` of either, a cell is the largest of the images that
    `cells_of` gives it. Memory depends on the blocks that are compared at a time, not on the sets.

    Raises:
        InputError: as `search`.
    """
    _check_sides(database, queries)
    rows, columns = cells_of(len(queries), most), cells_of(len(database), most)
    found = np.full((rows[-1] + 1, columns[-1] + 1), -np.inf, np.float32)
    size, width = min(_QUERY_CHUNK, len(queries)), min(_MAP_CHUNK, len(database))
    for left in range(0, len(database), width):
        block = jnp.asarray(_block(database, "database", left, width))
        for top in range(0, len(queries), size):
            part = jnp.asarray(_block(queries, "queries", top, size))
            cells = [
                _filled(ids[start : start + length], length, found.shape[axis])
                for axis, ids, start, length in ((0, rows, top, size), (1, columns, left, width))
            ]
            np.maximum(found, _largest(block, part, *cells, shape=found.shape), out=found)
    return found


def cells_of(count: int, most: int) -> Int64[np.ndarray, " count"]:
    """Which of at most `most` cells each of `count` images in a row falls into, evenly."""
    return np.arange(count) * min(count, most) // count


def _filled(cells: Int64[np.ndarray, " _"], length: int, none: int) -> Int64[np.ndarray, " length"]:
    """Rows that only fill a block up belong to no cell."""
    return np.append(cells, np.full(length - len(cells), none))


@functools.partial(jax.jit, static_argnames="shape")
def _largest(
    block: Float32[Array, "chunk d"],
    queries: Float32[Array, "q d"],
    rows: Int[Array, " q"],
    columns: Int[Array, " chunk"],
    shape: tuple[int, int],
) -> Float32[Array, "rows columns"]:
    similarities = jnp.matmul(queries, block.T, precision=jax.lax.Precision.HIGHEST)
    by_row = jax.ops.segment_max(similarities, rows, shape[0])
    return jax.ops.segment_max(by_row.T, columns, shape[1]).T


def recalls(
    indices: Int[np.ndarray, "q k"],
    positives: Sequence[Int[np.ndarray, " _"]],
    ks: Sequence[int] = (1, 5, 10, 20),
) -> dict[int, float]:
    """Recall@K: queries with at least one positive among their top K, over **all** queries.

    A query without positives is a miss. `search` for max(ks) returns fewer columns only where the
    database is smaller, so a K beyond the columns counts them all.

    Args:
        indices: database indices of each query's neighbours, best first.
        positives: the database indices that are right for each query, possibly none.
        ks: the values of K.

    Returns:
        K -> fraction of the queries, 0 to 1.

    Raises:
        InputError: no queries; positives for another number of queries; a negative positive (some
            ground truths write -1 for "no match": leave it out); a K below 1.
    """
    if len(indices) == 0:
        raise InputError("indices: found no queries, expected at least one")
    if len(positives) != len(indices):
        raise InputError(
            f"positives: found {len(positives)} lists, expected {len(indices)}, one for each query"
        )
    if min(ks, default=1) < 1:
        raise InputError(f"ks: found {min(ks)}, expected at least 1")
    right = np.zeros(indices.shape, bool)
    for query, wanted in enumerate(positives):
        if np.size(wanted) and np.min(wanted) < 0:
            raise InputError(
                f"positives: query {query} has {np.min(wanted)}, expected database indices"
            )
        right[query] = np.isin(indices[query], wanted)
    return {k: float(right[:, :k].any(axis=1).mean()) for k in ks}


def _check_sides(database: Float[np.ndarray, "n d"], queries: Float[np.ndarray, "q d2"]) -> None:
    for name, array in (("database", database), ("queries", queries)):
        if array.ndim != 2 or 0 in array.shape:
            raise InputError(
                f"{name}: found shape {array.shape}, expected (images, descriptor), neither zero"
            )
    if database.shape[1] != queries.shape[1]:
        raise InputError(
            f"queries: found descriptors of length {queries.shape[1]}, "
            f"expected {database.shape[1]} as in the database"
        )


def _block(
    array: Float[np.ndarray, "n d"], name: str, start: int, size: int
) -> Float32[np.ndarray, "size d"]:
    """Rows `start` to `start + size`, checked; zero rows fill up what the array lacks."""
    with np.errstate(over="ignore"):  # what overflows is reported below
        rows = np.asarray(array[start : start + size], np.float32)
        norms = np.linalg.norm(rows, axis=1)
    # "Not within" rather than "beyond", so that NaN and infinity count as wrong.
    wrong = np.flatnonzero(~(np.abs(norms - 1) <= _UNIT_TOLERANCE))
    if wrong.size:
        row = wrong[0]
        found = f"of length {norms[row]:.4g}" if np.isfinite(rows[row]).all() else "not finite"
        raise InputError(
            f"{name}: row {start + row} is {found}, expected finite unit vectors "
            f"({wrong.size} wrong of {len(rows)} rows from {start})"
        )
    block = np.zeros((size, rows.shape[1]), np.float32)
    block[: len(rows)] = rows
    return block


def _search_block(
    block: Float32[Array, "chunk d"],
    valid: int,
    queries: Float[np.ndarray, "q d"],
    k: int,
) -> Neighbours:
    """The best of one database block for all queries; indices count from the block's first row."""
    k = min(k, valid)
    size = min(_QUERY_CHUNK, len(queries))
    parts = []
    for start in range(0, len(queries), size):
        part = jnp.asarray(_block(queries, "queries", start, size))
        similarities, indices = _top(block, part, valid, k)
        rows = min(size, len(queries) - start)
        parts.append((np.asarray(indices)[:rows], np.asarray(similarities)[:rows]))
    indices, similarities = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Neighbours(indices.astype(np.int64), similarities)


@functools.partial(jax.jit, static_argnames="k")
def _top(
    block: Float32[Array, "chunk d"],
    queries: Float32[Array, "q d"],
    valid: Int[Array, ""] | int,
    k: int,
) -> tuple[Float32[Array, "q k"], Int32[Array, "q k"]]:
    similarities = jnp.matmul(queries, block.T, precision=jax.lax.Precision.HIGHEST)
    # Of equal values top_k takes the lower index first, but it orders -0.0 below 0.0.
    similarities = jnp.where(similarities == 0, 0, similarities)
    padding = jnp.arange(len(block)) >= valid
    best, indices = jax.lax.top_k(jnp.where(padding[None], -jnp.inf, similarities), k)
    return best, indices
