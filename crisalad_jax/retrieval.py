"""Exact search over descriptors: the one copy of it.

The protocol is the public one of visual place recognition: exact nearest neighbours.
"""

import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Float32, Int, Int32, Int64

from crisalad_jax import platform
from crisalad_jax.data.loader import one_ahead
from crisalad_jax.errors import InputError
from crisalad_jax.progress import progress_bar
from crisalad_jax.rows import KEPT, UNIT_TOLERANCE, WIDE, Block, aligned, as_sides, blocks

# Queries compared at a time: with 4,096 database rows their similarities are 16 MiB.
_QUERY_CHUNK = 1024
_GROUP = 16
"""Rows of which the best one stands for all, until the best groups are known: of the groupings by
8, 16, 32 and 64 the one that takes least time on a CPU, half of that of one large top_k."""
_SPARE = 16
"""Candidates beyond k that a device names, for products that float32 cannot tell apart."""
_PIECE = 2**17
"""Numbers in a piece of what is multiplied in float64: a MiB, which stays in a core's cache."""


class Neighbours(NamedTuple):
    """The most similar database images of each query, best first."""

    indices: Int64[np.ndarray, "q k"]
    similarities: Float32[np.ndarray, "q k"]


def search(
    database: Float[np.ndarray, "n d"],
    queries: Float[np.ndarray, "q d"],
    k: int,
    *,
    chunk: int = 4096,
    label: str = "search",
    quiet: bool = True,
) -> Neighbours:
    """Exact search by inner product, which for unit vectors orders as the L2 distance does.

    The database may be a memory map, larger than memory: it is read once, `chunk` rows at a time,
    one chunk ahead of the one at work, whose rows are spread over this process's devices. Beyond
    the inputs, memory is that of three chunks and of their similarities to 1,024 queries, whatever
    the size of the database; pages of a memory map are let go once they have been used.

    The devices multiply in float32 and name candidates: all rows that may be among the best,
    whatever the rounding. A candidate's similarity is then the sum in float64, rounded to float32:
    the same bits whatever the chunk, the devices and the matrix product. Equal similarities are
    ordered by database index, lower first.

    Args:
        database: unit descriptors of the n database images, in float32, float16 or bfloat16 (which
            a .npy file holds as two bytes without a type, "V2"), or other numbers that become
            float32.
        queries: unit descriptors of the q queries, alike.
        k: neighbours per query; a database of fewer images gives all of them, min(k, n).
        chunk: database rows compared at a time, rounded so that chunks and devices share alike.
        label: of the progress bar.
        quiet: no progress bar.

    Raises:
        InputError: an array that is empty, no matrix, or holds a row that is not finite or not of
            unit length; descriptors of two lengths; k or chunk below 1.
    """
    for name, value in (("k", k), ("chunk", chunk)):
        if value < 1:
            raise InputError(f"{name}: found {value}, expected at least 1")
    database, queries = as_sides(database, queries)

    count, k = len(database), min(k, len(database))
    chunk = _even(count, chunk, len(jax.local_devices()) * _GROUP)
    devices = platform.devices_for(chunk)
    size = min(_QUERY_CHUNK, len(queries))
    fresh = (aligned((size, queries.shape[1]), WIDE) for _ in itertools.count())
    parts = [_Part(block, k, devices) for block in blocks(queries, "queries", fresh)]
    # One is read, one is with the devices, one is finished.
    dtype = database.dtype if database.dtype in KEPT else WIDE
    buffers = [aligned((chunk, database.shape[1]), dtype) for _ in range(3)]
    with progress_bar(label, count, "rows", quiet=quiet) as bar:
        at_work = None
        for block in one_ahead(blocks(database, "database", itertools.cycle(buffers))):
            rows = devices.spread(block.rows)
            found = [_candidates(rows, block.valid, part.shared, k, devices) for part in parts]
            # While the devices are at this chunk, the one before is finished here.
            if at_work is not None:
                bar.advance(_finish(parts, *at_work))
            at_work = block, found
        if at_work is not None:
            bar.advance(_finish(parts, *at_work))
    return Neighbours(
        np.concatenate([part.best.indices for part in parts]),
        np.concatenate([part.best.similarities for part in parts]),
    )


