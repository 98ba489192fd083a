"""Descriptors in any number, in memory or on disk, some rows at a time."""

import math
import mmap
from collections.abc import Generator, Iterator, Sequence
from typing import Any, NamedTuple

import ml_dtypes
import numpy as np
from jaxtyping import Float, Float32, Int

from crisalad_jax.errors import InputError

# Descriptors may arrive as float16, whose unit vectors are off by up to 1e-3.
UNIT_TOLERANCE = 1e-2
WIDE = np.dtype(np.float32)
KEPT = (WIDE, np.dtype(np.float16), np.dtype(ml_dtypes.bfloat16))
"""Types that are kept as they are; float32 holds all their values."""
_CHECKED = 64
"""Rows whose lengths are found at a time."""
_ALIGNMENT = 64
"""Bytes on whose multiples XLA's arrays begin."""
_NEIGHBOURS = 2**21
"""Bytes: the system maps pages around the one that is read, on Linux up to so many."""
_SCATTERED = 4
"""Rows far from each other that are read before their pages are let go."""


def as_rows(array: np.ndarray, name: str) -> Float[np.ndarray, "n d"]:
    """The array as a matrix of descriptors.

    What a .npy file holds as two bytes without a type ("V2") is bfloat16, for which numpy has no
    name. Types that are not of `KEPT` become float32 as they are read.

    Raises:
        InputError: no matrix, or an empty one.
    """
    array = np.asanyarray(array)
    if array.dtype == np.dtype("V2"):
        array = array.view(ml_dtypes.bfloat16)
    if array.ndim != 2 or 0 in array.shape:
        raise InputError(
            f"{name}: found shape {array.shape}, expected (images, descriptor), neither zero"
        )
    return array


def as_sides(
    database: np.ndarray, queries: np.ndarray
) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "q d"]]:
    """Database and queries as matrices of descriptors (see `as_rows`) of one length.

    Raises:
        InputError: one is no matrix, or empty; or their lengths differ.
    """
    database, queries = as_rows(database, "database"), as_rows(queries, "queries")
    if database.shape[1] != queries.shape[1]:
        raise InputError(
            f"queries: found descriptors of length {queries.shape[1]}, "
            f"expected {database.shape[1]} as in the database"
        )
    return database, queries


class Block(NamedTuple):
    """Some rows that follow each other."""

    start: int
    """The first one's place among all."""
    rows: Float[np.ndarray, "size d"]
    """Zeros behind those that are valid."""
    valid: int


def blocks(
    array: Float[np.ndarray, "n d"],
    name: str,
    buffers: Iterator[Float[np.ndarray, "size d"]],
) -> Generator[Block, None, None]:
    """The array's rows in the buffers, one after the other.

    Raises:
        InputError: a row is not finite, or not of unit length.
    """
    start = 0
    while start < len(array):
        buffer = next(buffers)
        rows = array[start : start + len(buffer)]
        with np.errstate(over="ignore"):  # what overflows is reported
            np.copyto(buffer[: len(rows)], rows, casting="unsafe")
        buffer[len(rows) :] = 0
        _let_go(rows)
        check_rows(buffer[: len(rows)], name, range(start, len(array)), unit=True)
        yield Block(start, buffer, len(rows))
        start += len(buffer)


def views(array: Float32[np.ndarray, "n d"], name: str, size: int) -> Generator[Block, None, None]:
    """The array's rows as they lie in memory, `size` at a time; the last block may have fewer.

    Raises:
        InputError: a row is not finite, or not of unit length.
    """
    for start in range(0, len(array), size):
        rows = array[start : start + size]
        check_rows(rows, name, range(start, len(array)), unit=True)
        yield Block(start, rows, len(rows))


def is_mapped(array: np.ndarray) -> bool:
    """Whether it is part of a file that is mapped into memory."""
    return isinstance(_owner(array), np.memmap)


def _owner(array: np.ndarray) -> np.ndarray:
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array


