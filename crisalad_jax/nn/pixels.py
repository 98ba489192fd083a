"""Normalise 8-bit pixels on the device, so that images are transferred as bytes."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from crisalad_jax.config.checks import choose

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_DEVIATION = (0.229, 0.224, 0.225)
LOCAL_WINDOW = 21
"""Side in pixels of the box of local contrast normalisation: one and a half patches."""
LOCAL_NOISE = 0.02
"""Smallest deviation, as a share of full scale: a night photograph's noise, not to be amplified."""


def normalise(image: UInt8[Array, "height width 3"], how: str) -> Float[Array, "height width 3"]:
    """Normalise one RGB image.

    "imagenet" subtracts ImageNet's mean and divides by its deviation, as DINOv2 expects.
    "local-contrast" uses the mean and deviation of each pixel's 21 x 21 neighbourhood. It is for
    small models trained from scratch, which would have to learn to ignore the light.

    Raises:
        InputError: no such normalisation.
    """
    ways = {"imagenet": _imagenet, "local-contrast": _local_contrast}
    # JAX's default float type: float32, and float64 in its 64-bit mode.
    return choose("normalisation", how, ways)(image.astype(float) / 255)


def _imagenet(image: Float[Array, "height width 3"]) -> Float[Array, "height width 3"]:
    return (image - jnp.array(IMAGENET_MEAN)) / jnp.array(IMAGENET_DEVIATION)


def _local_contrast(image: Float[Array, "height width 3"]) -> Float[Array, "height width 3"]:
    height, width, _ = image.shape
    rows, columns = jnp.asarray(_box(height)), jnp.asarray(_box(width))

    def box_mean(x: Float[Array, "height width 3"]) -> Float[Array, "height width 3"]:
        return jnp.einsum("ri,cj,ijk->rck", rows, columns, x, precision="highest")

    centred = image - box_mean(image)
    return centred / jnp.sqrt(box_mean(centred**2) + LOCAL_NOISE**2)


def _box(side: int) -> np.ndarray:
    """Make a (side, side) averaging matrix; at the border it averages the box's inside part."""
    near = np.abs(np.arange(side)[:, None] - np.arange(side)) <= LOCAL_WINDOW // 2
    return near / near.sum(axis=1, keepdims=True)
