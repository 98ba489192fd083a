"""RandAugment (Cubuk et al., CVPR Workshops 2020), as in torchvision on Pillow images."""

import functools
import math
from collections.abc import Callable
from typing import Annotated, NamedTuple

import cv2
import numpy as np

from crisalad_jax.config.checks import NonNegativeInt, limited
from crisalad_jax.data.augmentations.base import AUGMENTATIONS, Augmentation, Image
from crisalad_jax.utils.shapes import Int64, UInt8

MAGNITUDE_BINS = 31

# ITU-R BT.601 luma, in 16-bit fixed point as in Pillow's convert("L"). The last column
# rounds. All sums of these are multiples of 2**-16 below 2**8: exact in float32.
_PILLOW_LUMA = np.array([[19595, 38470, 7471, 0x8000]]) / 2**16
_LEVELS = np.arange(256)


@AUGMENTATIONS.register("rand-augment")
class RandAugmentConfig(Augmentation):
    """RandAugment (Cubuk et al. 2020): torchvision's 14 operations, with GSV-Cities' strength."""

    operations: NonNegativeInt = 3
    """Number of operations applied to each image."""
    magnitude: Annotated[int, limited(0, MAGNITUDE_BINS - 1)] = 9
    """Strength of the operations, from 0 to 30: torchvision's 31 bins."""

    def apply(
        self, image: Image, generator: np.random.Generator, *, of_place: np.random.Generator
    ) -> Image:
        """Apply operations drawn uniformly with replacement; `signed` ones get a random sign.

        The result equals that of torchvision's RandAugment on Pillow images (bilinear, black fill).
        """
        names = list(OPERATIONS)
        for number in generator.integers(len(names), size=self.operations):
            operation = OPERATIONS[names[number]]
            strength = operation.strength(self.magnitude / (MAGNITUDE_BINS - 1), *image.shape[:2])
            if operation.signed and generator.integers(2):
                strength = -strength
            image = operation.apply(image, strength)
        return image


