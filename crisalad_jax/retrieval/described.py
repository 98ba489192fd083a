"""What describing some images gives."""

from typing import NamedTuple

import numpy as np

from crisalad_jax.config.short_repr import brief
from crisalad_jax.utils.shapes import Float32, Int64


@brief
class Described(NamedTuple):
    """Descriptors of a few images."""

    indices: Int64[np.ndarray, " n"]
    """Indices of the readable images in the list of paths."""
    descriptors: Float32[np.ndarray, "n d"]
    unreadable: Int64[np.ndarray, " _"]
    """Indices of the images that could not be read."""
