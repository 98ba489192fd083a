"""Resize images as Pillow and torch do, with numba: OpenCV has no antialiased filters."""

import functools
import sys
import threading
from collections.abc import Callable, Mapping
from typing import Any, Literal

import cv2
import numpy as np

from crisalad_jax.config.checks import choose
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import user_cache
from crisalad_jax.utils.shapes import Float32, Int64, UInt8

Pixels = UInt8[np.ndarray, "h w 3"] | Float32[np.ndarray, "h w 3"]


def resize_image(
    image: Pixels,
    image_size: tuple[int, int],
    *,
    filter: Literal["bilinear", "bicubic", "area"] = "bilinear",
    antialias: bool = True,
    pixels: Literal["bytes", "floats"] = "bytes",
) -> Pixels:
    """Resize an image to exactly `image_size`, whatever its aspect ratio.

    By default the filter is bilinear, and antialiased where the image shrinks: a triangle two
    output pixels wide. Most public models were trained and evaluated with this filter, which is
    Pillow's BILINEAR and torchvision's Resize. The result is within one grey level of Pillow's, and
    so is that of "bicubic" on bytes. (On photographs, OpenCV's INTER_AREA, a box filter, is several
    times further from Pillow; its INTER_LINEAR aliases.) Floats equal torch's `interpolate` up to
    rounding, with or without antialiasing.
    Numpy resizes the first few images, because loading numba takes longer, and all images if numba
    (the `train` extra) is missing. Its result is bit-identical, but takes ten times as long.

    Args:
        image: 8-bit RGB; with "floats" also float32.
        image_size: height and width in pixels.
        filter: "bilinear", "bicubic", or "area": OpenCV's INTER_AREA or, if a side grows,
            INTER_LINEAR, as in hloc.
        antialias: whether the filter widens where the image shrinks. Without it "bicubic" is a
            little sharper, as in torch.
        pixels: "bytes" are rounded to uint8, as in Pillow; "floats" are neither rounded nor clamped
            nor rescaled.

    Returns:
        The image at that size, of uint8 or float32.

    Raises:
        InputError: `image` has another type or shape, a side is below 1, or an option is unknown.

    Example:
        >>> import numpy as np
        >>> resize_image(np.full((4, 6, 3), 7, np.uint8), (2, 3))[0, 0].tolist()
        [7, 7, 7]
    """
    choose("pixels", pixels, {"bytes": None, "floats": None})
    choose("filter", filter, {**_KERNELS, "area": None})
    kinds = (np.uint8,) if pixels == "bytes" else (np.uint8, np.float32)
    shape, dtype = np.shape(image), getattr(image, "dtype", type(image).__name__)
    is_image = shape[2:] == (3,) and 0 not in shape and dtype in kinds
    if not is_image or np.shape(image_size) != (2,) or min(image_size) < 1:
        raise InputError(
            f"image, image_size: found {dtype} of shape {shape} and {image_size!r}, expected uint8 "
            "of shape (height, width, 3), and two whole numbers; all sides at least 1"
        )
    if filter == "area":
        grows = any(new > old for new, old in zip(image_size, shape, strict=False))
        how = cv2.INTER_LINEAR if grows else cv2.INTER_AREA
        given: Any = image if pixels == "bytes" else image.astype(np.float32)
        return cv2.resize(given, image_size[::-1], interpolation=how)
    height, width = image.shape[:2]
    taps = [_taps(old, new, filter, antialias) for old, new in zip(shape, image_size, strict=False)]
    flat = np.ascontiguousarray(image).reshape(height, 3 * width)
    once = (filter, antialias, pixels) == ("bilinear", True, "bytes")
    resized = np.empty((image_size[0], 3 * image_size[1]), np.uint8 if once else np.float32)
    resample = _resampler(flat.size, once)
    if once:
        resample(flat, *taps, resized)
    else:
        resample(flat.astype(np.float32), *taps, resized, pixels == "bytes")
    resized = resized.reshape(*image_size, 3)
    return resized.astype(np.uint8) if pixels == "bytes" else resized


_Taps = tuple[Int64[np.ndarray, " new"], Int64[np.ndarray, " new"], Float32[np.ndarray, "new most"]]
"""Filter taps along one side: for each new value, the first of its old neighbours, their number,
and their weights, which sum to 1."""