def gathered(
    array: Float[np.ndarray, "n d"], places: Int[np.ndarray, " m"]
) -> Float[np.ndarray, "m d"]:
    """Rows at some places in rising order, as they are kept or in float32."""
    rows = np.empty((len(places), array.shape[1]), array.dtype if array.dtype in KEPT else WIDE)
    for start in range(0, len(places), _SCATTERED):
        some = places[start : start + _SCATTERED]
        rows[start : start + _SCATTERED] = array[some]
        _let_go(array[some[0] : some[-1] + 1])
    return rows


def sample(total: int, count: int, seed: int) -> Int[np.ndarray, " count"]:
    """`count` of `total` places, drawn at random, in their order for a disk's sake."""
    return np.sort(np.random.default_rng(seed).choice(total, count, replace=False))


def pieces(
    array: Float[np.ndarray, "n d"],
    name: str,
    size: int,
    places: Int[np.ndarray, " m"] | None = None,
) -> Generator[Float32[np.ndarray, "rows d"], None, None]:
    """All rows, or those at some places in rising order, `size` at a time, of any length.

    Raises:
        InputError: a row is not finite.
    """
    for start in range(0, len(array) if places is None else len(places), size):
        some = slice(start, start + size) if places is None else places[start : start + size]
        with np.errstate(over="ignore"):  # what overflows is reported
            rows = np.array(array[some], np.float32)
        if places is None:
            _let_go(array[some])
            check_rows(rows, name, range(start, len(array)), unit=False)
        else:
            _let_go(array[places[start] : places[start + len(rows) - 1] + 1])
            check_rows(rows, name, places[start:], unit=False)
        yield rows


def check_rows(
    rows: Float[np.ndarray, "rows d"], name: str, places: Sequence[int] | np.ndarray, *, unit: bool
) -> None:
    """Check that these rows are finite, and unit vectors where they are to be.

    Args:
        rows: descriptors.
        name: where they are from.
        places: theirs there, for the message.
        unit: whether they are to be of unit length, or finite only.

    Raises:
        InputError: one is not; the message names the first.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        squares = [
            np.einsum("nd,nd->n", wide, wide)
            for i in range(0, len(rows), _CHECKED)
            for wide in [rows[i : i + _CHECKED].astype(np.float32, copy=False)]
        ]
        norms = np.sqrt(np.concatenate(squares))
    # "Not within" rather than "beyond", so that NaN and infinity count as wrong.
    right = np.abs(norms - 1) <= UNIT_TOLERANCE if unit else np.isfinite(norms)
    wrong = np.flatnonzero(~right)
    if wrong.size:
        row = wrong[0]
        finite = np.isfinite(rows[row].astype(np.float32)).all()
        found = f"of length {norms[row]:.4g}" if finite else "not finite"
        expected = "finite unit vectors" if unit else "finite vectors"
        raise InputError(
            f"{name}: row {places[row]} is {found}, expected {expected} "
            f"({wrong.size} wrong of {len(rows)} rows from {places[0]})"
        )


def aligned(shape: tuple[int, int], dtype: np.dtype) -> np.ndarray:
    """An array that the devices of a CPU use as it lies, without a copy."""
    size = math.prod(shape) * dtype.itemsize
    memory = np.empty(size + _ALIGNMENT, np.uint8)
    offset = -memory.ctypes.data % _ALIGNMENT
    return memory[offset : offset + size].view(dtype).reshape(shape)


def _let_go(rows: np.ndarray) -> None:
    """Give pages of a memory-mapped file back, or all that were read would stay in memory."""
    owner: Any = _owner(rows)
    # What is written to a copy-on-write map is nowhere but in memory.
    if not isinstance(owner, np.memmap) or owner.mode == "c" or not hasattr(mmap, "MADV_DONTNEED"):
        return
    mapping: Any = owner.base
    origin = np.frombuffer(mapping, np.uint8).ctypes.data
    first, end = (place - origin for place in np.lib.array_utils.byte_bounds(rows))
    # Reading the first page has brought some before it back, of those let go last.
    first = max(0, first - first % mmap.PAGESIZE - _NEIGHBOURS)
    mapping.madvise(mmap.MADV_DONTNEED, first, end - first)
