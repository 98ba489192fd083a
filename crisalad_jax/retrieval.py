"""Exact search over descriptors: the one copy of it.

The protocol is the public one of visual place recognition: exact nearest neighbours in float32.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int, Int32, Int64

from crisalad_jax.errors import InputError

# Queries compared at a time: with 8,192 database rows a block of similarities is 32 MiB.
_QUERY_CHUNK = 1024
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
