"""Descriptors in .npy files, one for each addition, searched exactly."""

import functools
import math
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from crisalad_jax.retrieval.bits import Bits, nearest_bits
from crisalad_jax.retrieval.chunks import (
    BITS,
    Block,
    Descriptors,
    Queries,
    blocks,
    gathered,
    joined,
)
from crisalad_jax.retrieval.maps.removed import NONE, Removed
from crisalad_jax.retrieval.neighbours import QUERY_CHUNK, Neighbours, nearest
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, check_source, npy_header, write_npy
from crisalad_jax.utils.host import most_files
from crisalad_jax.utils.shapes import Float, Int64

_BLOCK = 2**23
"""Largest size of a block of descriptors, and of its products with some queries, in numbers."""
_MAPPED = 8192
"""Number of files that stay mapped, at most; Linux allows a process 65,530 mappings. Each takes a
descriptor, of which these take a sixteenth at most."""


class FileStore:
    """A `Store` in a folder of files, each named by the number of its first descriptor.

    Files are memory-mapped one after the other. A search has a few blocks of rows in memory,
    whatever the size of the map. All rows of a small map, one block, stay in memory.
    """

    def __init__(self, folder: pathlib.Path, length: int, dtype: str) -> None:
        """Open a folder of descriptors of `length` numbers; the first `add` makes the folder."""
        self._folder, self._length, self._dtype = folder, length, np.dtype(dtype)
        self._counts: dict[int, int] = {}
        """Number of descriptors in each file, by the number of its first, in ascending order."""
        self._held: tuple[int, Removed, Block] | None = None
        """Of the last search that was of one block: the arguments that it was of, and the block."""
        self._mapped = functools.lru_cache(min(_MAPPED, most_files() // 16))(self._open)

    def _path(self, first: int) -> pathlib.Path:
        return self._folder / f"{first:010d}.npy"

    def add(self, first: int, descriptors: Descriptors, record: Mapping[str, Any]) -> None:
        """Write descriptors as numbers `first` and on; they are durable once this returns.

        Args:
            first: number of the first.
            descriptors: in order.
            record: of their images, which conditions of a search are about.
        """
        del record  # the map's own has it
        path = self._path(first)
        with atomic_path(path, durable=True) as temporary:
            write_npy(temporary, descriptors.astype(self._dtype))
        self._counts[first], self._held = len(descriptors), None

    def check(self, segments: Sequence[tuple[int, int]]) -> None:
        """Check, without reading them, that all additions, as (first, count), are there."""
        for first, count in segments:
            self._counts[first] = count
            self._open(first)

    def read(self, first: int, count: int) -> Float[np.ndarray, "count d"]:
        """Read the descriptors that were added together as numbers `first` and on."""
        return np.array(self._open(first))

    def _open(self, first: int) -> Descriptors:
        path = self._path(first)
        shape = (self._counts[first], self._length)
        check_source(path, "a file of a map's descriptors")
        header = npy_header(self._dtype, shape)
        size = len(header) + math.prod(shape) * self._dtype.itemsize
        with path.open("rb") as file:
            begins = file.read(len(header))
        if begins != header or path.stat().st_size != size:
            raise InputError(
                f"{path}: found other bytes than of {self._dtype} {shape}, expected the whole .npy "
                "file that was written"
            )
        # Without what a `memmap` does at each indexing.
        return np.memmap(path, self._dtype, "r", len(header), shape).view(np.ndarray)

    def drop(self, first: int) -> None:
        """Forget what was added from number `first` on, which did not count."""
        for path in self._folder.glob("[0-9]*.npy"):
            if int(path.stem) >= first:
                path.unlink()
                self._counts.pop(int(path.stem), None)
        self._mapped.cache_clear()

    def search(
        self, queries: Queries | Bits, k: int, count: int, removed: Removed = NONE
    ) -> Neighbours:
        """Find the k nearest of numbers below `count`, exactly.

        They are compared by inner product, packed bits by those that are equal. Of equal
        similarities the lower number comes first, also at the k-th place.

        Args:
            queries: as they are compared.
            k: neighbours of each, from 1 to as many as are left.
            count: number of descriptors, those that were removed included.
            removed: which are left out. The others are numbered in its way in the result.
        """
        if self._dtype == BITS:
            parts = (
                self._open(first) if places is None else self._open(first)[places]
                for first, places in self._left(count, removed)
            )
            return nearest_bits(parts, queries, k)
        size = max(1, _BLOCK // max(self._length, min(len(queries), QUERY_CHUNK)))

        def files() -> Iterator[Block]:
            for first, places in self._left(count, removed):
                rows = self._open(first)
                # A block of small files would keep a descriptor open for each of its parts.
                rows = np.array(rows) if len(rows) < size // 8 else rows
                yield from blocks(rows, str(self._path(first)), size, places=places)

        if (left := count - len(removed.rows)) <= size:  # a block, which stays for the next search
            if self._held is None or self._held[0] != count or self._held[1] is not removed:
                (block,) = joined(files(), left)
                self._held = count, removed, block
            block = self._held[2]
            return nearest(lambda: joined([block], left), queries, k, block.rows.__getitem__, size)

        def read_rows(numbers: Int64[np.ndarray, " n"]) -> Descriptors:
            return self.rows(removed.rows_of(numbers), release=True)

        return nearest(lambda: joined(files(), size), queries, k, read_rows, 2 * size)

    def _left(
        self, count: int, removed: Removed
    ) -> Iterator[tuple[int, Int64[np.ndarray, " left"] | None]]:
        """Yield the files of which rows are left, with the places of these; None is all."""
        for first, rows in list(self._counts.items()):
            places = removed.left(first, rows)
            if first < count and (places is None or len(places)):
                yield first, places

    def rows(self, numbers: Int64[np.ndarray, " n"], *, release: bool = False) -> Descriptors:
        """Read the descriptors of these numbers; their files stay mapped into memory.

        Args:
            numbers: of descriptors, in any order.
            release: whether to release the pages that are read; numbers are then in order.

        Raises:
            InputError: a file is damaged or gone.
        """
        firsts = np.array(list(self._counts))
        rows = np.empty((len(numbers), self._length), self._dtype)
        files = firsts[np.searchsorted(firsts, numbers, side="right") - 1]
        for first in sorted(set(files.tolist())):  # `np.unique` would import masked arrays
            places = np.flatnonzero(files == first)
            mapped, here = self._mapped(first), numbers[places] - first
            rows[places] = gathered(mapped, here) if release else mapped[here]
        return rows

    def close(self) -> None:
        """Let go of files."""
        self._mapped.cache_clear()