def _affine(image: Image, a: float, b: float, c: float, d: float, e: float, f: float) -> Image:
    """Transform as Pillow's AFFINE, BILINEAR: output (x, y) shows input (ax+by+c, dx+ey+f).

    Pixel centres are at half coordinates. Points outside the image are black.
    """
    height, width = image.shape[:2]
    matrix = np.array([[a, b, c + (a + b - 1) / 2], [d, e, f + (d + e - 1) / 2]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    # OpenCV is faster with four channels than with three. A mask makes the outside black, because
    # the constant border mode would blend half a pixel of black into the rim.
    warped = cv2.warpAffine(
        cv2.cvtColor(image, cv2.COLOR_RGB2RGBA),
        matrix,
        (width, height),
        flags=flags,
        borderMode=cv2.BORDER_REPLICATE,
    )
    warped = cv2.cvtColor(warped, cv2.COLOR_RGBA2RGB)
    return cv2.copyTo(warped, _shown(height, width, a, b, c, d, e, f))  # 0 where it does not copy


@functools.lru_cache(maxsize=64)
def _shown(height: int, width: int, *matrix: float) -> UInt8[np.ndarray, "height width"]:
    """Mark with 1 where `_affine` shows a point of the image (cached: there are few matrices)."""
    a, b, c, d, e, f = matrix
    x, y = np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5
    column, row = a * x + (b * y + c), d * x + (e * y + f)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return inside.astype(np.uint8)


def _translate_x(image: Image, pixels: float) -> Image:
    return _translate_y(image.swapaxes(0, 1), pixels).swapaxes(0, 1)


def _translate_y(image: Image, pixels: float) -> Image:
    moved, by = np.zeros_like(image), int(pixels)
    if by < 0:
        moved[:by] = image[-by:]
    else:
        moved[by:] = image[: len(image) - by]
    return moved


def _rotate(image: Image, degrees: float) -> Image:
    """Rotate an image counter-clockwise about its centre."""
    x, y = image.shape[1] / 2, image.shape[0] / 2
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return _affine(
        image, cosine, -sine, x - cosine * x + sine * y, sine, cosine, y - sine * x - cosine * y
    )


def _brightness(image: Image, change: float) -> Image:
    return cv2.LUT(image, _blend(np.uint8(0), _LEVELS, 1 + change))


def _color(image: Image, change: float) -> Image:
    return _blend(cv2.cvtColor(_grey(image), cv2.COLOR_GRAY2RGB), image, 1 + change)


def _contrast(image: Image, change: float) -> Image:
    mean = np.uint8(_grey(image).mean() + 0.5)
    return cv2.LUT(image, _blend(mean, _LEVELS, 1 + change))


def _sharpness(image: Image, change: float) -> Image:
    kernel = np.array([[1, 1, 1], [1, 5, 1], [1, 1, 1]], np.float32)
    sums = cv2.filter2D(image, cv2.CV_16S, kernel)
    smooth = cv2.convertScaleAbs(sums, alpha=1 / 13)  # no ties in rounding: 13 is odd
    # Pillow's 3x3 filters do not change the outermost pixels.
    smooth[[0, -1]] = image[[0, -1]]
    smooth[:, [0, -1]] = image[:, [0, -1]]
    return _blend(smooth, image, 1 + change)


def _posterize(image: Image, bits: float) -> Image:
    return image & np.uint8(256 - 2 ** (8 - int(bits)))


def _solarize(image: Image, threshold: float) -> Image:
    table = np.where(threshold > _LEVELS, _LEVELS, 255 - _LEVELS)
    return cv2.LUT(image, table.astype(np.uint8))


def _autocontrast(image: Image, _: float) -> Image:
    planes = cv2.split(image)  # numpy is slow at extrema along the short last axis
    low = np.array([int(plane.min()) for plane in planes])
    high = np.array([int(plane.max()) for plane in planes])
    scale = 255.0 / np.maximum(high - low, 1)
    table = np.clip(_LEVELS[:, None] * scale - low * scale, 0, 255)
    table = np.where(high > low, table.astype(np.uint8), _LEVELS[:, None].astype(np.uint8))
    return cv2.LUT(image, table[None])


def _equalize(image: Image, _: float) -> Image:
    levels = [cv2.calcHist([image], [channel], None, [256], [0, 256]) for channel in range(3)]
    tables = [_equalizing_table(counts.ravel().astype(np.int64)) for counts in levels]
    return cv2.LUT(image, np.stack(tables, axis=-1)[None])


def _equalizing_table(counts: Int64[np.ndarray, "256"]) -> UInt8[np.ndarray, "256"]:
    step = (counts.sum() - counts[counts > 0][-1]) // 255
    if step == 0:
        return _LEVELS.astype(np.uint8)
    below = np.cumsum(counts) - counts
    return np.minimum((step // 2 + below) // step, 255).astype(np.uint8)


def _grey(image: Image) -> UInt8[np.ndarray, "h w"]:
    return cv2.transform(image.astype(np.float32), _PILLOW_LUMA).astype(np.uint8)


def _blend(
    start: np.ndarray | np.uint8, end: np.ndarray, factor: float
) -> UInt8[np.ndarray, "..."]:
    """Blend `start` (factor 0) with `end` (factor 1, or beyond) in float32, and clip, as Pillow."""
    blended = np.subtract(end, start, dtype=np.float32)
    blended *= np.float32(factor)
    blended += start
    return np.clip(blended, 0, 255, out=blended).astype(np.uint8)


class Operation(NamedTuple):
    """An operation: `apply(image, strength)`; if `signed`, the sign of the strength is random."""

    apply: Callable[[Image, float], Image]
    strength: Callable[[float, int, int], float]
    """Strength as a function of the magnitude (from 0 to 1) and the image's height and width."""
    signed: bool


def _scaled(most: float) -> Callable[[float, int, int], float]:
    return lambda level, height, width: most * level


OPERATIONS: dict[str, Operation] = {
    "Identity": Operation(lambda image, _: image, _scaled(0), signed=False),
    "ShearX": Operation(lambda i, s: _affine(i, 1, s, 0, 0, 1, 0), _scaled(0.3), signed=True),
    "ShearY": Operation(lambda i, s: _affine(i, 1, 0, 0, s, 1, 0), _scaled(0.3), signed=True),
    "TranslateX": Operation(_translate_x, lambda level, _, w: 150 / 331 * w * level, signed=True),
    "TranslateY": Operation(_translate_y, lambda level, h, _: 150 / 331 * h * level, signed=True),
    "Rotate": Operation(_rotate, _scaled(30), signed=True),
    "Brightness": Operation(_brightness, _scaled(0.9), signed=True),
    "Color": Operation(_color, _scaled(0.9), signed=True),
    "Contrast": Operation(_contrast, _scaled(0.9), signed=True),
    "Sharpness": Operation(_sharpness, _scaled(0.9), signed=True),
    "Posterize": Operation(_posterize, lambda level, _h, _w: 8.0 - round(4 * level), signed=False),
    "Solarize": Operation(_solarize, lambda level, _h, _w: 255 * (1 - level), signed=False),
    "AutoContrast": Operation(_autocontrast, _scaled(0), signed=False),
    "Equalize": Operation(_equalize, _scaled(0), signed=False),
}
"""The 14 operations of RandAugment by torchvision's names."""
