"""SIFT and ORB in the place of a network's patches, for heads that count words.

Photographs are turned into features on the host (`data.local_features`); here the bytes of these
become vectors. Where an image has fewer features, its last patches are 0.
"""

import abc
import dataclasses
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from crisalad_jax.config.checks import PositiveInt, require
from crisalad_jax.config.preprocessing import FEATURE_BYTES, LocalFeatures
from crisalad_jax.nn.backbones.base import BACKBONES, Features, FeatureSpec, Grid, Pixels, Valid
from crisalad_jax.nn.backbones.handmade import HandmadeBackbone


@dataclasses.dataclass(frozen=True)
class _LocalFeatureBackbone(HandmadeBackbone):
    """Local features of OpenCV: no parameters, and no class token."""

    any_size: ClassVar[bool] = True
    class_token: ClassVar[bool] = False
    exposes_levels: ClassVar[bool] = False
    local_features: ClassVar[LocalFeatures]
    count: PositiveInt = 500
    """Number of features of an image, at most: the strongest."""

    @property
    def encoded_size(self) -> tuple[int, int]:
        """Height and width of the bytes of an image's features."""
        return self.count, FEATURE_BYTES[self.local_features] // 3

    def grid(self, image_size: tuple[int, int]) -> Grid:
        """Return one row of features, whatever the size of a photograph."""
        return 1, self.count

    @abc.abstractmethod
    def vectors(
        self, numbers: Float[Array, "image feature byte"]
    ) -> Float[Array, "image feature dim"]:
        """Return unit vectors of the bytes of descriptors."""

    def apply(
        self, params: None, images: Pixels, request: FeatureSpec, *, remat: str, valid: Valid
    ) -> tuple[Features, None]:
        """Return the features as patches, strongest first, and 0 where there are no more.

        Raises:
            InputError: while tracing, for pixels in the place of features.
        """
        require(
            tuple(images.shape[1:3]) == self.encoded_size,
            f"images: found {images.shape[1]} x {images.shape[2]} pixels, expected the "
            f"{self.count} features of backbone {self.part_name}, as `prepare_image` finds them",
        )
        rows = jnp.round(images.astype(jnp.float32)).reshape(len(images), self.count, -1)
        patches = jnp.where(rows[..., -1:] > 0, self.vectors(rows[..., :-1]), 0)
        patches = patches.astype(images.dtype)
        return Features(patches[:, 0, :0], patches), None


@BACKBONES.register("sift")
class SiftConfig(_LocalFeatureBackbone):
    """SIFT (Lowe, IJCV 2004) by OpenCV, as RootSIFT (Arandjelovic and Zisserman, CVPR 2012).

    The roots of a descriptor's shares of its sum, so that products of vectors are Hellinger's
    kernel of histograms. Images are bytes, with a mean of 0 and a deviation of 1/255.
    """

    local_features: ClassVar[LocalFeatures] = "sift"
    dim: int = 128

    def vectors(
        self, numbers: Float[Array, "image feature 128"]
    ) -> Float[Array, "image feature 128"]:
        """Return the roots of shares."""
        return jnp.sqrt(numbers / jnp.maximum(numbers.sum(axis=-1, keepdims=True), 1))


@BACKBONES.register("orb")
class OrbConfig(_LocalFeatureBackbone):
    """ORB (Rublee et al., ICCV 2011) by OpenCV.

    Its 256 bits become -1/16 or 1/16, so that the nearest vector is the one with the most bits in
    common. Images are bytes, with a mean of 0 and a deviation of 1/255.
    """

    local_features: ClassVar[LocalFeatures] = "orb"
    binary: ClassVar[bool] = True
    dim: int = 256

    def vectors(
        self, numbers: Float[Array, "image feature 32"]
    ) -> Float[Array, "image feature 256"]:
        """Return the bits, the highest of each byte first."""
        bits = numbers.astype(jnp.int32)[..., None] >> jnp.arange(7, -1, -1) & 1
        return (2 * bits.reshape(*numbers.shape[:-1], -1) - 1) / 16
