"""The similarities of all queries to all database images, reduced to the size of a picture."""

import numpy as np
from jaxtyping import Float, Float32, Int64

from crisalad_jax.retrieval.chunks import Block, as_sides, blocks

# Queries and database rows compared at a time: their similarities are 32 MiB.
_QUERY_CHUNK, _DATABASE_CHUNK = 1024, 8192


def similarity_map(
    database: Float[np.ndarray, "n d"], queries: Float[np.ndarray, "q d"], *, most: int = 400
) -> Float32[np.ndarray, "rows columns"]:
    """Compute a picture of all similarities between queries (rows) and database (columns).

    If there are more than `most` queries or database images, several share a row or column
    (`cells_of`); a cell holds their largest similarity. Memory does not grow with their number.

    Raises:
        InputError: an array is empty, a row is not a unit vector, or the lengths of rows differ.
    """
    database, queries = as_sides(database, queries)
    rows, columns = cells_of(len(queries), most), cells_of(len(database), most)
    picture = np.full((rows[-1] + 1, columns[-1] + 1), -np.inf, np.float32)
    for block in blocks(database, "database", _DATABASE_CHUNK):
        for part in blocks(queries, "queries", _QUERY_CHUNK):
            products = part.rows @ block.rows.T
            row, tops = _cells(rows, part)
            column, lefts = _cells(columns, block)
            products = np.maximum.reduceat(products, tops, axis=0)
            products = np.maximum.reduceat(products, lefts, axis=1)
            cells = np.ix_(row, column)
            picture[cells] = np.maximum(picture[cells], products)
    return picture


def cells_of(count: int, most: int) -> Int64[np.ndarray, " count"]:
    """Return the cell of each of `count` images, spread evenly over at most `most` cells."""
    return np.arange(count) * min(count, most) // count


def _cells(
    cells: Int64[np.ndarray, " count"], block: Block
) -> tuple[Int64[np.ndarray, " cell"], Int64[np.ndarray, " cell"]]:
    """Find the cells that a block's images fall into, and the first image of each."""
    return np.unique(cells[block.start : block.start + len(block.rows)], return_index=True)


class FirstSimilarities:
    """An observer for `evaluate` that stores a picture of the first grouping's similarities."""

    map: Float32[np.ndarray, "rows columns"] | None = None
    """The result of `similarity_map`; None before the first grouping is described."""

    def __call__(
        self,
        grouping: str,
        database: Float[np.ndarray, "image descriptor"],
        queries: Float[np.ndarray, "image descriptor"],
    ) -> None:
        """Compute the map of the first grouping's descriptors; ignore later groupings."""
        if self.map is None:
            self.map = similarity_map(database, queries)
