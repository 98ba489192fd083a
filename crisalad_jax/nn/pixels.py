"""Normalise 8-bit pixels on the device, so that images are transferred as bytes."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, UInt8

from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.utils.errors import InputError

LOCAL_WINDOW = 21
"""Side in pixels of the box of local contrast normalisation: one and a half patches."""
LOCAL_NOISE = 0.02
"""Smallest standard deviation, for pixels from 0 to 1, so that noise at night is not amplified."""

_BYTES_FROM = 30.0
"""Values above this are pixels from 0 to 255. ImageNet's normalisation gives at most 2.7, and that
by local contrast at most 21, the square root of its window's size. Other means and deviations may
give more."""
_OVERSHOOT = 1.5
"""Range of a bicubic filter's output on float pixels with a range of 1."""
_SPREAD = 0.5
"""Minimum range of pixels from 0 to 1. Normalised images within 0 to 1 are nearly uniform."""


def check_pixels(images: Any, how: PreprocessingConfig = PreprocessingConfig()) -> None:
    """Check that images are an array, and that floats are normalised, not plain pixels.

    Values that are traced, or held by other processes, are unknown and pass.

    Args:
        images: 8-bit pixels, or floats.
        how: the preprocessing that normalised floats have had.

    Raises:
        InputError: `images` are not an array, or are floats from 0 to 255 or from 0 to 1.

    Example:
        >>> import numpy as np
        >>> check_pixels(np.full((1, 14, 14, 3), 255.0))
        Traceback (most recent call last):
        ...
        crisalad_jax.utils.errors.InputError: images: found float64 from 255 to 255, ...
    """
    if not isinstance(images, np.ndarray | jax.Array):
        raise InputError(
            f"images: found {type(images).__name__}, expected an array of shape "
            "(image, height, width, 3)"
        )
    is_known = not isinstance(images, Tracer) and getattr(images, "is_fully_addressable", True)
    if not is_known or not images.size or not jnp.issubdtype(images.dtype, jnp.floating):
        return
    low, high = float(images.min()), float(images.max())
    largest = max((_OVERSHOOT - m) / d for m, d in zip(how.mean, how.deviation, strict=True))
    if high > max(_BYTES_FROM, largest):
        cure = "images.round().astype(np.uint8)"
    elif low >= 0 and high <= 1 and high - low >= _SPREAD:
        cure = "(255 * images).round().astype(np.uint8)"
    else:
        return
    raise InputError(
        f"images: found {images.dtype} from {low:.3g} to {high:.3g}, which are pixels, expected "
        f"floats that are normalised, or uint8: {cure}"
    )


def normalise(
    image: UInt8[Array, "height width 3"], how: PreprocessingConfig
) -> Float[Array, "height width 3"]:
    """Normalise one RGB image by the method `how.normalisation`.

    "mean-deviation" subtracts the mean and divides by the deviation, by default ImageNet's, as
    DINOv2 expects. "local-contrast" uses those of each pixel's 21 x 21 neighbourhood. It is for
    small models trained from scratch, which would otherwise have to learn to ignore lighting.
    """
    # JAX's default float type: float64 for a model that computes in it (`compiler.number_types`).
    pixels = image.astype(float) / 255
    if how.normalisation == "local-contrast":
        return _local_contrast(pixels)
    return (pixels - jnp.array(how.mean)) / jnp.array(how.deviation)


def _local_contrast(image: Float[Array, "height width 3"]) -> Float[Array, "height width 3"]:
    height, width, _ = image.shape
    rows, columns = jnp.asarray(_box(height)), jnp.asarray(_box(width))

    def box_mean(x: Float[Array, "height width 3"]) -> Float[Array, "height width 3"]:
        return jnp.einsum("ri,cj,ijk->rck", rows, columns, x, precision="highest")

    centred = image - box_mean(image)
    return centred / jnp.sqrt(box_mean(centred**2) + LOCAL_NOISE**2)


def _box(side: int) -> np.ndarray:
    """Make a (side, side) averaging matrix; at the border it averages the part inside the image."""
    near = np.abs(np.arange(side)[:, None] - np.arange(side)) <= LOCAL_WINDOW // 2
    return near / near.sum(axis=1, keepdims=True)