def _even(count: int, chunk: int, each: int) -> int:
    """A multiple of `each` that splits `count` rows into as few parts as `chunk` does, alike."""
    return -(-count // (each * -(-count // chunk))) * each


def _candidates(
    rows: Float[Array, "chunk d"],
    valid: int,
    queries: Float32[Array, "q d"],
    k: int,
    devices: platform.Devices,
) -> tuple[Float32[Array, "device q m"], Int32[Array, "device q m"]]:
    """The largest products of each device's rows with every query, and the rows' places in all."""
    count = min(k + _SPARE, len(rows) // devices.mesh.size)
    return _program(devices.mesh, count)(rows, np.int32(valid), queries)


@functools.cache
def _program(mesh: Mesh, count: int) -> Any:
    def best(
        rows: Float[Array, "rows d"], valid: Int32[Array, ""], queries: Float32[Array, "q d"]
    ) -> tuple[Float32[Array, "1 q m"], Int32[Array, "1 q m"]]:
        # The queries on the right: on a CPU the product takes a third less time so.
        products = jnp.matmul(
            rows.astype(jnp.float32), queries.T, precision=jax.lax.Precision.HIGHEST
        )
        start = jax.lax.axis_index("image") * len(rows)
        padding = start + jnp.arange(len(rows)) >= valid
        products = jnp.where(padding[:, None], -jnp.inf, products)
        # The largest numbers lie in as many groups, those whose own largest are so.
        largest = products.reshape(-1, _GROUP, len(queries)).max(axis=1).T
        _, groups = jax.lax.top_k(largest, min(count, largest.shape[1]))
        places = (groups[:, :, None] * _GROUP + jnp.arange(_GROUP)).reshape(len(queries), -1)
        inside = products[places, jnp.arange(len(queries))[:, None]]
        values, chosen = jax.lax.top_k(inside, count)
        return values[None], start + jnp.take_along_axis(places, chosen, axis=1)[None]

    image, alike = PartitionSpec("image"), PartitionSpec()
    return platform.jit(
        jax.shard_map(best, mesh=mesh, in_specs=(image, alike, alike), out_specs=(image, image))
    )


class _Part:
    """Some of the queries, and the best that is known for them."""

    def __init__(self, block: Block, k: int, devices: platform.Devices) -> None:
        """`block` is of queries."""
        self.queries = block.rows[: block.valid]
        self.shared: Any = devices.share(block.rows)
        shape = block.valid, k
        self.best = Neighbours(np.full(shape, -1), np.full(shape, -np.inf, np.float32))

    def take(
        self,
        block: Block,
        values: Float32[np.ndarray, "device q m"],
        places: Int32[np.ndarray, "device q m"],
    ) -> None:
        """Rank what the devices named of a block among the best."""
        k = self.best.indices.shape[1]
        error = rounding(self.queries.shape[1])
        # Whatever ends among the best has a product of at least so much.
        least = self.best.similarities[:, -1] - error
        all_values = np.concatenate(values, axis=1)
        if all_values.shape[1] >= k:
            least = np.maximum(least, np.partition(all_values, -k, axis=1)[:, -k] - 2 * error)
        wanted = (all_values >= least[:, None]) & np.isfinite(all_values)
        # Where the last that a device named is wanted, it may have left out others.
        last = values[:, :, -1]
        crowded = ((last >= least) & np.isfinite(last)).any(axis=0)
        wanted[crowded] = False
        query, column = np.nonzero(wanted)
        row = np.concatenate(places, axis=1)[query, column]
        if crowded.any():
            products = (
                self.queries[crowded] @ block.rows[: block.valid].astype(np.float32, copy=False).T
            )
            also, rows = np.nonzero(products >= least[crowded, None])
            query = np.concatenate([query, np.flatnonzero(crowded)[also]])
            row = np.concatenate([row, rows])
        order = np.lexsort((row, query))
        self._insert(block, query[order], row[order])

    def _insert(
        self, block: Block, query: Int[np.ndarray, " pair"], row: Int[np.ndarray, " pair"]
    ) -> None:
        """Sort pairs of a query and a row of the block, ordered so, into the best."""
        if not query.size:
            return
        k = self.best.indices.shape[1]
        touched, line, counts = np.unique(query, return_inverse=True, return_counts=True)
        column = k + np.arange(len(query)) - np.repeat(np.cumsum(counts) - counts, counts)
        shape = len(touched), k + counts.max()
        similarities, indices = np.full(shape, -np.inf, np.float32), np.full(shape, -1)
        similarities[:, :k] = self.best.similarities[touched]
        indices[:, :k] = self.best.indices[touched]
        similarities[line, column] = exact_similarities(self.queries, block.rows, query, row)
        indices[line, column] = block.start + row
        # A stable sort: of equal ones those found earlier stand first, and they are the lower.
        order = np.argsort(-similarities, axis=1, kind="stable")[:, :k]
        self.best.similarities[touched] = np.take_along_axis(similarities, order, axis=1)
        self.best.indices[touched] = np.take_along_axis(indices, order, axis=1)


def rounding(length: int) -> float:
    """How far a float32 product of two descriptors of this length may be off, in any order.

    The probabilistic bound of Higham and Mary (2019), lambda sqrt(n) u, at lambda = 8, where it
    fails less than once in 10^9 products; the sum of |a_i b_i| is at most the lengths' product.
    """
    return 8 * math.sqrt(length) * 2.0**-24 * (1 + UNIT_TOLERANCE) ** 2


def exact_similarities(
    queries: Float32[np.ndarray, "q d"],
    rows: Float[np.ndarray, "n d"],
    query: Int[np.ndarray, " pair"],
    row: Int[np.ndarray, " pair"],
) -> Float32[np.ndarray, " pair"]:
    """Products of pairs, each in float64 in one order whatever the others are, then rounded."""
    similarities = np.empty(len(query), np.float32)
    size = max(1, _PIECE // queries.shape[1])
    for start in range(0, len(query), size):
        piece = slice(start, start + size)
        products = rows[row[piece]].astype(np.float64)
        products *= queries[query[piece]]
        similarities[piece] = products.sum(axis=1)
    return similarities + np.float32(0)  # -0.0 and 0.0 are equal, and sort so


def _finish(parts: Sequence[_Part], block: Block, found: Sequence[tuple[Array, Array]]) -> int:
    """Take in what the devices found in a block for each part; how many rows it had."""
    for part, arrays in zip(parts, found, strict=True):
        values, places = (np.asarray(array)[:, : len(part.queries)] for array in arrays)
        part.take(block, values, places)
    return block.valid
