"""Exact search for the most similar descriptors.

Published evaluations of visual place recognition use exact nearest neighbours.
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
from crisalad_jax.data.loader import one_ahead
from crisalad_jax.retrieval.bits import Bits, search_bits
from crisalad_jax.retrieval.chunks import (
    BITS,
    Block,
    Descriptors,
    Queries,
    as_sides,
    as_unit_rows,
    blocks,
    check_rows,
    gathered,
)
from crisalad_jax.retrieval.neighbours import QUERY_CHUNK, Neighbours, Products, multiply, nearest
from crisalad_jax.utils import compiler
from crisalad_jax.utils.devices import IMAGE, devices_for
from crisalad_jax.utils.progress import progress_bar
from crisalad_jax.utils.target import target


def search(
    database: Descriptors | Bits,
    queries: Float[np.ndarray, "q d"] | Bits,
    k: int,
    *,
    chunk: int = 4096,
    quiet: bool = True,
) -> Neighbours:
    """Find the most similar database descriptors of each query, exactly.

    The database may be a memory map that is larger than memory. It is read once, `chunk` rows at a
    time and one chunk ahead; the best rows are then read again. Apart from the inputs, memory holds
    three chunks and their similarities to 1,024 queries. Pages of a memory map are released after
    use. If queries have many near copies in the database, all of it is read a second time.

    Float32 products select candidates; NumPy computes these products on a CPU, and JAX on other
    devices. The similarities of candidates are then summed in float64 and rounded to float32, so
    they depend on neither chunk nor devices. Equal similarities are ordered by database index.

    Packed bits are compared by Hamming distance, in NumPy. Their similarity is 1 - 2 h / d, where
    h of the d bits differ: the cosine of the sign vectors.

    Args:
        database: unit descriptors of the n database images, in float32, float16 or bfloat16 (which
            a .npy file stores as two untyped bytes, "V2"), or in another type that is converted to
            float32; or bits from `pack_bits`.
        queries: unit descriptors of the q queries, or their bits.
        k: number of neighbours per query; all n if there are fewer.
        chunk: database rows compared at a time, rounded up to a multiple of the device count.
        quiet: whether to hide the progress bar.

    Returns:
        Indices into the database and similarities, (q, k), best first.

    Raises:
        InputError: an array is empty, is not a matrix, or has a row that is not finite or not of
            unit norm; descriptors differ in length; only one side has bits; k or chunk is below 1.

    Example:
        >>> import numpy as np
        >>> search(np.eye(3, dtype=np.float32), np.eye(3, dtype=np.float32)[1:], 1).indices.tolist()
        [[1], [2]]
    """
    for name, value in (("k", k), ("chunk", chunk)):
        check_count(name, value)
    if BITS in (np.asanyarray(side).dtype for side in (database, queries)):
        return search_bits(database, queries, k)
    database, queries = as_sides(database, queries)
    queries = as_unit_rows(queries, "queries")
    count, on_host = len(database), target().platform == "cpu"
    devices = len(jax.local_devices())
    size = -(-min(chunk, count) // devices) * devices
    stream = functools.partial(blocks, database, "database", size)

    with progress_bar("search", count, "rows", quiet=quiet) as bar:

        def shown() -> Generator[Block, None, None]:
            for block in blocks(database, "database", size, narrow=not on_host):
                yield block
                bar.advance(len(block.rows))

        def products(width: int) -> Generator[Products, None, None]:
            if on_host:
                return multiply(shown(), queries, size)
            return _by_devices(shown(), queries, size, width)

        read_rows = functools.partial(gathered, database)
        return nearest(stream, queries, min(k, count), read_rows, size, products)


def to_unit_vectors(
    database: Descriptors, queries: Float[np.ndarray, "q d"]
) -> tuple[Float32[np.ndarray, "n d+3"], Float32[np.ndarray, "q d+3"]]:
    r"""Embed descriptors so that their cosines rank the database as the Euclidean distances do.

    After division by the largest norm of all, x of the database and y of the queries become

    $$\left(\sqrt{\tfrac23}\,x,\ \tfrac{|x|^2}{\sqrt3},\ a,\ 0\right) \quad\text{and}\quad
    \left(\sqrt{\tfrac23}\,y,\ -\tfrac{1}{\sqrt3},\ 0,\ b\right),$$

    where a and b bring the norms to 1. The cosine is then (|y|^2 - |x - y|^2) / 3.

    Args:
        database: descriptors of the n database images, of any norms.
        queries: descriptors of the q queries, of any norms.

    Returns:
        Unit vectors of the database and of the queries, with three more dimensions, in float32.

    Raises:
        InputError: a side is not a matrix, or is empty; the sides' widths differ; a value is not
            finite.

    Example:
        >>> import numpy as np
        >>> database = np.array([[9.0, 9.0], [1.0, 2.0]])
        >>> search(*to_unit_vectors(database, np.array([[2.0, 2.0]])), 1).indices.tolist()
        [[1]]
    """
    sides = as_sides(database, queries)
    for name, side in zip(("database", "queries"), sides, strict=True):
        check_rows(side, name, range(len(side)), unit=False)
    lengths = [np.linalg.norm(side.astype(np.float64), axis=1) for side in sides]
    largest = max(1e-30, *(found.max() for found in lengths))
    squares = [np.square(found / largest) for found in lengths]
    last = np.sqrt(1 / 3) * squares[0], np.full_like(squares[1], -np.sqrt(1 / 3))
    embedded = []
    for number, (side, square, third) in enumerate(zip(sides, squares, last, strict=True)):
        unit = np.zeros((len(side), side.shape[1] + 3), np.float32)
        unit[:, :-3] = np.sqrt(2 / 3) / largest * side
        unit[:, -3] = third
        unit[:, -2 + number] = np.sqrt(np.maximum(0, 1 - 2 / 3 * square - third**2))
        embedded.append(unit)
    return embedded[0], embedded[1]


def _by_devices(
    stream: Generator[Block, None, None], queries: Queries, size: int, width: int
) -> Generator[Products, None, None]:
    """Multiply on the devices, with the rows of a block sharded over them.

    Each device returns the `width` largest products of its rows with each query.
    """
    devices = devices_for(size)
    width = min(width, size // devices.mesh.size)
    together = min(QUERY_CHUNK, len(queries))
    firsts = range(0, len(queries), together)
    parts = [devices.replicate(_padded(queries[i : i + together], together)) for i in firsts]

    def dispatched() -> Generator[tuple[int, int, tuple[Array, Array]], None, None]:
        for block in one_ahead(stream):
            rows, valid = devices.shard_batch(_padded(block.rows, size)), np.int32(len(block.rows))
            for first, part in zip(firsts, parts, strict=True):
                yield first, block.start, _largest(rows, valid, part, devices.mesh, width)

    for first, start, arrays in one_ahead(dispatched()):
        values, places = (np.asarray(array)[:, : len(queries) - first] for array in arrays)
        yield Products(first, values, start + places.astype(np.int64))


def _padded(rows: Descriptors, size: int) -> Float[np.ndarray, "size d"]:
    """Append rows of zeros."""
    return np.pad(rows, ((0, size - len(rows)), (0, 0))) if len(rows) < size else rows


@functools.partial(compiler.jit, static_argnames=("mesh", "width"))
def _largest(
    rows: Float[Array, "rows d"],
    valid: Int32[Array | np.generic, ""],
    queries: Float32[Array | np.ndarray, "q d"],
    mesh: Mesh,
    width: int,
) -> tuple[Float32[Array, "m q"], Int32[Array, "m q"]]:
    """Find the largest products on each device, and their places; padding starts at `valid`."""

    def on_a_device(rows: Array, valid: Array, queries: Array) -> tuple[Array, Array]:
        wide = rows.astype(jnp.float32)
        products = jnp.matmul(queries, wide.T, precision=jax.lax.Precision.HIGHEST)
        start = jax.lax.axis_index(IMAGE) * len(rows)
        is_valid = start + jnp.arange(len(rows)) < valid
        values, places = jax.lax.top_k(jnp.where(is_valid, products, -jnp.inf), width)
        return values.T, start + places.T

    image, alike = PartitionSpec(IMAGE), PartitionSpec()
    shared: Any = jax.shard_map(
        on_a_device, mesh=mesh, in_specs=(image, alike, alike), out_specs=(image, image)
    )
    return shared(rows, valid, queries)
