"""Resize images as Pillow does, compiled by numba: OpenCV has no antialiased bilinear filter."""

import functools
import threading
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from crisalad_jax.utils.errors import InputError


def resize_image(
    image: UInt8[np.ndarray, "h w 3"], image_size: tuple[int, int]
) -> UInt8[np.ndarray, "height width 3"]:
    """Resize an image, without keeping the aspect ratio.

    The filter is bilinear, and antialiased where the image shrinks: a triangle two output pixels
    wide. The public models were trained and evaluated with it, as Pillow's BILINEAR and
    torchvision's Resize. The result equals Pillow's within one grey level. (OpenCV's INTER_AREA is
    a box filter, several times further from Pillow on photographs; its INTER_LINEAR aliases.)
    Without numba, which the `train` extra installs, matrix products take a hundred times as long.

    Args:
        image: 8-bit RGB.
        image_size: height and width in pixels.

    Returns:
        The image at that size.

    Raises:
        InputError: the image is not 8-bit RGB, or either size has no pixel.

    Example:
        >>> import numpy as np
        >>> resize_image(np.full((4, 6, 3), 7, np.uint8), (2, 3))[0, 0].tolist()
        [7, 7, 7]
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise InputError(
            f"image: found {image.dtype} of shape {image.shape}, expected uint8 of shape "
            "(height, width, 3) with sides of at least 1"
        )
    if min(image_size) < 1:
        raise InputError(f"image_size: found {image_size}, expected sides of at least 1")
    height, width = image.shape[:2]
    pixels = np.ascontiguousarray(image).reshape(height, 3 * width)
    resized = np.empty((*image_size, 3), np.uint8)
    lines, columns = _taps(height, image_size[0]), _taps(width, image_size[1])
    with _COMPILING:
        resample = _compiled()
    resample(pixels, *lines, *columns, resized.reshape(image_size[0], -1))
    return resized


class _Taps(NamedTuple):
    """The filter taps along one side: for each new value, the old neighbours and their weights."""

    first: Int64[np.ndarray, " new"]
    count: Int64[np.ndarray, " new"]
    weights: Float32[np.ndarray, "new most"]
    """Sum to 1; 0 from `count` on."""


@functools.lru_cache(maxsize=256)
def _taps(old: int, new: int) -> _Taps:
    scale = old / new
    radius = max(scale, 1.0)
    centres = (np.arange(new) + 0.5) * scale
    first = np.maximum(0, np.floor(centres - radius + 0.5)).astype(np.int64)
    last = np.minimum(old - 1, np.ceil(centres + radius - 0.5) - 1).astype(np.int64)
    count = last - first + 1
    number = np.arange(count.max())
    distances = np.abs(first[:, None] + number + 0.5 - centres[:, None]) / radius
    weights = np.where(number < count[:, None], np.maximum(0, 1 - distances), 0)
    weights /= weights.sum(axis=1, keepdims=True)
    return _Taps(first, count, weights.astype(np.float32))


_COMPILING = threading.Lock()
"""Lock around the compilation: without it every thread would compile at its first image."""


@functools.cache
def _compiled() -> Callable[..., None]:
    """Return `_resample` as machine code, which releases Python's global lock.

    It compiles in less than a second, and is cached on disk (beside this file, or for the user).
    """
    try:
        import numba
        from numba import types
    except ModuleNotFoundError:
        return _multiply

    old = types.Array(types.uint8, 2, "C", readonly=True)  # accepts writable arrays too
    new, numbers = types.uint8[:, ::1], types.int64[::1]
    taps = (numbers, numbers, types.float32[:, ::1])
    options = {"nogil": True, "fastmath": {"contract"}}
    signature = types.void(old, *taps, *taps, new)
    try:
        return numba.njit(signature, cache=True, **options)(_resample)
    except (RuntimeError, OSError):  # no writable cache folder, or a full disk
        return numba.njit(signature, **options)(_resample)


def _resample(
    pixels: np.ndarray,
    first_line: np.ndarray,
    line_count: np.ndarray,
    line_weights: np.ndarray,
    first_column: np.ndarray,
    column_count: np.ndarray,
    column_weights: np.ndarray,
    resized: np.ndarray,
) -> None:
    """Resample line after line, so that the rows between the two passes stay in the L1 cache."""
    line = np.empty(pixels.shape[1], np.float32)
    for row in range(resized.shape[0]):
        line[:] = 0
        for tap in range(line_count[row]):
            weight, source = line_weights[row, tap], pixels[first_line[row] + tap]
            for i in range(line.size):
                line[i] += weight * source[i]
        target = resized[row]
        for column in range(first_column.size):
            near = line[3 * first_column[column] :]
            # Add a half to round, because the conversion truncates.
            red = green = blue = np.float32(0.5)
            for tap in range(column_count[column]):
                weight = column_weights[column, tap]
                red += weight * near[3 * tap]
                green += weight * near[3 * tap + 1]
                blue += weight * near[3 * tap + 2]
            target[3 * column] = np.uint8(red)
            target[3 * column + 1] = np.uint8(green)
            target[3 * column + 2] = np.uint8(blue)


def _multiply(pixels: np.ndarray, *taps_and_result: np.ndarray) -> None:
    """Resample as `_resample` does, by dense matrix products."""
    *taps, resized = taps_and_result
    lines = _matrix(_Taps(*taps[:3]), pixels.shape[0])
    columns = _matrix(_Taps(*taps[3:]), pixels.shape[1] // 3)
    rows = (lines @ pixels.astype(np.float32)).reshape(len(lines), -1, 3)
    target = resized.reshape(len(lines), -1, 3)
    np.add(
        np.einsum("hwc,vw->hvc", rows, columns, optimize=True), 0.5, out=target, casting="unsafe"
    )


def _matrix(taps: _Taps, old: int) -> np.ndarray:
    matrix = np.zeros((len(taps.first), old + taps.weights.shape[1]), np.float32)
    at = taps.first[:, None] + np.arange(taps.weights.shape[1])
    np.put_along_axis(matrix, at, taps.weights, axis=1)
    return matrix[:, :old]