def _triangle(distances: np.ndarray) -> np.ndarray:
    return np.maximum(0, 1 - distances)


def _cubic(distances: np.ndarray, a: float) -> np.ndarray:
    """Compute Keys' cubic; `a` is its slope at 1, the first zero."""
    near = ((a + 2) * distances - (a + 3)) * distances**2 + 1
    far = a * (((distances - 5) * distances + 8) * distances - 4)
    return np.where(distances < 1, near, np.where(distances < 2, far, 0))


_KERNELS: Mapping[str, tuple[int, Callable[[np.ndarray], np.ndarray]]] = {
    "bilinear": (1, _triangle),
    "bicubic": (2, functools.partial(_cubic, a=-0.5)),
}
"""Radius in output pixels, and weights by distance, of Pillow's and torch's antialiased filters."""
_SHARPER = {"bilinear": _triangle, "bicubic": functools.partial(_cubic, a=-0.75)}
"""Weights of torch's filters without antialiasing."""


@functools.lru_cache(maxsize=256)
def _taps(old: int, new: int, name: str, antialias: bool) -> _Taps:
    if not antialias:
        return _taps_at_points(old, new, name)
    support, kernel = _KERNELS[name]
    scale = old / new
    stretch = max(scale, 1.0)
    radius = support * stretch
    centres = (np.arange(new) + 0.5) * scale
    first = np.maximum(0, np.floor(centres - radius + 0.5)).astype(np.int64)
    last = np.minimum(old - 1, np.ceil(centres + radius - 0.5) - 1).astype(np.int64)
    count = last - first + 1
    number = np.arange(count.max())
    distances = np.abs(first[:, None] + number + 0.5 - centres[:, None]) / stretch
    weights = np.where(number < count[:, None], kernel(distances), 0)
    weights /= weights.sum(axis=1, keepdims=True)
    return first, count, weights.astype(np.float32)


def _taps_at_points(old: int, new: int, name: str) -> _Taps:
    """Make taps without widening; beyond the border the last pixel is repeated."""
    support, _ = _KERNELS[name]
    points = (np.arange(new) + 0.5) * (old / new) - 0.5
    if name == "bilinear":
        points = np.maximum(points, 0)
    floor = np.floor(points)
    near = floor[:, None] + np.arange(1 - support, 1 + support)
    weights = _SHARPER[name](np.abs(near - points[:, None]))
    inside = np.clip(near, 0, old - 1).astype(np.int64)
    first, count = inside[:, 0], inside[:, -1] - inside[:, 0] + 1
    summed = np.zeros_like(weights)
    np.add.at(summed, (np.arange(new)[:, None], inside - first[:, None]), weights)
    return np.ascontiguousarray(first), count, summed.astype(np.float32)


_COMPILING = threading.Lock()
"""Lock around the compilation: without it every thread would compile at its first image."""
_FEW = 2**23
"""Number of values that numpy resamples in the time that numba takes to load: four photographs."""


class _Seen:
    """A count of the values resampled so far."""

    values = 0


def _resampler(values: int, once: bool) -> Callable[..., None]:
    """Return the function that resamples the next values: numpy's for the first few, then numba's.

    Loading numba takes half a second, a third of the time from the start of a program to its first
    answer (docs/performance-studies.md). Without numba, numpy resamples all images.

    Args:
        values: number of values of the image.
        once: whether the result is rounded once, as by `_resample`, or as by `_resample_floats`.
    """
    _Seen.values += values
    if _Seen.values > _FEW or "numba" in sys.modules:
        with _COMPILING:
            compiled = _machine_code(once)
        if compiled is not None:
            return compiled
    return _step if once else _step_floats


