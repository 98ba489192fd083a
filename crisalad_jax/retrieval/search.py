"""Exact search for the most similar descriptors.

The protocol is the public one of visual place recognition: exact nearest neighbours.
"""

import functools
import itertools
import math
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Float32, Int, Int32

from crisalad_jax.config.checks import check_count
from crisalad_jax.data.loader import one_ahead
from crisalad_jax.retrieval.chunks import (
    KEPT,
    WIDE,
    Block,
    aligned,
    as_sides,
    blocks,
    gathered,
    is_mapped,
    views,
)
from crisalad_jax.retrieval.neighbours import Neighbours, exact_similarities, rounding
from crisalad_jax.utils import compiler
from crisalad_jax.utils.devices import devices_for
from crisalad_jax.utils.host import usable_cores
from crisalad_jax.utils.progress import progress_bar
from crisalad_jax.utils.target import target

# Queries compared at a time: with 4,096 database rows their similarities are 16 MiB.
_QUERY_CHUNK = 1024
_GROUP = 16
"""Number of rows in a group. Groups are ranked by their best rows first, so top_k sees few rows.
Of 8, 16, 32 and 64 this is the fastest on a CPU: half the time of one large top_k."""
_SPARE = 16
"""Candidates kept beyond k, for products that float32 cannot tell apart."""
_READ = 2**22
"""Size of the candidates that are read from a database at a time, in numbers: 16 MiB."""
_Pairs = tuple[Int[np.ndarray, " pair"], Int[np.ndarray, " pair"], Float32[np.ndarray, " pair"]]
"""Queries in rising order, rows of a block in rising order for each, and their products."""


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
    on_host = target().platform == "cpu"
    return _search(database, queries, k, chunk, on_host=on_host, label=label, quiet=quiet)


def _search(
    database: Float[np.ndarray, "n d"],
    queries: Float[np.ndarray, "q d"],
    k: int,
    chunk: int,
    *,
    on_host: bool,
    label: str = "search",
    quiet: bool = True,
) -> Neighbours:
    """Search with numpy (`on_host`) or with the devices; see `search`."""
    count, k = len(database), min(k, len(database))
    chunk = _even(count, chunk, len(jax.local_devices()) * _GROUP)
    size = min(_QUERY_CHUNK, len(queries))
    fresh = (aligned((size, queries.shape[1]), WIDE) for _ in itertools.count())
    parts = [_Part(block, k) for block in blocks(queries, "queries", fresh)]
    if on_host and database.dtype == WIDE and not is_mapped(database):
        stream = views(database, "database", chunk)
    else:
        # Three buffers: one is being read, one is with the devices, one is being ranked.
        dtype = database.dtype if database.dtype in KEPT else WIDE
        buffers = [aligned((chunk, database.shape[1]), dtype) for _ in range(3)]
        stream = blocks(database, "database", itertools.cycle(buffers))
    with progress_bar(label, count, "rows", quiet=quiet) as bar:
        name = _on_host if on_host else _on_devices
        for block, part, pairs in name(parts, one_ahead(stream), chunk):
            part.take(block, pairs(), database)
            if part is parts[-1]:
                bar.advance(block.valid)
        neighbours = [part.neighbours(database) for part in parts]
    return Neighbours(*(np.concatenate(arrays) for arrays in zip(*neighbours, strict=True)))


