"""Histograms of oriented gradients (Dalal and Triggs, CVPR 2005), a baseline without learning."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from crisalad_jax.nn.backbones.base import BACKBONES, Pixels
from crisalad_jax.nn.backbones.handmade import WholeImageBackbone

_SIDE = 128
_CELL = 8
_CELLS = _SIDE // _CELL
_BINS = 9
_DIM = (_CELLS - 1) ** 2 * 4 * _BINS
_GREY = (9798, 19235, 3735)
"""Weights of red, green and blue, times 2^15, with which OpenCV converts to grey (BT.601)."""


@BACKBONES.register("hog")
class HogConfig(WholeImageBackbone):
    """Histograms of oriented gradients of 128 x 128 pixels (Dalal and Triggs, CVPR 2005).

    Sobel gradients of the grey image vote for the two nearest of 9 bins of unsigned angles, with
    linear weights. Cells have 8 x 8 pixels. Blocks of 2 x 2 cells, one cell apart, are divided by
    their L2 norms. In a uniform image, all entries are equal. The descriptor is the class token;
    there are no parameters. Preprocessing must leave pixels at 0 to 255: mean 0, deviation 1/255.
    """

    dim: int = _DIM
    patch_size: ClassVar[int] = _SIDE
    size: ClassVar[tuple[int, int]] = _SIDE, _SIDE

    def descriptors(self, images: Pixels) -> Float[Array, "image dim"]:
        """Return a descriptor, not of unit length, for each image of height and width `size`."""
        pixels = jnp.round(images.astype(jnp.float32)).astype(jnp.int32)
        grey = (pixels * jnp.array(_GREY, jnp.int32)).sum(axis=-1) + (1 << 14) >> 15
        padded = jnp.pad(grey.astype(jnp.float32), ((0, 0), (1, 1), (1, 1)), mode="reflect")
        rows = padded[:, :-2] + 2 * padded[:, 1:-1] + padded[:, 2:]
        columns = padded[..., :-2] + 2 * padded[..., 1:-1] + padded[..., 2:]
        across, down = rows[..., 2:] - rows[..., :-2], columns[:, 2:] - columns[:, :-2]

        # In bins, from the centre of the first: each of the two nearest gets 1 minus its distance.
        angle = jnp.arctan2(down, across) % jnp.pi * (_BINS / jnp.pi) - 0.5
        away = jnp.abs(angle[..., None] - jnp.arange(_BINS, dtype=jnp.float32))
        shares = jnp.maximum(0, 1 - jnp.minimum(away, _BINS - away))
        votes = jnp.sqrt(across**2 + down**2)[..., None] * shares
        cells = votes.reshape(-1, _CELLS, _CELL, _CELLS, _CELL, _BINS).sum(axis=(2, 4))

        corners = (cells[:, i : i + _CELLS - 1, j : j + _CELLS - 1] for i in (0, 1) for j in (0, 1))
        blocks = jnp.concatenate(list(corners), axis=-1)
        norms = jnp.linalg.norm(blocks, axis=-1, keepdims=True)
        blocks = jnp.where(norms > 0, blocks / jnp.where(norms > 0, norms, 1), 0)
        descriptors = blocks.reshape(-1, _DIM)
        is_flat = ~descriptors.any(axis=-1, keepdims=True)
        return jnp.where(is_flat, 1, descriptors)
