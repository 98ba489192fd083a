"""Small grey images, normalised patch by patch, as in SeqSLAM (Milford and Wyeth 2012)."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from crisalad_jax.nn.backbones.base import BACKBONES, Pixels
from crisalad_jax.nn.backbones.handmade import WholeImageBackbone

_SIZE = 32, 64
_PATCH = 8
_DIM = _SIZE[0] * _SIZE[1]
_GREY = (0.299, 0.587, 0.114)
"""Weights of red, green and blue, from BT.601."""
_LEAST = 0.5
"""Minimum deviation, half a grey level, so that rounding in a uniform patch isn't amplified."""


@BACKBONES.register("thumbnail")
class ThumbnailConfig(WholeImageBackbone):
    """SeqSLAM's images of 32 x 64 grey pixels (Milford and Wyeth, ICRA 2012).

    Each patch of 8 x 8 is normalised by its mean and standard deviation. If all patches are
    uniform, all entries of the descriptor are equal. There are no parameters; the descriptor is the
    class token. Preprocessing must leave pixels at 0 to 255: mean 0 and deviation 1/255.
    """

    dim: int = _DIM
    patch_size: ClassVar[int] = _PATCH
    size: ClassVar[tuple[int, int]] = _SIZE

    def descriptors(self, images: Pixels) -> Float[Array, "image dim"]:
        """Return a descriptor, not of unit length, for each image of height and width `size`."""
        grey = (images.astype(jnp.float32) * jnp.array(_GREY, jnp.float32)).sum(axis=-1)
        patches = grey.reshape(-1, _SIZE[0] // _PATCH, _PATCH, _SIZE[1] // _PATCH, _PATCH)
        centred = patches - patches.mean(axis=(2, 4), keepdims=True)
        deviation = jnp.sqrt(jnp.square(centred).mean(axis=(2, 4), keepdims=True))
        normalised = (centred / jnp.maximum(deviation, _LEAST)).reshape(-1, _DIM)
        is_flat = ~(deviation > _LEAST).any(axis=(1, 2, 3, 4))[:, None]
        return jnp.where(is_flat, 1, normalised)