def _even(count: int, chunk: int, each: int) -> int:
    """Round a chunk to a multiple of `each` that splits `count` rows evenly."""
    return -(-count // (each * -(-count // chunk))) * each


@functools.cache
def _program(mesh: Mesh, count: int) -> Any:
    def best(
        rows: Float[Array, "rows d"], valid: Int32[Array, ""], queries: Float32[Array, "q d"]
    ) -> tuple[Float32[Array, "1 q m"], Int32[Array, "1 q m"]]:
        # The queries are the right factor: on a CPU the product then takes a third less time.
        products = jnp.matmul(
            rows.astype(jnp.float32), queries.T, precision=jax.lax.Precision.HIGHEST
        )
        start = jax.lax.axis_index("image") * len(rows)
        padding = start + jnp.arange(len(rows)) >= valid
        products = jnp.where(padding[:, None], -jnp.inf, products)
        if len(rows) // _GROUP <= count:  # as few rows as eight devices have of a chunk
            values, places = jax.lax.top_k(products.T, count)
            return values[None], start + places[None]
        # The `count` largest products lie in the `count` groups with the largest maxima.
        largest = products.reshape(-1, _GROUP, len(queries)).max(axis=1).T
        _, groups = jax.lax.top_k(largest, min(count, largest.shape[1]))
        places = (groups[:, :, None] * _GROUP + jnp.arange(_GROUP)).reshape(len(queries), -1)
        inside = products[places, jnp.arange(len(queries))[:, None]]
        values, chosen = jax.lax.top_k(inside, count)
        return values[None], start + jnp.take_along_axis(places, chosen, axis=1)[None]

    image, alike = PartitionSpec("image"), PartitionSpec()
    return compiler.jit(
        jax.shard_map(best, mesh=mesh, in_specs=(image, alike, alike), out_specs=(image, image))
    )


class _Part:
    """A block of queries, and the candidates for the best of each."""

    def __init__(self, block: Block, k: int) -> None:
        """Start without candidates for a block of queries."""
        self.block, self.k = block, k
        self.queries = block.rows[: block.valid]
        self.error = rounding(self.queries.shape[1])
        shape = block.valid, k + _SPARE
        self.values, self.indices = np.full(shape, -np.inf, np.float32), np.full(shape, -1)

    def least(self) -> Float32[np.ndarray, " q"]:
        """Return `least_of` the candidates' products."""
        return self.least_of(self.values)

    def least_of(self, values: Float32[np.ndarray, "line m"]) -> Float32[np.ndarray, " line"]:
        """Return the product below which no row is among the k best, whatever the rounding."""
        return np.partition(values, -self.k, axis=1)[:, -self.k] - np.float32(2 * self.error)

    def take(self, block: Block, pairs: _Pairs, database: Float[np.ndarray, "n d"]) -> None:
        """Add pairs of queries and a block's rows to the candidates."""
        query, row, value = pairs
        if not query.size:
            return
        width = self.values.shape[1]
        touched, line, counts = np.unique(query, return_inverse=True, return_counts=True)
        column = width + np.arange(len(query)) - np.repeat(np.cumsum(counts) - counts, counts)
        shape = len(touched), width + counts.max()
        values, indices = np.full(shape, -np.inf, np.float32), np.full(shape, -1)
        values[:, :width], indices[:, :width] = self.values[touched], self.indices[touched]
        values[line, column], indices[line, column] = value, block.start + row
        least = self.least_of(values)
        values[values < least[:, None]] = -np.inf
        crowded = np.flatnonzero(np.isfinite(values).sum(axis=1) > width)
        if crowded.size:
            some = values[crowded], indices[crowded], self.queries[touched[crowded]]
            best = self._ranked(*some, database)
            values[crowded], indices[crowded] = -np.inf, -1
            values[crowded, : self.k], indices[crowded, : self.k] = (
                best.similarities,
                best.indices,
            )
        order = np.argsort(-values, axis=1, kind="stable")[:, :width]
        self.values[touched] = np.take_along_axis(values, order, axis=1)
        self.indices[touched] = np.take_along_axis(indices, order, axis=1)

    def neighbours(self, database: Float[np.ndarray, "n d"]) -> Neighbours:
        """Return the k best of each query, once all blocks are taken."""
        wanted = np.where(self.values >= self.least()[:, None], self.values, -np.inf)
        return self._ranked(wanted, self.indices, self.queries, database)

    def _ranked(
        self,
        values: Float32[np.ndarray, "line m"],
        indices: Int[np.ndarray, "line m"],
        queries: Float32[np.ndarray, "line d"],
        database: Float[np.ndarray, "n d"],
    ) -> Neighbours:
        """Rank the candidates with finite values by their exact similarities; keep the k best."""
        line, column = np.nonzero(np.isfinite(values))
        similarities = np.full(values.shape, -np.inf, np.float32)
        pairs = line, indices[line, column]
        similarities[line, column] = _similarities_of(queries, database, *pairs)
        order = np.lexsort((indices, -similarities))[:, : self.k]
        return Neighbours(
            np.take_along_axis(indices, order, axis=1),
            np.take_along_axis(similarities, order, axis=1),
        )


_Named = Iterator[tuple[Block, _Part, Callable[[], _Pairs]]]
"""Each block with each part of the queries, and a function that returns their pairs."""


def _on_host(parts: Sequence[_Part], stream: Iterator[Block], chunk: int) -> _Named:
    """Multiply by numpy, while the products before are sorted into the candidates."""
    size = len(parts[0].queries)
    # The buffers are reused: allocating new memory takes longer than writing the products.
    memory = itertools.cycle([np.empty(chunk * size, np.float32) for _ in range(2)])

    def multiply() -> Generator[tuple[Block, _Part, Float32[np.ndarray, "rows q"]], None, None]:
        for block in stream:
            rows = block.rows[: block.valid].astype(np.float32, copy=False)
            for part in parts:
                shape = len(rows), len(part.queries)
                products = next(memory)[: math.prod(shape)].reshape(shape)
                # The queries are the right factor: the product then takes a tenth less time.
                yield block, part, np.matmul(rows, part.queries.T, out=products)

    for block, part, products in one_ahead(multiply()):
        yield block, part, functools.partial(_of_products, part, products)


def _of_products(part: _Part, products: Float32[np.ndarray, "rows q"]) -> _Pairs:
    least = part.least()
    fresh = np.isneginf(least)
    if fresh.any() and len(products) >= part.k:
        least[fresh] = part.least_of(products.T[fresh])
    row, query = np.nonzero(products >= least)
    order = np.argsort(query, kind="stable")
    row, query = row[order], query[order]
    return query, row, products[row, query]


def _on_devices(parts: Sequence[_Part], stream: Iterator[Block], chunk: int) -> _Named:
    """Multiply on the devices, over which a block's rows are sharded, one block ahead."""
    devices = devices_for(chunk)
    queries = [devices.replicate(part.block.rows) for part in parts]
    program = _program(devices.mesh, min(parts[0].k + _SPARE, chunk // devices.mesh.size))
    before: list[tuple[Block, _Part, Callable[[], _Pairs]]] = []
    for block in stream:
        rows, valid = devices.shard_batch(block.rows), np.int32(block.valid)
        candidates = [program(rows, valid, each) for each in queries]
        yield from before
        before = [
            (block, part, functools.partial(_of_candidates, part, block, *arrays))
            for part, arrays in zip(parts, candidates, strict=True)
        ]
    yield from before


def _of_candidates(part: _Part, block: Block, *arrays: Array) -> _Pairs:
    values, places = (np.asarray(array)[:, : len(part.queries)] for array in arrays)
    least = part.least()
    all_values = np.concatenate(values, axis=1)
    if all_values.shape[1] >= part.k:
        least = np.maximum(least, part.least_of(all_values))
    wanted = (all_values >= least[:, None]) & np.isfinite(all_values)
    # A device whose last candidate is still good enough may have left out others: the block's
    # products with those queries are computed again.
    last = values[:, :, -1]
    crowded = ((last >= least) & np.isfinite(last)).any(axis=0)
    wanted[crowded] = False
    query, column = np.nonzero(wanted)
    row, value = np.concatenate(places, axis=1)[query, column], all_values[query, column]
    if crowded.any():
        rows = block.rows[: block.valid].astype(np.float32, copy=False)
        products = part.queries[crowded] @ rows.T
        also, there = np.nonzero(products >= least[crowded, None])
        query = np.concatenate([query, np.flatnonzero(crowded)[also]])
        row = np.concatenate([row, there])
        value = np.concatenate([value, products[also, there]])
    order = np.lexsort((row, query))
    return query[order], row[order], value[order]


def _similarities_of(
    queries: Float32[np.ndarray, "q d"],
    database: Float[np.ndarray, "n d"],
    query: Int[np.ndarray, " pair"],
    index: Int[np.ndarray, " pair"],
) -> Float32[np.ndarray, " pair"]:
    """Compute `exact_similarities` of rows anywhere in the database, read in file order."""
    similarities = np.empty(len(query), np.float32)
    order = np.argsort(index, kind="stable")
    size = max(1, _READ // queries.shape[1])

    def fill(start: int) -> None:
        piece = order[start : start + size]
        rows, place = np.unique(index[piece], return_inverse=True)
        read = gathered(database, rows)
        similarities[piece] = exact_similarities(queries, read, query[piece], place)

    with ThreadPoolExecutor(usable_cores()) as threads:
        list(threads.map(fill, range(0, len(order), size)))
    return similarities
