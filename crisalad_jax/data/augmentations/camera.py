"""Camera effects: viewpoint, motion blur, occlusion, low resolution, noise and JPEG."""

import math

import cv2
import numpy as np

from crisalad_jax.config.checks import Fraction, NonNegativeFloat, Share
from crisalad_jax.data.augmentations.base import AUGMENTATIONS, Image
from crisalad_jax.data.augmentations.light import LightAugmentConfig

_QUALITY = (12, 85)
"""Lowest and highest JPEG quality."""


@AUGMENTATIONS.register("camera")
class CameraAugmentConfig(LightAugmentConfig):
    """The augmentation "light" with the effects of a cheap camera, which rendered images lack."""

    perspective: Fraction = 0.04
    """Largest shift of an image's corner by a perspective warp, as a fraction of the side."""
    texture: NonNegativeFloat = 0.25
    """Largest relative strength of a random multi-scale texture, which rendered walls lack."""
    filters: Share = 0.3
    """Probability of blending the image with a randomly filtered copy, which changes textures but
    not outlines (Xu et al., ICLR 2021)."""
    occlusion: Share = 0.3
    """Probability that a rectangle or ellipse covers part of the image."""
    motion: Share = 0.2
    """Probability of motion blur over up to a sixteenth of the width."""
    coarse: Share = 0.3
    """Probability of shrinking the image, to two fifths of each side or more, and enlarging it."""
    noise: NonNegativeFloat = 8.0
    """Largest standard deviation of Gaussian noise, in grey levels from 0 to 255."""
    jpeg: Share = 0.4
    """Probability of JPEG compression, at a random quality."""

    def apply(
        self, image: Image, generator: np.random.Generator, *, of_place: np.random.Generator
    ) -> Image:
        """Return the changed image; all images of a place in a batch are mirrored together."""
        if self.flip > 0 and of_place.random() < self.flip:
            image = cv2.flip(image, 1)
        if self.perspective > 0:
            image = _moved(image, self.perspective, generator)
        if self.texture > 0:
            image = _textured(image, generator.uniform(0, self.texture), generator)
        if generator.random() < self.filters:
            image = _filtered(image, generator)
        image = self.change_light(image, generator)
        changes = (self.occlusion, _covered), (self.motion, _smeared), (self.coarse, _coarsened)
        for probability, change in changes:
            if generator.random() < probability:
                image = change(image, generator)
        if self.noise > 0:
            deviation = generator.uniform(0, self.noise)
            noise = deviation * generator.standard_normal(image.shape, np.float32)
            image = np.clip(np.round(image + noise), 0, 255).astype(np.uint8)
        if generator.random() < self.jpeg:
            quality = (cv2.IMWRITE_JPEG_QUALITY, int(generator.integers(*_QUALITY)))
            data = cv2.imencode(".jpg", image, quality)[1]
            image = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))
        return image


def _moved(image: Image, most: float, generator: np.random.Generator) -> Image:
    """Shift the corners a little, like a change of viewpoint."""
    height, width = image.shape[:2]
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    shifts = generator.uniform(-most, most, (4, 2)) * (width, height)
    matrix = cv2.getPerspectiveTransform(corners, (corners + shifts).astype(np.float32))
    return cv2.warpPerspective(
        image, matrix, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )


def _textured(image: Image, deviation: float, generator: np.random.Generator) -> Image:
    """Multiply by smooth noise of four scales."""
    height, width = image.shape[:2]
    field = np.zeros((height, width), np.float32)
    for scale in (1, 2, 4, 8):
        size = (height // scale + 1, width // scale + 1)
        coarse = generator.standard_normal(size, np.float32)
        field += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    changed = image * (1 + 0.5 * deviation * field[..., None])
    return np.clip(np.round(changed), 0, 255).astype(np.uint8)


def _filtered(image: Image, generator: np.random.Generator) -> Image:
    """Blend the image with a randomly filtered copy of the same mean and standard deviation."""
    side = int(generator.choice((1, 3, 5)))
    weights = generator.standard_normal((3, 3, side, side), np.float32)
    pixels = image.astype(np.float32)
    found = np.stack(
        [sum(cv2.filter2D(pixels[..., i], -1, each[i]) for i in range(3)) for each in weights],
        axis=-1,
    )
    found = (found - found.mean()) / (found.std() + 1e-3) * pixels.std() + pixels.mean()
    share = generator.uniform(0, 1)
    return np.clip(np.round(share * found + (1 - share) * pixels), 0, 255).astype(np.uint8)


def _covered(image: Image, generator: np.random.Generator) -> Image:
    """Cover a rectangle or an ellipse with one colour."""
    image = image.copy()
    height, width = image.shape[:2]
    size = (generator.uniform(0.05, 0.4, 2) * (width, height)).astype(int)
    corner = (generator.uniform(-0.1, 0.9, 2) * (width, height)).astype(int)
    colour = generator.uniform(0, 255, 3).tolist()
    if generator.random() < 0.5:
        cv2.rectangle(image, corner.tolist(), (corner + size).tolist(), colour, -1)
    else:
        centre, axes = (corner + size // 2).tolist(), (size // 2 + 1).tolist()
        cv2.ellipse(image, centre, axes, 0, 0, 360, colour, -1)
    return image


def _smeared(image: Image, generator: np.random.Generator) -> Image:
    """Blur along a line, usually a nearly horizontal one."""
    length = int(generator.integers(2, max(3, image.shape[1] // 16 + 1)))
    angle = generator.normal(0, 0.4)
    kernel = np.zeros((2 * length + 1, 2 * length + 1), np.float32)
    reach = length * np.array((math.cos(angle), math.sin(angle)))
    ends = np.round(length + np.array((-reach, reach)) / 2).astype(int).tolist()
    cv2.line(kernel, ends[0], ends[1], 1.0)
    return cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT)


def _coarsened(image: Image, generator: np.random.Generator) -> Image:
    """Shrink the image, and enlarge it again."""
    height, width = image.shape[:2]
    share = generator.uniform(0.4, 0.9)
    size = (max(2, round(share * width)), max(2, round(share * height)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    how = cv2.INTER_LINEAR if generator.random() < 0.7 else cv2.INTER_CUBIC
    return cv2.resize(small, (width, height), interpolation=how)
