"""Exact search for the most similar descriptors.

The protocol is the public one of visual place recognition: exact nearest neighbours.
"""

import functools
from collections.abc import Generator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Float32, Int32

from crisalad_jax.config.checks import check_count
from crisalad_jax.data.read_ahead import one_ahead
from crisalad_jax.retrieval.chunks import (
    WIDE,
    Block,
    as_sides,
    blocks,
    check_rows,
    gathered,
)
from crisalad_jax.retrieval.neighbours import QUERY_CHUNK, Neighbours, Products, multiply, nearest
from crisalad_jax.utils import compiler
from crisalad_jax.utils.devices import devices_for
from crisalad_jax.utils.progress import progress_bar
from crisalad_jax.utils.target import target


def search(
    database: Float[np.ndarray, "n d"],
    queries: Float[np.ndarray, "q d"],
    k: int,
    *,
    chunk: int = 4096,
    label: str = "search",
    quiet: bool = True,
) -> Neighbours:
    """Find the most similar database descriptors of each query, exactly.

    The database may be a memory map, larger than memory. It is read once, `chunk` rows at a time,
    one chunk ahead; the best rows are read once more. Beyond the inputs, memory holds three chunks
    and their similarities to 1,024 queries, whatever the size of the database. Pages of a memory
    map are released after use. (Many copies of one image may add the pairs of a whole chunk.)

    Products in float32 select candidates: all rows that may be among the best, whatever the
    rounding. Numpy multiplies on a CPU, the devices elsewhere. A candidate's final similarity is
    summed in float64 and rounded to float32: the same bits whatever the chunk and the devices.
    Equal similarities are ordered by database index, lower first.

    Args:
        database: unit descriptors of the n database images, in float32, float16 or bfloat16 (which
            a .npy file holds as two bytes without a type, "V2"), or other numbers that become
            float32.
        queries: unit descriptors of the q queries, alike.
        k: neighbours per query; a database of fewer images gives all of them, min(k, n).
        chunk: database rows compared at a time, rounded so that chunks and devices share alike.
        label: of the progress bar.
        quiet: no progress bar.

    Returns:
        Indices into the database and similarities, (q, k), best first.

    Raises:
        InputError: an array that is empty, no matrix, or holds a row that is not finite or not of
            unit length; descriptors of two lengths; k or chunk below 1.

    Example:
        >>> import numpy as np
        >>> search(np.eye(3, dtype=np.float32), np.eye(3, dtype=np.float32)[1:], 1).indices.tolist()
        [[1], [2]]
    """
    for name, value in (("k", k), ("chunk", chunk)):
        check_count(name, value)
    database, queries = as_sides(database, queries)
    with np.errstate(over="ignore"):  # what overflows is reported
        queries = np.ascontiguousarray(queries, WIDE)
    check_rows(queries, "queries", range(len(queries)), unit=True)
    on_host = target().platform == "cpu"
    return _search(database, queries, k, chunk, on_host=on_host, label=label, quiet=quiet)


def _search(
    database: Float[np.ndarray, "n d"],
    queries: Float32[np.ndarray, "q d"],
    k: int,
    chunk: int,
    *,
    on_host: bool,
    label: str = "search",
    quiet: bool = True,
) -> Neighbours:
    """Search with numpy (`on_host`) or with the devices; see `search`."""
    count, k = len(database), min(k, len(database))
    share = len(jax.local_devices())
    size = -(-min(chunk, count) // share) * share
    stream = functools.partial(blocks, database, "database", size)

    with progress_bar(label, count, "rows", quiet=quiet) as bar:

        def shown() -> Generator[Block, None, None]:
            for block in stream():
                yield block
                bar.advance(len(block.rows))

        def products(width: int) -> Generator[Products, None, None]:
            if on_host:
                return multiply(shown(), queries, size)
            return _by_devices(shown(), queries, size, width)

        read_rows = functools.partial(gathered, database)
        return nearest(stream, queries, k, read_rows, size, products)


def _by_devices(
    stream: Generator[Block, None, None], queries: Float32[np.ndarray, "q d"], size: int, width: int
) -> Generator[Products, None, None]:
    """Multiply on the devices, over which the rows of a block are sharded.

    Each device names the `width` largest products of its rows with each query.
    """
    devices = devices_for(size)
    program = _program(devices.mesh, min(width, size // devices.mesh.size))
    together = min(QUERY_CHUNK, len(queries))
    firsts = range(0, len(queries), together)
    parts = [
        devices.replicate(_padded(queries[first : first + together], together)) for first in firsts
    ]

    def dispatched() -> Generator[tuple[int, int, tuple[Array, Array]], None, None]:
        for block in one_ahead(stream):
            rows, valid = devices.shard_batch(_padded(block.rows, size)), np.int32(len(block.rows))
            for first, part in zip(firsts, parts, strict=True):
                yield first, block.start, program(rows, valid, part)

    for first, start, arrays in one_ahead(dispatched()):
        values, places = (np.asarray(array)[:, : len(queries) - first] for array in arrays)
        yield Products(first, values, start + places.astype(np.int64))


def _padded(rows: Float[np.ndarray, "n d"], size: int) -> Float[np.ndarray, "size d"]:
    """Append rows of zeros."""
    return np.pad(rows, ((0, size - len(rows)), (0, 0))) if len(rows) < size else rows


@functools.cache
def _program(mesh: Mesh, width: int) -> Any:
    def largest(
        rows: Float[Array, "rows d"], valid: Int32[Array, ""], queries: Float32[Array, "q d"]
    ) -> tuple[Float32[Array, "m q"], Int32[Array, "m q"]]:
        wide = rows.astype(jnp.float32)
        products = jnp.matmul(queries, wide.T, precision=jax.lax.Precision.HIGHEST)
        start = jax.lax.axis_index("image") * len(rows)
        is_valid = start + jnp.arange(len(rows)) < valid
        values, places = jax.lax.top_k(jnp.where(is_valid, products, -jnp.inf), width)
        return values.T, start + places.T

    image, alike = PartitionSpec("image"), PartitionSpec()
    return compiler.jit(
        jax.shard_map(largest, mesh=mesh, in_specs=(image, alike, alike), out_specs=(image, image))
    )
