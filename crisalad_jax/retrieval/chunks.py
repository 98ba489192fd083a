"""Read any number of descriptors, in memory or on disk, some rows at a time."""

import mmap
from collections.abc import Generator, Iterable, Sequence
from typing import Any, NamedTuple

import ml_dtypes
import numpy as np

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Float, Float32, Int

Descriptors = Float[np.ndarray, "n d"]
"""Descriptors of n images, one row of d dimensions each."""
Queries = Float32[np.ndarray, "q d"]
"""Unit descriptors of q images, in float32."""
# Descriptors may arrive as float16, whose unit vectors are off by up to 1e-3.
UNIT_TOLERANCE = 1e-2
WIDE = np.dtype(np.float32)
BITS = np.dtype(np.uint8)
"""Type of packed bits (`retrieval.bits`); no other descriptors have it."""
_NARROW = (np.dtype(np.float16), np.dtype(ml_dtypes.bfloat16))
_NEIGHBOURS = 2**21
"""Maximum number of bytes around a page that Linux maps when it reads the page."""
_SCATTERED = 4
"""Number of scattered rows read before their pages are released."""


def as_rows(array: np.ndarray, name: str, length: int | None = None) -> Descriptors:
    """Check that an array is a matrix of descriptors (of `length`, if given), and return a view.

    Values of two untyped bytes ("V2"), as a .npy file stores bfloat16, are viewed as bfloat16.

    Raises:
        InputError: the array is not a matrix of real numbers, is empty, or is of another length.
    """
    array = np.asanyarray(array)
    if array.dtype == np.dtype("V2"):
        array = array.view(ml_dtypes.bfloat16)
    if array.dtype == BITS:
        raise InputError(f"{name}: found packed bits (uint8), expected descriptors of real numbers")
    if array.dtype.kind in "cOSUMm" or array.dtype.type is np.void:
        raise InputError(f"{name}: found numbers of type {array.dtype}, expected real ones")
    if array.ndim != 2 or 0 in array.shape or length not in (None, array.shape[1]):
        raise InputError(
            f"{name}: found shape {array.shape}, expected (images, {length or 'descriptor'}), "
            "both above 0"
        )
    return array


def as_unit_rows(array: np.ndarray, name: str, length: int | None = None) -> Queries:
    """Check that an array is a matrix of unit descriptors, and return it in float32.

    Raises:
        InputError: the array is not such a matrix; see `as_rows` and `check_rows`.
    """
    wide = np.ascontiguousarray(_widened(as_rows(array, name, length)))
    check_rows(wide, name, range(len(wide)), unit=True)
    return wide


def as_sides(database: np.ndarray, queries: np.ndarray) -> tuple[Descriptors, Descriptors]:
    """Check that database and queries hold descriptors of the same length, and return them.

    Raises:
        InputError: one is not a matrix of descriptors (see `as_rows`), or the lengths differ.
    """
    database = as_rows(database, "database")
    return database, as_rows(queries, "queries", database.shape[1])


class Block(NamedTuple):
    """Some rows of an array, in order."""

    start: int
    """Number of rows in the blocks before it."""
    rows: Float[np.ndarray, "size d"]
    """The rows, in float32; with `narrow` in `blocks`, float16 and bfloat16 stay as they are."""


def blocks(
    array: Descriptors,
    name: str,
    size: int,
    *,
    unit: bool = True,
    places: Int[np.ndarray, " m"] | None = None,
    narrow: bool = False,
) -> Generator[Block, None, None]:
    """Check and yield the rows of an array in order, `size` at a time, without copies if possible.

    Pages of a memory map are released after the next block is taken, so a stream may be read one
    block ahead.

    Args:
        array: descriptors in memory or on disk.
        name: name of the array in messages.
        size: number of rows in a block; the last may have fewer.
        unit: whether rows must be of unit length, or only finite.
        places: indices of the rows to yield, in ascending order; None yields all.
        narrow: whether to leave float16 and bfloat16 as they are; else all rows become float32.

    Raises:
        InputError: a row is not finite, or not of unit length if required.
    """
    numbers = range(len(array)) if places is None else places
    before = array[:0]
    for start in range(0, len(numbers), size):
        some = numbers[start : start + size]
        span = array[some[0] : some[-1] + 1]
        rows = span if places is None else array[some]
        wide = _widened(rows)
        check_rows(wide, name, some, unit=unit)
        yield Block(start, rows if narrow and rows.dtype in _NARROW else wide)
        _let_go(before)
        before = span
    _let_go(before)


