"""The rows of a store that were removed from its map, and how the remaining rows are numbered."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crisalad_jax.utils.shapes import Int64

if TYPE_CHECKING:
    from crisalad_jax.retrieval.maps.where import Where


class Removed(NamedTuple):
    """The removed rows of a store; the remaining rows are numbered from 0, in order."""

    rows: Int64[np.ndarray, " removed"] = np.empty(0, np.int64)
    """Indices of the removed rows in the store, in ascending order."""
    asked: "tuple[Where, Int64[np.ndarray, ' removed']] | None" = None
    """The same choice of rows as a filter for Milvus: conditions that the remaining images met when
    they were added, and rows to exclude as well. None if no such filter exists."""

    def has(self, row: int) -> bool:
        """Return whether a row was removed."""
        place = int(np.searchsorted(self.rows, row))
        return place < len(self.rows) and self.rows[place] == row

    def numbers_of(self, rows: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
        """Convert remaining rows of the store to their numbers, which skip removed rows."""
        return rows - np.searchsorted(self.rows, rows)

    def rows_of(self, numbers: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
        """Convert the numbers of remaining rows back to rows of the store."""
        left_before = self.rows - np.arange(len(self.rows))
        return numbers + np.searchsorted(left_before, numbers, side="right")

    def left(self, first: int, count: int) -> Int64[np.ndarray, " left"] | None:
        """Return which of the `count` rows from `first` on remain, as offsets; None if all do."""
        start, end = np.searchsorted(self.rows, [first, first + count])
        gone = self.rows[start:end] - first
        return np.delete(np.arange(count), gone) if gone.size else None


NONE = Removed()
