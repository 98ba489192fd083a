"""SIFT and ORB features in place of a network's patches, for heads that use visual words.

The host extracts the features from photographs (`data.local_features`); here their bytes become
vectors. If an image has fewer than `count` features, its last patches are 0.
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
    """Local features by OpenCV, without parameters or a class token."""

    any_size: ClassVar[bool] = True
    class_token: ClassVar[bool] = False
    exposes_levels: ClassVar[bool] = False
    local_features: ClassVar[LocalFeatures]
    count: PositiveInt = 500
    """Maximum number of features per image; if there are more, the strongest are used."""

    @property
    def encoded_size(self) -> tuple[int, int]:
        """Height and width of the byte array of an image's features."""
        return self.count, FEATURE_BYTES[self.local_features] // 3

    def grid(self, image_size: tuple[int, int]) -> Grid:
        """Return 1 x `count`: one row of features, whatever the size of the photograph."""
        return 1, self.count

    @abc.abstractmethod
    def vectors(
        self, numbers: Float[Array, "image feature byte"]
    ) -> Float[Array, "image feature dim"]:
        """Convert the bytes of descriptors to unit vectors."""

    def apply(
        self, params: None, images: Pixels, request: FeatureSpec, *, remat: str, valid: Valid
    ) -> tuple[Features, None]:
        """Return the features as patches, strongest first, padded with zeros.

        Raises:
            InputError: during tracing, if `images` are pixels instead of features.
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

    Descriptors are divided by their sums, and square roots are taken: inner products are then the
    Hellinger kernel of histograms. Preprocessing must use "bytes", mean 0 and deviation 1/255.
    """

    local_features: ClassVar[LocalFeatures] = "sift"
    dim: int = 128

    def vectors(
        self, numbers: Float[Array, "image feature 128"]
    ) -> Float[Array, "image feature 128"]:
        """Divide each descriptor by its sum, and return the square roots: unit vectors."""
        return jnp.sqrt(numbers / jnp.maximum(numbers.sum(axis=-1, keepdims=True), 1))


@BACKBONES.register("orb")
class OrbConfig(_LocalFeatureBackbone):
    """ORB (Rublee et al., ICCV 2011) by OpenCV.

    Its 256 bits become -1/16 or 1/16, so that the nearest vector is the one with the most bits in
    common. Preprocessing must use "bytes", mean 0 and deviation 1/255.
    """

    local_features: ClassVar[LocalFeatures] = "orb"
    binary: ClassVar[bool] = True
    dim: int = 256

    def vectors(
        self, numbers: Float[Array, "image feature 32"]
    ) -> Float[Array, "image feature 256"]:
        """Return the bits as -1/16 or 1/16, the highest of each byte first."""
        bits = numbers.astype(jnp.int32)[..., None] >> jnp.arange(7, -1, -1) & 1
        return (2 * bits.reshape(*numbers.shape[:-1], -1) - 1) / 16
