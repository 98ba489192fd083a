"""The images of a map, stored as columns: 48 bytes and a name for each."""

import copy
import functools
import itertools
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple, overload

import numpy as np

from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.frames import moment_of
from crisalad_jax.data.positions import AXES, MOST_METRES, Positions
from crisalad_jax.data.tracks import time_of
from crisalad_jax.retrieval.chunks import Descriptors
from crisalad_jax.retrieval.maps.removed import NONE, Removed
from crisalad_jax.utils.shapes import Bool, Float64, Int64

_BLOCK = 4096
"""Number of images that are created at a time when iterating over all."""
_NAMES = "utf-8", "surrogatepass"
"""Encoding of names; file names that are not UTF-8 have surrogates."""
_RECENT = 4096
"""Minimum number of new names that a dictionary holds before they are sorted too."""


@brief
class MapImage(NamedTuple):
    """An image of a map: everything but its descriptor."""

    name: str
    """Its path relative to the folder `root`, with forward slashes; unique in a map."""
    bytes: int
    """Size of the described file in bytes; a file of another size counts as another picture."""
    position: tuple[float, float] | None
    """Where it was taken, in the map's axes (`Map.axes`); None if unknown."""
    root: str


class NewImages(NamedTuple):
    """Images to be appended, all from one folder; see `AppendableMap.append`."""

    names: Sequence[str]
    sizes: Sequence[int]
    descriptors: Descriptors
    root: str
    positions: Positions | None = None
    added: str | None = None
    """ISO 8601 time when they were described; None is now."""
    source: object = None
    """What messages call them; None is their root."""

    def only(self, chosen: Sequence[bool]) -> "NewImages":
        """Return only the images for which `chosen` is True, in order."""
        names, sizes = (list(itertools.compress(x, chosen)) for x in (self.names, self.sizes))
        rows = self.descriptors[np.array(chosen)]
        return self._replace(names=names, sizes=sizes, descriptors=rows)


class Part(NamedTuple):
    """Properties that images appended together share."""

    added: str | None
    """When the images were added, as text; None if their record has no time."""
    root: str
    first: int
    """Row of the first of these images."""
    seconds: float
    """`added` in seconds since 1970; NaN without a time."""


