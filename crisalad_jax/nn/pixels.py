"""From 8-bit pixels to a backbone's input, on the device: images travel as bytes."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from crisalad_jax.config import choose

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_DEVIATION = (0.229, 0.224, 0.225)
LOCAL_WINDOW = 21
"""Side in pixels of the box of local contrast normalisation: one and a half patches."""
LOCAL_NOISE = 0.02
"""About the noise of a night photograph, of full scale: flat sky is not blown up."""


def normalise(image: UInt8[Array, "height width 3"], how: str) -> Float[Array, "height width 3"]:
    """Normalise one RGB image.

    "imagenet" subtracts ImageNet's mean and divides by its deviation (what DINOv2 expects);
    "local-contrast" does so with every pixel's own 21 x 21 neighbourhood, for small models that
    start from nothing and cannot first learn to ignore the light.

    Raises:
        InputError: no such normalisation.
    """
    ways = {"imagenet": _imagenet, "local-contrast": _local_contrast}
    # JAX's own type of real numbers: float32, and float64 in its 64-bit mode.
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
    """(side, side) averaging matrix; at the border the mean is of what is left of the box."""
    near = np.abs(np.arange(side)[:, None] - np.arange(side)) <= LOCAL_WINDOW // 2
    return near / near.sum(axis=1, keepdims=True)
