"""Descriptors in .npy files, one for each addition, searched exactly."""

import functools
import math
import os
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
"""Largest number of elements in a block of descriptors, and in its products with some queries."""
_MAPPED = 8192
"""Maximum files that stay mapped; Linux allows a process 65,530 mappings. Each takes a file
descriptor, of which these take at most a sixteenth."""


class FileStore:
    """A `Store` in a folder of files, each named by the number of its first descriptor.

    Files are memory-mapped one after the other. A search holds a few blocks of rows in memory,
    whatever the size of the map. A small map, of one block, stays in memory.
    """

    def __init__(self, folder: pathlib.Path, length: int, dtype: str) -> None:
        """Open a folder of descriptors of this length; the first `add` creates the folder."""
        self._folder, self._length, self._dtype = folder, length, np.dtype(dtype)
        self._opened_at: os.stat_result | None = None
        """Identity of the folder whose files were opened first; a rebuilt map has another."""
        self._counts: dict[int, int] = {}
        """Number of descriptors in each file, by the number of its first, in ascending order."""
        self._held: tuple[int, Removed, Block] | None = None
        """Arguments and block of the last search that read a single block."""
        self._mapped = functools.lru_cache(min(_MAPPED, most_files() // 16))(self._open)

    def _path(self, first: int) -> pathlib.Path:
        return self._folder / f"{first:010d}.npy"

    def add(self, first: int, descriptors: Descriptors, record: Mapping[str, Any]) -> None:
        """Write descriptors numbered from `first` on; they are durable once this returns.

        Args:
            first: number of the first descriptor.
            descriptors: the descriptors, in order.
            record: the record of their images, which only Milvus stores, for search conditions.
        """
        del record  # the map stores it
        path = self._path(first)
        with atomic_path(path, durable=True) as temporary:
            write_npy(temporary, descriptors.astype(self._dtype))
        self._counts[first], self._held = len(descriptors), None

    def check(self, segments: Sequence[tuple[int, int]]) -> None:
        """Check that all additions, each as (first number, count), exist, without reading them."""
        for first, count in segments:
            self._counts[first] = count
            self._open(first)

    def read(self, first: int, count: int) -> Float[np.ndarray, "count d"]:
        """Read the `count` descriptors that were added together, numbered from `first` on."""
        return np.array(self._open(first))

    def _open(self, first: int) -> Descriptors:
        path = self._path(first)
        shape = (self._counts[first], self._length)
        check_source(path, "a file of a map's descriptors")
        header = npy_header(self._dtype, shape)
        size = len(header) + math.prod(shape) * self._dtype.itemsize
        with path.open("rb") as file:
            at = os.stat(self._folder)  # only now: a folder may be replaced before `open`
            self._opened_at = self._opened_at or at
            if not os.path.samestat(at, self._opened_at):
                raise InputError(f"{self._folder}: the map was replaced since it was opened")
            if file.read(len(header)) != header or os.fstat(file.fileno()).st_size != size:
                raise InputError(
                    f"{path}: found bytes other than {self._dtype} {shape}, expected the whole "
                    ".npy file that was written"
                )
            # As a plain array, to avoid what a `memmap` does at each indexing.
            return np.memmap(file, self._dtype, "r", len(header), shape).view(np.ndarray)

    def drop(self, first: int) -> None:
        """Delete descriptors from number `first` on, whose addition was never committed."""
        for path in self._folder.glob("[0-9]*.npy"):
            if int(path.stem) >= first:
                path.unlink()
                self._counts.pop(int(path.stem), None)
        self._mapped.cache_clear()

    def search(
        self, queries: Queries | Bits, k: int, count: int, removed: Removed = NONE
    ) -> Neighbours:
        """Find the k nearest of the first `count` descriptors, exactly.

        They are compared by inner product or, for packed bits, by the number of equal bits. Among
        equal similarities the lower number comes first, also at the k-th place.

        Args:
            queries: unit vectors or packed bits.
            k: neighbours per query, from 1 to the number of descriptors that are left.
            count: number of descriptors, including removed ones.
            removed: descriptors to leave out; the result numbers the rest from 0, in order.
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
                # A block of small files would hold a file descriptor open for each of its parts.
                rows = np.array(rows) if len(rows) < size // 8 else rows
                yield from blocks(rows, str(self._path(first)), size, places=places)

        if (left := count - len(removed.rows)) <= size:  # one block, cached for the next search
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
        """Yield the files that have rows left, with the places of these rows; None is all."""
        for first, rows in list(self._counts.items()):
            places = removed.left(first, rows)
            if first < count and (places is None or len(places)):
                yield first, places

    def rows(self, numbers: Int64[np.ndarray, " n"], *, release: bool = False) -> Descriptors:
        """Read the descriptors with these numbers; their files stay mapped into memory.

        Args:
            numbers: numbers of descriptors, in any order.
            release: whether to release the pages that are read; numbers must then be ascending.

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
        """Release the mapped files."""
        self._mapped.cache_clear()
