"""Descriptors in .npy files, one for each addition, searched exactly by FAISS."""

import math
import pathlib
from collections.abc import Sequence

import numpy as np

from crisalad_jax.retrieval.chunks import check_rows
from crisalad_jax.retrieval.maps.ties import lower_first
from crisalad_jax.retrieval.neighbours import Neighbours, exact_similarities, rounding
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, check_source, npy_header, write_npy
from crisalad_jax.utils.shapes import Float, Float32, Int64

_SPARE = 16
"""Number of candidates beyond k, for products that float32 cannot tell apart."""

_MAPPED = 8192
"""Number of files that stay mapped, at most; Linux allows a process 65,530 mappings."""
_READ_BYTES = 2**26
"""Size of the rows that are ranked at a time."""


class FileStore:
    """A `Store` in a folder of files, each named by the number of its first descriptor.

    Files are memory-mapped one after the other, and closed again. A search has one file open and in
    memory, whatever the size of the map.
    """

    def __init__(self, folder: pathlib.Path, length: int, dtype: str) -> None:
        """Open a folder of descriptors of `length` numbers; the first `add` makes the folder."""
        self._folder, self._length, self._dtype = folder, length, np.dtype(dtype)
        self._counts: dict[int, int] = {}
        """Number of descriptors in each file, by the number of its first, in ascending order."""
        self._mapped: dict[int, np.ndarray] = {}
        """Files that rows were read of one by one."""

    def _path(self, first: int) -> pathlib.Path:
        return self._folder / f"{first:010d}.npy"

    def add(self, first: int, descriptors: Float[np.ndarray, "n d"]) -> None:
        """Write descriptors to a file; see `Store.add`."""
        path = self._path(first)
        with atomic_path(path, durable=True) as temporary:
            write_npy(temporary, descriptors.astype(self._dtype))
        self._counts[first] = len(descriptors)

    def check(self, segments: Sequence[tuple[int, int]]) -> None:
        """Open the file of each addition; see `Store.check`."""
        for first, count in segments:
            self._counts[first] = count
            self._open(first)

    def read(self, first: int, count: int) -> Float[np.ndarray, "count d"]:
        """Read the file of one addition; see `Store.read`."""
        return np.array(self._open(first))

    def _open(self, first: int) -> Float[np.ndarray, "n d"]:
        path = self._path(first)
        shape = (self._counts[first], self._length)
        check_source(path, "a file of a map's descriptors")
        header = npy_header(self._dtype, shape)
        size = len(header) + math.prod(shape) * self._dtype.itemsize
        try:
            with path.open("rb") as file:
                begins = file.read(len(header))
            if begins != header or path.stat().st_size != size:
                raise InputError(
                    f"{path}: found other bytes than of {self._dtype} {shape}, expected the whole "
                    ".npy file that was written"
                )
            return np.memmap(path, self._dtype, "r", len(header), shape)
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error

    def search(self, queries: Float32[np.ndarray, "q d"], k: int, count: int) -> Neighbours:
        """Find the k most similar descriptors of each query; see `Store.search`.

        FAISS selects candidates by float32 products, whose rounding differs with the segment and
        the number of queries. Their similarities are then summed in float64 and rounded once.
        """
        firsts = [first for first in self._counts if first < count]

        def ask(queries: Float32[np.ndarray, "q d"], k: int) -> Neighbours:
            return self._exact(queries, self._candidates(queries, k, firsts), firsts)

        # Twice: a row left out and the row taken in its place may each be off by `rounding`.
        return lower_first(
            ask,
            np.ascontiguousarray(queries, np.float32),
            k,
            count,
            spare=_SPARE,
            margin=2 * rounding(self._length),
        )

    def _candidates(
        self, queries: Float32[np.ndarray, "q d"], k: int, firsts: Sequence[int]
    ) -> Int64[np.ndarray, "q k"]:
        """Number the k largest products in float32 of each query, in these files."""
        numbers = np.empty((len(queries), 0), np.int64)
        products = np.empty((len(queries), 0), np.float32)
        for first in firsts:
            block = np.ascontiguousarray(self._open(first), np.float32)
            check_rows(block, str(self._path(first)), range(len(block)), unit=True)
            values, places = _largest_products(queries, block, min(k, len(block)))
            products = np.concatenate([products, values], axis=1)
            numbers = np.concatenate([numbers, places + first], axis=1)
            order = np.argsort(-products, axis=1, kind="stable")[:, :k]
            products = np.take_along_axis(products, order, axis=1)
            numbers = np.take_along_axis(numbers, order, axis=1)
        return numbers

    def _exact(
        self,
        queries: Float32[np.ndarray, "q d"],
        numbers: Int64[np.ndarray, "q k"],
        firsts: Sequence[int],
    ) -> Neighbours:
        """Compute exact similarities of candidates; no other rows are read."""
        similarities = np.empty(numbers.shape, np.float32)
        segments = np.searchsorted(firsts, numbers, side="right") - 1
        for segment in _distinct(segments):
            first = firsts[segment]
            query, column = np.nonzero(segments == segment)
            similarities[query, column] = exact_similarities(
                queries, self._open(first), query, numbers[query, column] - first
            )
        return Neighbours(numbers, similarities)

    def similarities(
        self, queries: Float32[np.ndarray, "q d"], numbers: Int64[np.ndarray, "q k"]
    ) -> Float32[np.ndarray, "q k"]:
        """Compute the exact similarities of queries to descriptors of these numbers.

        Raises:
            InputError: a file is damaged or gone.
        """
        queries = np.ascontiguousarray(queries, np.float32)
        similarities = np.empty(numbers.shape, np.float32)
        size = max(1, _READ_BYTES // (4 * self._length * numbers.shape[1]))
        for start in range(0, len(queries), size):
            some = numbers[start : start + size]
            chosen, places = np.unique(some, return_inverse=True)
            query = np.repeat(np.arange(len(some)), some.shape[1])
            similarities[start : start + size] = exact_similarities(
                queries[start : start + size], self.rows(chosen), query, places.ravel()
            ).reshape(some.shape)
        return similarities

    def rows(self, numbers: Int64[np.ndarray, " n"]) -> Float32[np.ndarray, "n d"]:
        """Read the descriptors of these numbers; their files stay mapped into memory.

        Raises:
            InputError: a file is damaged or gone.
        """
        firsts = np.array(list(self._counts))
        rows = np.empty((len(numbers), self._length), np.float32)
        segments = np.searchsorted(firsts, numbers, side="right") - 1
        for segment in _distinct(segments):
            places, first = np.flatnonzero(segments == segment), int(firsts[segment])
            if first not in self._mapped:
                if len(self._mapped) >= _MAPPED:
                    self._mapped.clear()
                self._mapped[first] = self._open(first).view(np.ndarray)
            rows[places] = self._mapped[first][numbers[places] - first]
        return rows

    def close(self) -> None:
        """Let go of files."""
        self._mapped.clear()


_FEW = 2**20
"""Products that numpy ranks as fast as FAISS, which takes a tenth of a second to import."""


def _largest_products(
    queries: Float32[np.ndarray, "q d"], block: Float32[np.ndarray, "n d"], k: int
) -> tuple[Float32[np.ndarray, "q k"], Int64[np.ndarray, "q k"]]:
    """Return the k largest products of each query with a block's rows, and the rows' numbers."""
    if len(queries) * len(block) > _FEW:
        import faiss

        return faiss.knn(queries, block, k, metric=faiss.METRIC_INNER_PRODUCT)
    products = queries @ block.T
    places = np.argpartition(-products, k - 1, axis=1)[:, :k]
    return np.take_along_axis(products, places, axis=1), places


def _distinct(numbers: Int64[np.ndarray, "*shape"]) -> list[int]:
    """List each number once, in order; `np.unique` would import masked arrays into every query."""
    return sorted(set(numbers.ravel().tolist()))