def joined(stream: Iterable[Block], size: int) -> Generator[Block, None, None]:
    """Join consecutive blocks into larger ones of at least `size` rows, except the last.

    Args:
        stream: blocks of at most `size` rows.
        size: minimum number of rows; a joined block has less than twice as many.
    """
    parts: list[Float[np.ndarray, "rows d"]] = []
    start = count = 0
    for block in stream:
        parts.append(block.rows)
        count += len(block.rows)
        if count >= size:
            yield Block(start, np.concatenate(parts) if len(parts) > 1 else parts[0])
            parts, start, count = [], start + count, 0
    if parts:
        yield Block(start, np.concatenate(parts))


def regrouped(parts: Iterable[Descriptors], size: int) -> Generator[Block, None, None]:
    """Regroup consecutive arrays into blocks of at least `size` rows, except the last."""
    pieces = (
        Block(0, part[start : start + size])  # `joined` sets the starts
        for part in parts
        for start in range(0, len(part), size)
    )
    return joined(pieces, size)


def gathered(array: Descriptors, places: Int[np.ndarray, " m"]) -> Float[np.ndarray, "m d"]:
    """Read the rows at `places`, which must be in ascending order, and release their pages."""
    parts = []
    for start in range(0, len(places), _SCATTERED):
        some = places[start : start + _SCATTERED]
        parts.append(array[some])
        _let_go(array[some[0] : some[-1] + 1])
    return np.concatenate(parts)


def _widened(rows: np.ndarray) -> Float32[np.ndarray, "rows d"]:
    with np.errstate(over="ignore"):  # overflow is reported later
        return rows.astype(WIDE, copy=False)


def sample(total: int, count: int, seed: int) -> Int[np.ndarray, " count"]:
    """Draw `count` indices below `total` at random, sorted so that disks are read in order."""
    return np.sort(np.random.default_rng(seed).choice(total, count, replace=False))


def check_rows(
    rows: Float[np.ndarray, "rows d"], name: str, places: Sequence[int] | np.ndarray, *, unit: bool
) -> None:
    """Check that rows are finite and, if required, unit vectors.

    Args:
        rows: descriptors.
        name: name of the array that they are from, for the message.
        places: indices of the rows in that array, for the message.
        unit: whether they must be of unit length, or only finite.

    Raises:
        InputError: a row fails the check; the message describes the first.
    """
    wide = _widened(rows)
    with np.errstate(over="ignore", invalid="ignore"):
        norms = np.sqrt(np.einsum("nd,nd->n", wide, wide))
    # "Not within" rather than "beyond", so that NaN and infinity count as wrong.
    right = np.abs(norms - 1) <= UNIT_TOLERANCE if unit else np.isfinite(norms)
    wrong = np.flatnonzero(~right)
    if wrong.size:
        row = wrong[0]
        fault = f"of length {norms[row]:.4g}" if np.isfinite(wide[row]).all() else "not finite"
        expected = "finite unit vectors" if unit else "finite vectors"
        raise InputError(
            f"{name}: row {places[row]} is {fault}, expected {expected} "
            f"({wrong.size} wrong of {len(rows)} rows from {places[0]})"
        )


def _let_go(rows: np.ndarray) -> None:
    """Release the pages of a memory map; otherwise every page that was read stays in memory."""
    owner: Any = rows
    while isinstance(owner.base, np.ndarray):
        owner = owner.base
    # Pages written in a copy-on-write map exist only in memory: releasing them would lose them.
    is_file = isinstance(owner, np.memmap) and owner.mode != "c"
    if not is_file or not len(rows) or not hasattr(mmap, "MADV_DONTNEED"):
        return
    mapping: Any = owner.base
    origin = np.frombuffer(mapping, np.uint8).ctypes.data
    first, end = (place - origin for place in np.lib.array_utils.byte_bounds(rows))
    # Reading the first page has mapped its neighbours again, which the last call released.
    first = max(0, first - first % mmap.PAGESIZE - _NEIGHBOURS)
    mapping.madvise(mmap.MADV_DONTNEED, first, end - first)
