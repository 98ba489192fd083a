"""Augmentations: random changes of training images, and the interface of a new one."""

import abc
import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

from crisalad_jax.config.checks import require_fraction, require_range
from crisalad_jax.config.part import Part
from crisalad_jax.config.registry import Registry, count_arguments
from crisalad_jax.utils.shapes import UInt8

Image = UInt8[np.ndarray, "h w 3"]
_CHECK = "check"
"""Key of a field's check in its metadata."""
_Number = TypeVar("_Number", int, float)


def from_zero(default: _Number, most: float = math.inf) -> _Number:
    """Return a field of an augmentation whose value is from 0 to `most`."""
    return _checked(default, lambda config, name: require_range(config, 0, most, name))


def fraction(default: float) -> float:
    """Return a field of an augmentation whose value is at least 0 and less than 1."""
    return _checked(default, require_fraction)


def _checked(default: Any, check: Callable[[object, str], None]) -> Any:
    return dataclasses.field(default=default, metadata={_CHECK: check})


class Augmentation(Part, abc.ABC):
    """A random change of training images: a frozen dataclass whose fields are its strengths.

    A plain function of (image, generator) is an augmentation without settings.

    Example:
        >>> from crisalad_jax import TrainConfig, register_augmentation
        >>> @register_augmentation("mirrored")
        ... def mirrored(image, generator):
        ...     return image[:, ::-1] if generator.random() < 0.5 else image
        >>> TrainConfig(augmentation="mirrored").augmentation.part_name
        'mirrored'
    """

    def __post_init__(self) -> None:
        """Check the fields that `from_zero` and `fraction` made."""
        for field in dataclasses.fields(self):
            if check := field.metadata.get(_CHECK):
                check(self, field.name)

    @abc.abstractmethod
    def apply(
        self, image: Image, generator: np.random.Generator, *, of_place: np.random.Generator
    ) -> Image:
        """Return the changed image, of the same size.

        Args:
            image: 8-bit RGB, of the model's size. Do not write to it; it may be returned.
            generator: draws for this image alone.
            of_place: draws the same for all images of one place in a batch.
        """


def _of_function(function: Callable[..., Any]) -> Mapping[str, Any]:
    """Return the methods of an augmentation that is a plain function."""
    count = count_arguments(function, "image", "generator")

    def apply(_: Augmentation, image: Image, generator: np.random.Generator, **__: Any) -> Image:
        return function(*(image, generator)[:count])

    return {"apply": apply}


AUGMENTATIONS = Registry("augmentation", Augmentation, of_function=_of_function)


@AUGMENTATIONS.register("none")
class NoAugmentation(Augmentation):
    """Leave images as they are."""

    def apply(
        self, image: Image, generator: np.random.Generator, *, of_place: np.random.Generator
    ) -> Image:
        """Return the image itself."""
        return image
