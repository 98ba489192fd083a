"""Augmentations: random changes of training images, and the interface for custom ones."""

import abc

import numpy as np

from crisalad_jax.config.part import Part
from crisalad_jax.config.registry import Registry, with_arguments
from crisalad_jax.utils.shapes import UInt8

Image = UInt8[np.ndarray, "h w 3"]


class Augmentation(Part, abc.ABC):
    """A random change of training images: a frozen dataclass whose fields are its settings.

    A plain function of (image, generator) can be registered as an augmentation without settings.

    Example:
        >>> from crisalad_jax import TrainConfig, register_augmentation
        >>> @register_augmentation("mirrored")
        ... def mirrored(image, generator):
        ...     return image[:, ::-1] if generator.random() < 0.5 else image
        >>> TrainConfig(augmentation="mirrored").augmentation.part_name
        'mirrored'
    """

    @abc.abstractmethod
    def apply(
        self, image: Image, generator: np.random.Generator, *, of_place: np.random.Generator
    ) -> Image:
        """Return the changed image, as 8-bit RGB of the same size.

        Args:
            image: 8-bit RGB of the model's image size. It is read-only, and may be returned as is.
            generator: random generator for this image only.
            of_place: random generator with the same draws for all images of a place in a batch.
        """


AUGMENTATIONS = Registry(
    "augmentation", Augmentation, of_function=with_arguments("image", "generator")
)


@AUGMENTATIONS.register("none")
class NoAugmentation(Augmentation):
    """No augmentation: images stay as they are."""

    def apply(
        self, image: Image, generator: np.random.Generator, *, of_place: np.random.Generator
    ) -> Image:
        """Return the image itself."""
        return image