class _Column:
    """An array that grows at its end."""

    def __init__(self, dtype: type, *width: int) -> None:
        self._room, self._size = np.empty((0, *width), dtype), 0

    @property
    def values(self) -> np.ndarray:
        """The rows so far, as a view."""
        return self._room[: self._size]

    def extend(self, rows: Any) -> None:
        """Append rows; concurrent readers see only complete ones."""
        size = self._size + len(rows)
        if size > len(self._room):
            room = np.empty((size + size // 8, *self._room.shape[1:]), self._room.dtype)
            room[: self._size] = self.values
            self._room = room
        self._room[self._size : size] = rows
        self._size = size


class Images(Sequence[MapImage]):
    """The images of a map by number; removed images have a row, but no number.

    A change to the map creates a new sequence; the one that existing answers hold stays as it is.
    """

    def __init__(self) -> None:
        """Start without images."""
        self.removed = NONE
        """The removed images, by their rows in the store, which no change alters."""
        self.parts: list[Part] = []
        """The parts, each of images that were appended together, in order."""
        self._firsts, self._ends, self._hashes, self._sizes = (_Column(np.int64) for _ in range(4))
        self._names, self._taken = _Column(np.uint8), _Column(np.float64)
        self._positions = _Column(np.float64, 2)
        self.has_moved = False
        """Whether an image's position differs from the one in its record."""
        self._ends.extend([0])
        self._order = np.empty(0, np.int64)
        """The first rows, sorted by the hashes of their names."""
        self._recent: dict[str, int] = {}
        """The other rows by name; the last one for a name that was removed and added again."""

    @property
    def rows(self) -> int:
        """Number of rows, including those of removed images."""
        return len(self._positions.values)

    def __len__(self) -> int:
        """Return the number of images."""
        return self.rows - len(self.removed.rows)

    @overload
    def __getitem__(self, index: int) -> MapImage: ...
    @overload
    def __getitem__(self, index: slice) -> list[MapImage]: ...
    def __getitem__(self, index: int | slice) -> MapImage | list[MapImage]:
        """Return an image, or some, by number."""
        if isinstance(index, slice):
            return self.in_rows(self.removed.rows_of(np.arange(len(self))[index]))
        (image,) = self.in_rows(self.removed.rows_of(np.array([range(len(self))[index]])))
        return image

    def __iter__(self) -> Iterator[MapImage]:
        """Yield the images in order."""
        for start in range(0, len(self), _BLOCK):
            yield from self[start : start + _BLOCK]

    def __repr__(self) -> str:
        """Return one line."""
        return f"Images({len(self)})"

    def in_rows(self, rows: Int64[np.ndarray, " n"]) -> list[MapImage]:
        """Return the images in some rows, including removed ones."""
        places = np.searchsorted(self._firsts.values, rows, side="right") - 1
        at = self._positions.values[rows].tolist()
        spots = [None if first != first else (first, second) for first, second in at]  # NaN
        roots = [self.parts[place].root for place in places.tolist()]
        sizes = self._sizes.values[rows].tolist()
        return list(map(MapImage, self._named(rows), sizes, spots, roots))

    def _named(self, rows: Int64[np.ndarray, " n"]) -> list[str]:
        data, ends = self._names.values.data, self._ends.values
        spans = zip(ends[rows].tolist(), ends[rows + 1].tolist(), strict=True)
        return [str(data[start:end], *_NAMES) for start, end in spans]

    @property
    def starts(self) -> list[int]:
        """Index of the first image of each part and, at the end, the count of all images."""
        return self.removed.numbers_of(np.append(self._firsts.values, self.rows)).tolist()

    def part_of(self, number: int) -> Part:
        """Return the part that the image with this number belongs to."""
        row = self.removed.rows_of(np.array(number))
        return self.parts[int(np.searchsorted(self._firsts.values, row, side="right")) - 1]

    def find(self, name: str) -> int | None:
        """Return the number of the image with this name; None if there is none."""
        row = self._recent.get(name)
        if row is None:
            order, key = self._order, hash(name)
            hashes = self._hashes.values[: len(order)]
            place = int(hashes.searchsorted(key, "right", order))
            while row is None and place and hashes[order[place - 1]] == key:
                place -= 1
                row = order[place] if self._named(order[[place]]) == [name] else None
        if row is None or self.removed.has(row):
            return None
        return int(self.removed.numbers_of(np.array(row)))

    @functools.cached_property
    def removed_names(self) -> dict[str, set[int]]:
        """Names of removed or replaced images, each with the sizes of its files in bytes."""
        sizes: dict[str, set[int]] = {}
        for image in self.in_rows(self.removed.rows):
            sizes.setdefault(image.name, set()).add(image.bytes)
        return sizes

    def extend(
        self,
        root: str,
        added: str | None,
        names: Sequence[str],
        sizes: Sequence[int],
        positions: Sequence[Sequence[float] | None],
        axes: tuple[str, str] | None,
    ) -> None:
        """Append images with unique names; `names`, `sizes` and `positions` have an item for each.

        Raises:
            ValueError, TypeError, OverflowError: a value is of another type or out of range, or a
                column is too short or too long.
        """
        if not isinstance(root, str) or not isinstance(added, str | None):
            raise TypeError(f"found root {root!r} and added {added!r}, expected text and a time")
        text = "".join(names)
        data = text.encode(*_NAMES)
        lengths = map(len, names if len(data) == len(text) else (n.encode(*_NAMES) for n in names))
        if wrong := [
            name
            for name in names
            if name.startswith("/") or (".." in name and ".." in name.split("/"))
        ]:
            raise ValueError(f"found name {wrong[0]!r}, expected one below the folder of images")
        first = self.rows
        columns = (
            (self._hashes, list(map(hash, names))),
            (self._sizes, np.array(sizes, np.int64)),
            (self._positions, checked_positions(positions, axes)),
        )
        if any(len(column) != len(names) for _, column in columns):
            raise ValueError(f"found columns of other lengths, expected {len(names)}")
        ends = np.cumsum(np.fromiter(lengths, np.int64)) + self._ends.values[-1]
        seconds = np.nan if added is None else time_of(added)
        self.parts.append(Part(added and sys.intern(added), sys.intern(root), first, seconds))
        self._firsts.extend([first])
        self._names.extend(np.frombuffer(data, np.uint8))
        self._ends.extend(ends)
        for column, new in columns:
            column.extend(new)
        self._recent.update(zip(names, range(first, self.rows), strict=True))
        if len(self._recent) > _RECENT + len(self._order) // 2:
            self._sort()

    def _sort(self) -> None:
        self._order = np.argsort(self._hashes.values, kind="stable")
        self._recent = {}

    def twice(self) -> int | None:
        """Return the row of an image whose name is in another row too; None if there is none."""
        self._sort()
        left = self._order[~self._mask(self.removed.rows)[self._order]]
        hashes = self._hashes.values[left]
        for place in np.flatnonzero(hashes[1:] == hashes[:-1]):
            first, second = self._named(left[place : place + 2])
            if first == second:
                return int(left[place + 1])
        return None

    def _mask(self, rows: Any) -> Bool[np.ndarray, " row"]:
        mask = np.zeros(self.rows, bool)
        mask[rows] = True
        return mask

    def changed(
        self,
        removed: Sequence[int],
        moved: Sequence[int],
        positions: Sequence[Sequence[float]],
        axes: tuple[str, str] | None,
    ) -> "Images":
        """Return a copy without rows `removed`, and with rows `moved` at the new `positions`.

        Raises:
            ValueError, TypeError, OverflowError: a row does not exist, or a position is invalid.
        """
        rows = [*removed, *moved]
        if not all(isinstance(row, int) and 0 <= row < self.rows for row in rows):
            raise ValueError(f"found rows that are not integers from 0 to below {self.rows}")
        if len(moved) != len(positions) or None in positions:
            raise ValueError(f"found {len(positions)} positions, expected {len(moved)}")
        new = copy.copy(self)
        new.__dict__.pop("removed_names", None)
        gone = self._mask(self.removed.rows)
        gone[np.array(removed, np.int64)] = True
        new.removed = Removed(np.flatnonzero(gone))
        if moved:
            new.has_moved = True
            new._positions = copy.deepcopy(self._positions)
            new._positions.values[moved] = checked_positions(positions, axes)
        return new

    def left_out(self, mask: Bool[np.ndarray, " row"]) -> Removed:
        """Return the rows that were removed, or where a mask is False."""
        return Removed(np.flatnonzero(~mask | self._mask(self.removed.rows)))

    def begin_with(self, prefixes: Iterable[str]) -> Bool[np.ndarray, " row"]:
        """Return for each row whether its name begins with one of the prefixes."""
        data, ends = self._names.values, self._ends.values
        found = np.zeros(self.rows, bool)
        for text in (prefix.encode(*_NAMES) for prefix in prefixes):
            rows = np.flatnonzero(np.diff(ends) >= len(text))
            for place in reversed(range(len(text))):  # paths differ most at the end of a folder
                rows = rows[data[ends[rows] + place] == text[place]]
            found[rows] = True
        return found

    @property
    def positions(self) -> Float64[np.ndarray, "row 2"]:
        """Position of the image in each row, NaN if it has none."""
        return self._positions.values

    @property
    def added(self) -> Float64[np.ndarray, " row"]:
        """When the image in each row was added, in seconds since 1970; NaN if not recorded."""
        times = [part.seconds for part in self.parts]
        return np.repeat(times, np.diff(np.append(self._firsts.values, self.rows)))

    @property
    def taken(self) -> Float64[np.ndarray, " row"]:
        """When the image in each row was taken, in seconds since 1970; NaN if not in its name."""
        known = len(self._taken.values)
        moments = map(moment_of, self._named(np.arange(known, self.rows)))
        self._taken.extend([np.nan if at is None or at.clock else at.seconds for at in moments])
        return self._taken.values


def checked_positions(
    positions: Sequence[Sequence[float] | None], axes: tuple[str, str] | None
) -> Float64[np.ndarray, "n 2"]:
    """Check positions, and return them as rows of a table, NaN where there is none.

    Raises:
        ValueError, TypeError, OverflowError: axes are unknown, or a position is not a valid pair.
    """
    if axes is not None and axes not in AXES:
        raise ValueError(f"found axes {axes}, expected one of {AXES}")
    known = [at is not None for at in positions]
    table = np.array([at or (np.nan, np.nan) for at in positions], np.float64).reshape(-1, 2)
    if not (np.abs(table[known]) <= MOST_METRES).all():
        raise ValueError(f"found a position that is not two numbers of at most {MOST_METRES:g}")
    return table
