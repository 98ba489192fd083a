"""CosPlace's and EigenPlaces' augmentation: colour jitter, then a crop (Berton et al. 2022).

It follows torchvision's `ColorJitter` and `RandomResizedCrop` on tensors from 0 to 1, and rounds to
8 bits at the end.
"""

import math
from typing import Annotated

import cv2
import numpy as np

from crisalad_jax.config.checks import Fraction, NonNegativeFloat, limited
from crisalad_jax.data.augmentations.base import AUGMENTATIONS, Augmentation, Image
from crisalad_jax.data.resize import resize_image
from crisalad_jax.utils.shapes import Float32

_LUMA = np.array([0.2989, 0.587, 0.114], np.float32)
"""Torchvision's weights for grey."""
_ASPECTS = (3 / 4, 4 / 3)
"""Smallest and largest aspect ratio of a crop."""
_TRIES = 10
"""Number of random crops to try before using the largest central one."""
_Floats = Float32[np.ndarray, "h w 3"]


@AUGMENTATIONS.register("colour-crop")
class ColourCropConfig(Augmentation):
    """Colour jitter in random order, then a crop resized to the image's size (CosPlace)."""

    brightness: NonNegativeFloat = 0.7
    """Largest relative change of brightness."""
    contrast: NonNegativeFloat = 0.7
    """Largest relative change of contrast."""
    saturation: NonNegativeFloat = 0.7
    """Largest relative change of saturation."""
    hue: Annotated[float, limited(0, 0.5)] = 0.5
    """Largest shift of the hue, as a fraction of the colour circle."""
    crop: Fraction = 0.5
    """Largest fraction of the area that a crop removes."""

    def apply(
        self, image: Image, generator: np.random.Generator, *, of_place: np.random.Generator
    ) -> Image:
        """Return the image with changed colours, cropped and resized to its former size."""
        pixels = image.astype(np.float32) / 255
        strengths = [
            generator.uniform(max(0.0, 1 - each), 1 + each)
            for each in (self.brightness, self.contrast, self.saturation)
        ]
        turn = generator.uniform(-self.hue, self.hue)
        for number in generator.permutation(4):
            if number == 3:
                pixels = _turned(pixels, turn)
                continue
            grey = (pixels @ _LUMA)[..., None]
            other = (0.0, float(grey.mean()), grey)[number]
            mixed = strengths[number] * pixels + (1 - strengths[number]) * other
            pixels = np.clip(mixed, 0, 1).astype(np.float32)
        top, left, height, width = _crop(image.shape[0], image.shape[1], self.crop, generator)
        part = np.ascontiguousarray(pixels[top : top + height, left : left + width])
        resized = resize_image(part, image.shape[:2], pixels="floats")
        return np.clip(np.round(255 * resized), 0, 255).astype(np.uint8)


def _turned(pixels: _Floats, turn: float) -> _Floats:
    """Turn the hue of every pixel by a fraction of the circle."""
    hsv = cv2.cvtColor(pixels, cv2.COLOR_RGB2HSV)
    hsv[..., 0] = (hsv[..., 0] + 360 * turn) % 360
    return np.clip(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), 0, 1)


def _crop(
    height: int, width: int, removed: float, generator: np.random.Generator
) -> tuple[int, int, int, int]:
    """Draw a crop by its area and aspect ratio, and return its top, left, height and width."""
    least, most = _ASPECTS
    for _ in range(_TRIES):
        area = height * width * generator.uniform(1 - removed, 1)
        aspect = math.exp(generator.uniform(math.log(least), math.log(most)))
        across, down = round(math.sqrt(area * aspect)), round(math.sqrt(area / aspect))
        if 0 < across <= width and 0 < down <= height:
            top = int(generator.integers(height - down + 1))
            return top, int(generator.integers(width - across + 1)), down, across
    aspect = min(max(width / height, least), most)
    across, down = min(width, round(height * aspect)), min(height, round(width / aspect))
    return (height - down) // 2, (width - across) // 2, down, across
