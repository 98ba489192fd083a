"""Exact nearest-neighbour search in any number of descriptors, without JAX."""

import itertools
import math
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.loader import one_ahead
from crisalad_jax.retrieval.chunks import UNIT_TOLERANCE, Block, Descriptors, Queries
from crisalad_jax.utils.host import usable_cores
from crisalad_jax.utils.shapes import Float, Float32, Int, Int64

QUERY_CHUNK = 1024
"""Number of queries compared at a time; their products with 4,096 rows take 16 MiB."""
_SPARE = 16
"""Extra candidates beyond k, for products that float32 cannot distinguish."""
_PIECE = 2**17
"""Number of values multiplied in float64 at a time: 1 MiB, which fits a core's cache."""
_READ = 2**22
"""Number of values in the candidate rows read from a database at a time: 16 MiB."""
_PARTITIONED = 1024
"""Number of rows whose products set the first threshold for candidates."""
_LEAST = -2.0
"""Less than any product of unit vectors."""


@brief
class Neighbours(NamedTuple):
    """The most similar database images of each query, best first, by index into the database."""

    indices: Int64[np.ndarray, "q k"]
    similarities: Float32[np.ndarray, "q k"]

    def first(self, k: int) -> "Neighbours":
        """Return the k best neighbours of each query."""
        return Neighbours(*(part[:, :k] for part in self))

    def in_order(self) -> "Neighbours":
        """Sort the neighbours of each query by descending similarity, then by index."""
        order = np.lexsort((self.indices, -self.similarities))
        return Neighbours(*(np.take_along_axis(part, order, axis=1) for part in self))


class Products(NamedTuple):
    """Inner products of some database rows with consecutive queries, in float32."""

    first: int
    """Index of the first query."""
    values: Float32[np.ndarray, "row q"]
    indices: Int64[np.ndarray, "row _"]
    """Database indices of the rows: (row, 1), or (row, q) if each query has its own rows."""


class _Pairs(NamedTuple):
    """Pairs of a query and a database row, with their products or exact similarities."""

    query: Int64[np.ndarray, " pair"]
    index: Int64[np.ndarray, " pair"]
    value: Float32[np.ndarray, " pair"]


Stream = Callable[[], Generator[Block, None, None]]
"""A function that yields all blocks of a database, from the first, each time it is called."""
ReadRows = Callable[[Int64[np.ndarray, " m"]], Float[np.ndarray, "m d"]]
"""A function that reads the database rows at some indices, which are in ascending order."""


def rounding(length: int) -> float:
    """Return a bound on the rounding error of float32 inner products of unit descriptors.

    In n dimensions, for any order of summation, it is the norms' product times 8 sqrt(n) 2^-24: the
    bound of Higham and Mary (2019) with lambda = 8, which fails less than once in 10^9 products.
    """
    return 8 * math.sqrt(length) * 2.0**-24 * (1 + UNIT_TOLERANCE) ** 2


