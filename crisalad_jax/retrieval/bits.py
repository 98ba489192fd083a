"""Binary descriptors: the signs of a descriptor's dimensions, packed eight to a byte.

They are compared by the Hamming distance, exactly and without JAX.
"""

from collections.abc import Generator, Iterable

import numpy as np

from crisalad_jax.config.checks import require
from crisalad_jax.retrieval.chunks import (
    BITS,
    Block,
    as_rows,
    check_rows,
    regrouped,
)
from crisalad_jax.retrieval.neighbours import (
    QUERY_CHUNK,
    Neighbours,
    Products,
    best_products,
)
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Float, Float32, UInt8

Bits = UInt8[np.ndarray, "n bytes"]
"""Packed bits of n images, one row each: a byte for every eight dimensions."""
_ROWS = 4096
"""Number of database rows compared at a time."""
_PIECE = 2**16
"""Number of pairs whose distances are counted at a time: 512 KiB, which fits a core's cache."""


def pack_bits(descriptors: Float[np.ndarray, "n d"]) -> UInt8[np.ndarray, "n d/8"]:
    """Pack the signs of descriptors: a bit is 1 where a value is at least 0.

    The first dimension is the highest bit of the first byte, as in `numpy.packbits`. A value of 0
    gives a bit of 1, as in SelaVPR++; TeTRA differs only in that a value of 0 gives a bit of 0.

    Args:
        descriptors: descriptors of the n images, of any norm; d is a multiple of 8.

    Returns:
        The packed bits, which `search` accepts as they are.

    Raises:
        InputError: the array is not a matrix of finite numbers, or d is not a multiple of 8.

    Example:
        >>> import numpy as np
        >>> pack_bits(np.array([[0.5, -0.5, 0.0, 0.1, -0.2, -0.3, -0.4, 0.7]])).tolist()
        [[177]]
    """
    return _packed(descriptors, "descriptors")


def to_bits(array: np.ndarray, name: str, length: int) -> Bits:
    """Pack descriptors of `length` dimensions, or check them if they are packed already.

    Raises:
        InputError: the array holds neither, or has another length; the message calls it `name`.
    """
    convert = as_bits if np.asanyarray(array).dtype == BITS else _packed
    return convert(array, name, length)


def _packed(array: np.ndarray, name: str, length: int | None = None) -> Bits:
    rows = as_rows(array, name, length)
    check_packable(rows.shape[1], name)
    check_rows(rows, name, range(len(rows)), unit=False)
    return np.packbits(rows >= 0, axis=1)


def check_packable(length: int, name: str) -> None:
    """Raise InputError if descriptors of `length` dimensions do not fill whole bytes."""
    require(length % 8 == 0, f"{name}: found {length} dimensions, expected a multiple of 8 as bits")


def sign_vectors(bits: Bits) -> Float32[np.ndarray, "n d"]:
    """Unpack bits into unit vectors of +v and -v, whose cosines equal the bits' similarities."""
    size = np.float32(1 / np.sqrt(8 * bits.shape[1]))
    return np.where(np.unpackbits(bits, axis=1), size, -size)


def as_bits(array: np.ndarray, name: str, length: int | None = None) -> Bits:
    """Check that an array holds packed bits; if `length` is given, of that many dimensions.

    Raises:
        InputError: it is not a matrix of bytes, is empty, or is of another length.
    """
    array = np.asanyarray(array)
    expected = "bytes" if length is None else length // 8
    fits = array.ndim == 2 and 0 not in array.shape and expected in ("bytes", array.shape[1])
    if array.dtype != BITS or not fits:
        raise InputError(
            f"{name}: found {array.dtype} {array.shape}, expected packed bits, uint8 of shape "
            f"(images, {expected}), both above 0"
        )
    return array


def search_bits(database: Bits, queries: Bits, k: int) -> Neighbours:
    """Find the k rows with the most bits in common with each query, as `retrieval.search` does.

    Raises:
        InputError: the arrays are not packed bits of the same length.
    """
    database = as_bits(database, "database")
    queries = as_bits(queries, "queries", 8 * database.shape[1])
    return nearest_bits([database], queries, min(k, len(database)))


def nearest_bits(database: Iterable[Bits], queries: Bits, k: int) -> Neighbours:
    """Find the k rows with the most bits in common with each query; ties go to lower indices.

    Args:
        database: packed bits of the database in consecutive parts, with at least k rows in all.
        queries: packed bits.
        k: neighbours per query.

    Returns:
        The neighbours, with similarities 1 - 2 h / d, where h of the d bits differ: the cosines of
        the sign vectors.
    """
    compared = _compared(regrouped(database, _ROWS), _as_words(queries), 8 * queries.shape[1])
    return best_products(compared, len(queries), k)


def _compared(
    stream: Iterable[Block], queries: np.ndarray, bits: int
) -> Generator[Products, None, None]:
    """Yield the similarities of all queries to all blocks."""
    similarities = (1 - 2 * np.arange(bits + 1) / bits).astype(np.float32)
    for block in stream:
        rows = np.ascontiguousarray(_as_words(block.rows).T)
        step = max(1, _PIECE // rows.shape[1])
        for first in range(0, len(queries), QUERY_CHUNK):
            some = queries[first : first + QUERY_CHUNK]
            differing = np.zeros((len(some), rows.shape[1]), np.int32)
            for start in range(0, len(some), step):
                part = differing[start : start + step]
                for number, words in enumerate(rows):
                    other = some[start : start + step, number, None] ^ words
                    part += np.bitwise_count(other)
            yield Products(
                first, similarities[differing].T, block.start + np.arange(rows.shape[1])[:, None]
            )


def _as_words(bits: Bits) -> np.ndarray:
    """View bits as 64-bit integers; missing bytes are padded with 0."""
    missing = -bits.shape[1] % 8
    padded = np.pad(bits, ((0, 0), (0, missing))) if missing else np.ascontiguousarray(bits)
    return padded.view(np.uint64)
