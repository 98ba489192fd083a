"""Pictures resized as Pillow does it, compiled by numba: OpenCV has no antialiased bilinear."""

import functools
import threading
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from crisalad_jax.errors import InputError


def resize_image(
    image: UInt8[np.ndarray, "h w 3"], image_size: tuple[int, int]
) -> UInt8[np.ndarray, "height width 3"]:
    """Resize to `image_size`, (height, width), without keeping the aspect ratio.

    Bilinear, and antialiased where it shrinks: a triangle filter two output pixels wide, which is
    Pillow's BILINEAR and so torchvision's Resize, with which the public models were trained and
    evaluated. Equal to Pillow within one grey level. (OpenCV's INTER_AREA is a box, on photographs
    several times further away; its INTER_LINEAR aliases.)

    Raises:
        InputError: the image is not of 8-bit RGB, or has no pixel, or is to have none.
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
    """What each of `new` values along one side is made of: neighbours among the old ones."""

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
"""Or as many threads as meet at a first picture would each compile, one after the other."""


@functools.cache
def _compiled() -> Callable[..., None]:
    """`_resample` as machine code, which runs outside of Python's lock.

    Compiled in less than a second, and kept on disk (beside this file, or in the user's cache).
    """
    import numba
    from numba import types

    old = types.Array(types.uint8, 2, "C", readonly=True)  # what may be written to is taken as well
    new, numbers = types.uint8[:, ::1], types.int64[::1]
    taps = (numbers, numbers, types.float32[:, ::1])
    options = {"nogil": True, "fastmath": {"contract"}}
    signature = types.void(old, *taps, *taps, new)
    try:
        return numba.njit(signature, cache=True, **options)(_resample)
    except (RuntimeError, OSError):  # nowhere to keep it, or no room
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
    """Line after line, so that what is between the two directions stays in the nearest cache."""
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
            # A half, because the fraction is cut off.
            red = green = blue = np.float32(0.5)
            for tap in range(column_count[column]):
                weight = column_weights[column, tap]
                red += weight * near[3 * tap]
                green += weight * near[3 * tap + 1]
                blue += weight * near[3 * tap + 2]
            target[3 * column] = np.uint8(red)
            target[3 * column + 1] = np.uint8(green)
            target[3 * column + 2] = np.uint8(blue)
