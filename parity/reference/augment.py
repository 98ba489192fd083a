"""RandAugment on Pillow images: torchvision's operations (Cubuk et al., CVPR Workshops 2020)."""

import random
from collections.abc import Callable, Mapping
from typing import NamedTuple

from PIL import Image, ImageEnhance, ImageOps

BINS = 31


def _affine(image: Image.Image, matrix: tuple[float, ...]) -> Image.Image:
    return image.transform(image.size, Image.Transform.AFFINE, matrix, Image.Resampling.BILINEAR)


OPERATIONS: Mapping[str, Callable[[Image.Image, float], Image.Image]] = {
    "Identity": lambda image, s: image,
    "ShearX": lambda image, s: _affine(image, (1, s, 0, 0, 1, 0)),
    "ShearY": lambda image, s: _affine(image, (1, 0, 0, s, 1, 0)),
    "TranslateX": lambda image, s: _affine(image, (1, 0, -int(s), 0, 1, 0)),
    "TranslateY": lambda image, s: _affine(image, (1, 0, 0, 0, 1, -int(s))),
    "Rotate": lambda image, s: image.rotate(s, Image.Resampling.BILINEAR),
    "Brightness": lambda image, s: ImageEnhance.Brightness(image).enhance(1 + s),
    "Color": lambda image, s: ImageEnhance.Color(image).enhance(1 + s),
    "Contrast": lambda image, s: ImageEnhance.Contrast(image).enhance(1 + s),
    "Sharpness": lambda image, s: ImageEnhance.Sharpness(image).enhance(1 + s),
    "Posterize": lambda image, s: ImageOps.posterize(image, int(s)),
    "Solarize": lambda image, s: ImageOps.solarize(image, s),
    "AutoContrast": lambda image, s: ImageOps.autocontrast(image),
    "Equalize": lambda image, s: ImageOps.equalize(image),
}
"""Functions of an image and a strength, by torchvision's names."""


class Strength(NamedTuple):
    """The strength of an operation."""

    value: float
    signed: bool = False


def strengths(magnitude: int, width: int, height: int) -> dict[str, Strength]:
    """Return the strengths of all operations at a magnitude of `BINS`, from torchvision's table."""
    level = magnitude / (BINS - 1)
    enhancement = Strength(0.9 * level, signed=True)
    return {
        "Identity": Strength(0.0),
        "ShearX": Strength(0.3 * level, signed=True),
        "ShearY": Strength(0.3 * level, signed=True),
        "TranslateX": Strength(150 / 331 * width * level, signed=True),
        "TranslateY": Strength(150 / 331 * height * level, signed=True),
        "Rotate": Strength(30 * level, signed=True),
        **dict.fromkeys(("Brightness", "Color", "Contrast", "Sharpness"), enhancement),
        "Posterize": Strength(8 - round(magnitude / ((BINS - 1) / 4))),
        "Solarize": Strength(255 * (1 - level)),
        "AutoContrast": Strength(0.0),
        "Equalize": Strength(0.0),
    }


def rand_augment(
    image: Image.Image, operations: int, magnitude: int, generator: random.Random
) -> Image.Image:
    """Apply operations drawn uniformly with replacement, each with a random sign."""
    table = strengths(magnitude, *image.size)
    for _ in range(operations):
        name = generator.choice(list(OPERATIONS))
        strength = table[name]
        sign = generator.choice((1, -1)) if strength.signed else 1
        image = OPERATIONS[name](image, sign * strength.value)
    return image
