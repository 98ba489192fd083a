"""The augmentation "light", for training from scratch on images of fixed cameras."""

import math

import cv2
import numpy as np

from crisalad_jax.config.checks import Fraction, NonNegativeFloat, Share
from crisalad_jax.data.augmentations.base import AUGMENTATIONS, Augmentation, Image

# ITU-R BT.601 luma.
_LUMA = np.array([0.299, 0.587, 0.114])


@AUGMENTATIONS.register("light")
class LightAugmentConfig(Augmentation):
    """A small warp and mild light changes, for training from scratch on images of fixed cameras."""

    crop: Fraction = 0.1
    """Largest fraction of each side that a crop removes."""
    shift: Fraction = 0.05
    """Largest shift, as a fraction of the side."""
    rotation: NonNegativeFloat = 2.0
    """Largest rotation in degrees."""
    flip: Share = 0.0
    """Probability of mirroring. All images of one place in a batch are mirrored together."""
    blur: NonNegativeFloat = 1.0
    """Largest standard deviation of a Gaussian blur, in pixels."""
    colour: Fraction = 0.2
    """Largest relative change of brightness, of contrast and of saturation."""
    grey: Share = 0.2
    """Probability of turning the image grey."""
    gamma: NonNegativeFloat = 0.0
    """Largest change of the logarithm of gamma, the exponent of pixel intensities."""
    illumination: NonNegativeFloat = 0.0
    """Largest change of log brightness by a smooth random field that imitates uneven light."""

    def apply(
        self, image: Image, generator: np.random.Generator, *, of_place: np.random.Generator
    ) -> Image:
        """Return the changed image; all images of a place in a batch are mirrored together."""
        if self.flip > 0 and of_place.random() < self.flip:
            image = cv2.flip(image, 1)
        return self.change_light(image, generator)

    def change_light(self, image: Image, generator: np.random.Generator) -> Image:
        """Return a slightly warped and blurred image with changed light, contrast and colour.

        Every call draws the same number of random values, whatever the settings.
        """
        height, width = image.shape[:2]
        scale = generator.uniform(1 - self.crop, 1)
        shift = generator.uniform(-self.shift, self.shift, size=2) * (width, height)
        angle = math.radians(generator.uniform(-self.rotation, self.rotation))
        sigma = generator.uniform(0, self.blur)
        brightness, contrast, saturation = generator.uniform(1 - self.colour, 1 + self.colour, 3)
        if generator.random() < self.grey:
            saturation = 0.0
        exponent = math.exp(generator.uniform(-self.gamma, self.gamma))
        light = generator.uniform(-self.illumination, self.illumination, (3, 3))

        turn = scale * np.array(
            [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        )
        centre = np.array([width - 1, height - 1]) / 2
        matrix = np.column_stack([turn, centre + shift - turn @ centre])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        image = cv2.warpAffine(
            image, matrix, (width, height), flags=flags, borderMode=cv2.BORDER_REFLECT
        )
        if sigma > 0:
            image = cv2.GaussianBlur(image, (0, 0), sigma)
        if exponent != 1:
            levels = np.arange(256) / 255
            image = cv2.LUT(image, np.round(255 * levels**exponent).astype(np.uint8))
        if light.any():
            field = cv2.resize(light, (width, height), interpolation=cv2.INTER_CUBIC)
            image = np.clip(np.exp(field)[..., None] * image, 0, 255).round().astype(np.uint8)
        # The three factors are one affine map of the colours: brightness scales, contrast stretches
        # about the mean luma, saturation stretches about each pixel's luma.
        colour = saturation * np.eye(3) + (1 - saturation) * _LUMA
        offset = (1 - contrast) * brightness * (_LUMA @ cv2.mean(image)[:3])
        matrix = np.column_stack([brightness * contrast * colour, np.full(3, offset)])
        return cv2.transform(image, matrix)
