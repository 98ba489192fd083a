"""Rows of a store that were removed from its map, and the numbers of those that are left."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crisalad_jax.utils.shapes import Int64

if TYPE_CHECKING:
    from crisalad_jax.retrieval.maps.where import Where


class Removed(NamedTuple):
    """Rows that do not count; the others are numbered from 0 in order."""

    rows: Int64[np.ndarray, " removed"] = np.empty(0, np.int64)
    """In ascending order."""
    asked: "tuple[Where, Int64[np.ndarray, ' removed']] | None" = None
    """The same selection for Milvus: conditions on images as they were added, and the rows that
    were also removed. None if it has no such form."""

    def has(self, row: int) -> bool:
        """Return whether a row was removed."""
        place = int(np.searchsorted(self.rows, row))
        return place < len(self.rows) and self.rows[place] == row

    def numbers_of(self, rows: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
        """Return the number of each row that is left."""
        return rows - np.searchsorted(self.rows, rows)

    def rows_of(self, numbers: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
        """Return the row of each number."""
        left_before = self.rows - np.arange(len(self.rows))
        return numbers + np.searchsorted(left_before, numbers, side="right")

    def left(self, first: int, count: int) -> Int64[np.ndarray, " left"] | None:
        """Return which of `count` rows from `first` on remain, by place; None if all do."""
        start, end = np.searchsorted(self.rows, [first, first + count])
        gone = self.rows[start:end] - first
        return np.delete(np.arange(count), gone) if gone.size else None


NONE = Removed()
