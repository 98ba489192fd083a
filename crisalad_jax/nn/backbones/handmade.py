"""Backbones without training: hand-crafted features of a fixed width."""

import abc
import dataclasses
from typing import ClassVar

from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import require, require_range
from crisalad_jax.nn.backbones.base import Backbone, Features, FeatureSpec, Grid, Pixels, Valid


@dataclasses.dataclass(frozen=True)
class HandmadeBackbone(Backbone):
    """A backbone without parameters, whose width is fixed by its class."""

    depth: int = 1

    def __post_init__(self) -> None:
        """Check that `dim` and `depth` have their only valid values."""
        width = type(self).dim
        require_range(self, width, width, "dim")
        require_range(self, 1, 1, "depth")

    def init(self, key: PRNGKeyArray) -> None:
        """Return None: there are no parameters."""


class WholeImageBackbone(HandmadeBackbone):
    """Base class of whole-image descriptors, for images of one size."""

    size: ClassVar[tuple[int, int]]
    """Height and width in pixels that images must have."""

    def grid(self, image_size: tuple[int, int]) -> Grid:
        """Return 1 x 1: the image is one patch. Raise InputError for any size but `size`."""
        found, expected = (f"{height} x {width}" for height, width in (image_size, self.size))
        require(
            found == expected,
            f"image size: found {found}, expected {expected} for backbone {self.part_name}",
        )
        return 1, 1

    @abc.abstractmethod
    def descriptors(self, images: Pixels) -> Float[Array, "image dim"]:
        """Return a descriptor, not necessarily of unit length, for each image of size `size`."""

    def apply(
        self, params: None, images: Pixels, request: FeatureSpec, *, remat: str, valid: Valid
    ) -> tuple[Features, None]:
        """Return the descriptor as both the class token and the only patch."""
        descriptors = self.descriptors(images)
        return Features(descriptors, descriptors[:, None]), None