@functools.cache
def _machine_code(once: bool) -> Callable[..., None] | None:
    """Compile a loop that releases the GIL; None without numba.

    Compiling takes about a second; the result is cached in `user_cache` or NUMBA_CACHE_DIR.
    """
    try:
        import numba
        from numba import types
    except ModuleNotFoundError:
        return None

    function: Any = _resample if once else _resample_floats
    values = types.uint8 if once else types.float32
    # A read-only type accepts writable arrays too.
    pixels = types.Array(values, 2, "C", readonly=True)
    taps = types.Tuple((types.int64[::1], types.int64[::1], types.float32[:, ::1]))
    rounds = () if once else (types.bool_,)
    signature = types.void(pixels, taps, taps, values[:, ::1], *rounds)
    options = {"nogil": True, "fastmath": {"contract"}}
    config: Any = numba.config  # pyright: ignore
    before = config.CACHE_DIR
    try:
        config.CACHE_DIR = before or str(user_cache() / "numba")
        return numba.njit(signature, cache=True, **options)(function)
    except (RuntimeError, OSError):  # no home or no writable cache folder, or a full disk
        return numba.njit(signature, **options)(function)
    finally:
        config.CACHE_DIR = before


def _resample(pixels: np.ndarray, rows: _Taps, columns: _Taps, resized: np.ndarray) -> None:
    """Resample line by line, so that the rows between the two passes stay in the L1 cache."""
    first_line, line_count, line_weights = rows
    first_column, column_count, column_weights = columns
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


def _resample_floats(
    pixels: np.ndarray, rows: _Taps, columns: _Taps, resized: np.ndarray, rounds: bool
) -> None:
    """Resample along rows, then columns, as Pillow does; `rounds` rounds and clips to 0 to 255."""
    first_line, line_count, line_weights = rows
    first_column, column_count, column_weights = columns
    lines = np.empty((pixels.shape[0], resized.shape[1]), np.float32)
    for row in range(pixels.shape[0]):
        line = lines[row]
        for column in range(first_column.size):
            near = pixels[row, 3 * first_column[column] :]
            red = green = blue = np.float32(0)
            for tap in range(column_count[column]):
                weight = column_weights[column, tap]
                red += weight * near[3 * tap]
                green += weight * near[3 * tap + 1]
                blue += weight * near[3 * tap + 2]
            line[3 * column] = red
            line[3 * column + 1] = green
            line[3 * column + 2] = blue
        if rounds:
            for i in range(line.size):
                line[i] = min(max(np.floor(line[i] + np.float32(0.5)), 0), 255)
    for row in range(resized.shape[0]):
        target = resized[row]
        target[:] = 0
        for tap in range(line_count[row]):
            weight, source = line_weights[row, tap], lines[first_line[row] + tap]
            for i in range(target.size):
                target[i] += weight * source[i]
        if rounds:
            for i in range(target.size):
                target[i] = min(max(np.floor(target[i] + np.float32(0.5)), 0), 255)


def _step(pixels: np.ndarray, line_taps: _Taps, column_taps: _Taps, resized: np.ndarray) -> None:
    """Resample with numpy, bit-identical to `_resample`."""
    near = _sums(pixels, line_taps).reshape(len(resized), -1, 3).swapaxes(0, 1)
    resized[:] = _sums(near, column_taps, 0.5).swapaxes(0, 1).reshape(resized.shape)


def _step_floats(
    pixels: np.ndarray, line_taps: _Taps, column_taps: _Taps, resized: np.ndarray, rounds: bool
) -> None:
    """Resample with numpy, bit-identical to `_resample_floats`."""

    def rounded(values: np.ndarray) -> np.ndarray:
        return np.clip(np.floor(values + np.float32(0.5)), 0, 255) if rounds else values

    near = pixels.reshape(len(pixels), -1, 3).swapaxes(0, 1)
    lines = rounded(_sums(near, column_taps)).swapaxes(0, 1).reshape(len(pixels), -1)
    resized[:] = rounded(_sums(lines, line_taps))


def _sums(values: np.ndarray, taps: _Taps, start: float = 0.0) -> np.ndarray:
    """Sum the weighted rows of each tap, a tap at a time; rows beyond the last have weight 0.

    A product of two float32 is exact in float64, so each sum is rounded once, to float32, as by a
    processor's fused multiply-add.
    """
    first, _, weights = taps
    sums = np.full((len(first), *values.shape[1:]), start, np.float32)
    for tap in range(weights.shape[1]):
        rows = values[np.minimum(first + tap, len(values) - 1)]
        by_row = weights[:, tap].astype(np.float64).reshape(-1, *[1] * (rows.ndim - 1))
        sums = (by_row * rows + sums).astype(np.float32)
    return sums