def exact_similarities(
    queries: Queries,
    rows: Descriptors,
    query: Int[np.ndarray, " pair"],
    row: Int[np.ndarray, " pair"],
) -> Float32[np.ndarray, " pair"]:
    """Compute queries[query] . rows[row] per pair: float64 sums in a fixed order, as float32."""
    similarities = np.empty(len(query), np.float32)
    size = max(1, _PIECE // queries.shape[1])
    for start in range(0, len(query), size):
        piece = slice(start, start + size)
        products = rows[row[piece]].astype(np.float64)
        products *= queries[query[piece]]
        similarities[piece] = products.sum(axis=1)
    return similarities + np.float32(0)  # turns -0.0 into 0.0, so that they sort the same


def similarities_of(
    queries: Queries,
    query: Int[np.ndarray, " pair"],
    index: Int[np.ndarray, " pair"],
    read_rows: ReadRows,
) -> Float32[np.ndarray, " pair"]:
    """Compute `exact_similarities` of queries[query] and the database rows at `index`."""
    similarities = np.empty(len(query), np.float32)
    order = np.argsort(index, kind="stable")
    size = max(1, _READ // queries.shape[1])

    def fill(start: int) -> None:
        piece = order[start : start + size]
        numbers = index[piece]
        # Not `np.unique`, which would import masked arrays on the first query.
        is_new = np.append(True, numbers[1:] != numbers[:-1])
        rows = read_rows(numbers[is_new])
        row = np.cumsum(is_new) - 1
        similarities[piece] = exact_similarities(queries, rows, query[piece], row)

    starts = range(0, len(order), size)
    if len(starts) == 1:  # starting a thread would take longer
        fill(0)
    else:
        with ThreadPoolExecutor(usable_cores()) as threads:
            list(threads.map(fill, starts))
    return similarities


def multiply(
    stream: Generator[Block, None, None], queries: Queries, size: int
) -> Generator[Products, None, None]:
    """Multiply all queries with all blocks, of at most `size` rows; results reuse two buffers."""
    # Allocating memory takes longer than writing the products. Two buffers, for `one_ahead`.
    shape = size, min(QUERY_CHUNK, len(queries))
    memory = itertools.cycle([np.empty(shape, np.float32) for _ in range(2)])
    for block in one_ahead(stream):
        indices = block.start + np.arange(len(block.rows))[:, None]
        for first in range(0, len(queries), QUERY_CHUNK):
            some = queries[first : first + QUERY_CHUNK]
            # With the queries as the right factor, the product takes a tenth less time.
            out = next(memory)[: len(block.rows), : len(some)]
            yield Products(first, np.matmul(block.rows, some.T, out=out), indices)


def nearest(
    stream: Stream,
    queries: Queries,
    k: int,
    read_rows: ReadRows,
    size: int,
    products: Callable[[int], Generator[Products, None, None]] | None = None,
) -> Neighbours:
    """Find the k most similar rows for each query, exactly; ties go to the lower indices.

    The candidates of a query are the k + 16 rows with its largest float32 products. Those that may
    be among the k best, given the rounding error, are compared by `exact_similarities`. If further
    rows may be among the k best, as with many copies of an image, the database is read again, and
    all rows whose products are close to the k-th similarity are compared exactly.

    Args:
        stream: yields the blocks of a database of at least k rows.
        queries: unit descriptors.
        k: neighbours per query.
        read_rows: reads rows of the database.
        size: maximum number of rows in a block.
        products: given a number m, yields products of all queries with all blocks, at least the m
            largest of each query and block; None computes all products in NumPy.
    """
    margin = np.float32(2 * rounding(queries.shape[1]))
    width = k + _SPARE
    found, left_out = _largest(
        multiply(stream(), queries, size) if products is None else products(width),
        np.full(len(queries), _LEAST, np.float32),
        width,
    )
    floor = _first(found, k).value[k - 1 :: k] - margin
    query, index, value = (column[found.value >= floor[found.query]] for column in found)
    value = similarities_of(queries, query, index, read_rows)
    best = _first(_Pairs(query, index, value), k)
    indices, similarities = best.index.reshape(-1, k), best.value.reshape(-1, k)
    unsure = np.flatnonzero(similarities[:, -1] <= left_out + margin)
    if unsure.size:
        some = queries[unsure]
        best, _ = _largest(
            multiply(stream(), some, size),
            similarities[unsure, -1] - margin,
            k,
            lambda query, index: similarities_of(some, query, index, read_rows),
            float(margin),
        )
        indices[unsure], similarities[unsure] = (column.reshape(-1, k) for column in best[1:])
    return Neighbours(indices, similarities)


def best_products(products: Generator[Products, None, None], queries: int, k: int) -> Neighbours:
    """Find the k largest of some exact products for each query; ties go to the lower indices.

    Args:
        products: products of all queries with at least k rows, in row order.
        queries: number of queries.
        k: neighbours per query.
    """
    found, _ = _largest(products, np.full(queries, _LEAST, np.float32), k)
    best = _first(found, k)
    return Neighbours(best.index.reshape(-1, k), best.value.reshape(-1, k))


def _largest(
    products: Generator[Products, None, None],
    least: Float32[np.ndarray, " q"],
    count: int,
    score: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    margin: float = 0.0,
) -> tuple[_Pairs, Float32[np.ndarray, " q"]]:
    """Find the pairs with the `count` largest values of each query; see `_first`.

    Args:
        products: products of all queries with all blocks.
        least: products up to these are skipped; raised in place to the `count`-th value - `margin`.
        count: number of pairs per query.
        score: computes the values of pairs; None uses their products.
        margin: how far a product may be below its value.

    Returns:
        The pairs, and the products up to which others were skipped.
    """
    empty = np.empty(0, np.int64)
    waiting = [_Pairs(empty, empty, np.empty(0, np.float32))]
    for first, values, indices in one_ahead(products):
        part = least[first : first + values.shape[1]]
        if len(values) >= count and part.min() == _LEAST:
            # Only some rows, since partitioning takes longer than multiplying.
            some = np.partition(values[: max(count, _PARTITIONED)], -count, axis=0)[-count]
            np.maximum(part, np.nextafter(some, np.float32(_LEAST)), out=part)
        row, query = np.nonzero(values > part)
        index = np.broadcast_to(indices, values.shape)[row, query]
        value = values[row, query] if score is None else score(query + first, index)
        waiting.append(_Pairs(query + first, index, value))
        if sum(len(pairs.query) for pairs in waiting) > 2 * count * len(least):
            waiting = [_raised(waiting, least, count, margin)]
    return _raised(waiting, least, count, margin), least


def _raised(
    waiting: Sequence[_Pairs], least: Float32[np.ndarray, " q"], count: int, margin: float
) -> _Pairs:
    """Return the `_first` of the pairs, and raise `least` to the last of queries with `count`."""
    pairs = _first(_Pairs(*map(np.concatenate, zip(*waiting, strict=True))), count)
    is_full = np.bincount(pairs.query, minlength=len(least)) == count
    last = np.flatnonzero(_rank(pairs.query) == count - 1)
    least[is_full] = np.maximum(least[is_full], pairs.value[last] - np.float32(margin))
    return pairs


def _first(pairs: _Pairs, count: int) -> _Pairs:
    """Sort pairs by query, descending value and index; return at most `count` of each query."""
    order = np.lexsort((pairs.index, -pairs.value, pairs.query))
    order = order[_rank(pairs.query[order]) < count]
    return _Pairs(*(column[order] for column in pairs))


def _rank(query: Int64[np.ndarray, " pair"]) -> Int64[np.ndarray, " pair"]:
    """Count the pairs of the same query that precede each pair; queries are in ascending order."""
    return np.arange(len(query)) - np.searchsorted(query, query)
