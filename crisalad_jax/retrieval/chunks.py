"""Descriptors in any number, in memory or on disk, some rows at a time."""

import math
import mmap
from collections.abc import Generator, Iterator, Sequence
from typing import Any, NamedTuple

import ml_dtypes
import numpy as np

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Float, Float32, Int

# Descriptors may arrive as float16, whose unit vectors are off by up to 1e-3.
UNIT_TOLERANCE = 1e-2
WIDE = np.dtype(np.float32)
KEPT = (WIDE, np.dtype(np.float16), np.dtype(ml_dtypes.bfloat16))
"""Types of descriptors that are not converted; float32 holds all their values."""
_CHECKED = 64
"""Number of rows whose lengths are computed at a time."""
_ALIGNMENT = 64
"""Alignment of XLA's arrays in bytes."""
_NEIGHBOURS = 2**21
"""Bytes around a page that is read which Linux maps with it, at most."""
_SCATTERED = 4
"""Number of scattered rows that are read before their pages are released."""


def as_rows(array: np.ndarray, name: str) -> Float[np.ndarray, "n d"]:
    """Check that an array is a matrix of descriptors, and view it as one.

    Numpy has no name for bfloat16: a .npy file holds it as two bytes without a type ("V2"). Types
    that are not in `KEPT` become float32 when their rows are read.

    Raises:
        InputError: the array is no matrix, or is empty.
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
    """Check that database and queries are matrices of descriptors of one length.

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
    """A run of consecutive rows."""

    start: int
    """Index of the first row in the whole array."""
    rows: Float[np.ndarray, "size d"]
    """The rows; zeros follow the valid ones as padding."""
    valid: int
    """Number of valid rows."""


def blocks(
    array: Float[np.ndarray, "n d"],
    name: str,
    buffers: Iterator[Float[np.ndarray, "size d"]],
) -> Generator[Block, None, None]:
    """Copy an array's rows into the given buffers, one block after the other.

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
    """Yield an array's rows without a copy, `size` at a time; the last block may have fewer.

    Raises:
        InputError: a row is not finite, or not of unit length.
    """
    for start in range(0, len(array), size):
        rows = array[start : start + size]
        check_rows(rows, name, range(start, len(array)), unit=True)
        yield Block(start, rows, len(rows))


def is_mapped(array: np.ndarray) -> bool:
    """Return whether an array is part of a memory-mapped file."""
    return isinstance(_owner(array), np.memmap)


def _owner(array: np.ndarray) -> np.ndarray:
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array


def gathered(
    array: Float[np.ndarray, "n d"], places: Int[np.ndarray, " m"]
) -> Float[np.ndarray, "m d"]:
    """Read the rows at some places in ascending order, in their own type or in float32."""
    rows = np.empty((len(places), array.shape[1]), array.dtype if array.dtype in KEPT else WIDE)
    for start in range(0, len(places), _SCATTERED):
        some = places[start : start + _SCATTERED]
        rows[start : start + _SCATTERED] = array[some]
        _let_go(array[some[0] : some[-1] + 1])
    return rows


def sample(total: int, count: int, seed: int) -> Int[np.ndarray, " count"]:
    """Draw `count` of `total` places at random, sorted so that a disk is read in order."""
    return np.sort(np.random.default_rng(seed).choice(total, count, replace=False))


def pieces(
    array: Float[np.ndarray, "n d"],
    name: str,
    size: int,
    places: Int[np.ndarray, " m"] | None = None,
) -> Generator[Float32[np.ndarray, "rows d"], None, None]:
    """Yield rows as float32, `size` at a time: all of them, or those at ascending places.

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


def check_all_rows(array: Float[np.ndarray, "n d"], name: str, *, unit: bool) -> None:
    """Check all rows of an array in memory or on disk, as `check_rows`, before they are used.

    Raises:
        InputError: a row is not finite, or no unit vector where that is asked for.
    """
    for start in range(0, len(array), _CHECKED):
        rows = array[start : start + _CHECKED]
        check_rows(rows, name, range(start, len(array)), unit=unit)
        _let_go(rows)


def check_rows(
    rows: Float[np.ndarray, "rows d"], name: str, places: Sequence[int] | np.ndarray, *, unit: bool
) -> None:
    """Check that rows are finite and, where that is asked for, unit vectors.

    Args:
        rows: descriptors.
        name: where they are from.
        places: their indices there, for the message.
        unit: whether they have to be of unit length, or only finite.

    Raises:
        InputError: a row is not; the message names the first.
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
        fault = f"of length {norms[row]:.4g}" if finite else "not finite"
        expected = "finite unit vectors" if unit else "finite vectors"
        raise InputError(
            f"{name}: row {places[row]} is {fault}, expected {expected} "
            f"({wrong.size} wrong of {len(rows)} rows from {places[0]})"
        )


def aligned(shape: tuple[int, int], dtype: np.dtype) -> np.ndarray:
    """Allocate an array that a CPU's devices use in place, without a copy."""
    size = math.prod(shape) * dtype.itemsize
    memory = np.empty(size + _ALIGNMENT, np.uint8)
    offset = -memory.ctypes.data % _ALIGNMENT
    return memory[offset : offset + size].view(dtype).reshape(shape)


def _let_go(rows: np.ndarray) -> None:
    """Release a memory map's pages; otherwise every page that was read stays in memory."""
    owner: Any = _owner(rows)
    # Pages written in a copy-on-write map exist in memory alone: releasing them would lose them.
    if not isinstance(owner, np.memmap) or owner.mode == "c" or not hasattr(mmap, "MADV_DONTNEED"):
        return
    mapping: Any = owner.base
    origin = np.frombuffer(mapping, np.uint8).ctypes.data
    first, end = (place - origin for place in np.lib.array_utils.byte_bounds(rows))
    # Reading the first page has mapped its neighbours again, which the last call had released.
    first = max(0, first - first % mmap.PAGESIZE - _NEIGHBOURS)
    mapping.madvise(mmap.MADV_DONTNEED, first, end - first)
