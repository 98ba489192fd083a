"""Read NetVLAD from the MATLAB file that its authors published, as hloc does.

scipy reads the file without running any code in it. As in hloc, axes of length 1 are dropped, and
the resulting arrays have the names and axes of hloc's torch module.
"""

import pathlib
from typing import Any

import numpy as np

from crisalad_jax.checkpoints.torch_io import Content
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.mat_files import load_mat

MATLAB_SUFFIX = ".mat"
_EXPECTED = "a MATLAB file of NetVLAD: net.layers with weights, and its averageImage"
CONVOLUTIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
"""Indices of the VGG-16 layers that have weights, in the file's list of layers."""
_SCORES, _WHITENING = 30, 33
"""Numbers of the layers of NetVLAD's clusters, and of the whitening."""


def read_matlab(path: pathlib.Path) -> Content:
    """Read the weights of NetVLAD, and the mean colour to subtract from images.

    Raises:
        InputError: the file is truncated, or holds another network.
    """
    content = load_mat(
        path, _EXPECTED, damaged="not a whole MATLAB file", struct_as_record=False, squeeze_me=True
    )
    try:
        network = content["net"]
        # hloc subtracts the mean image's first pixel from all, whatever the image's size.
        red, green, blue = map(_as_written, network.meta.normalization.averageImage[0, 0])
        state: dict[str, Any] = {}
        for number in CONVOLUTIONS:
            kernel, bias = network.layers[number].weights
            state |= {
                f"backbone.{number}.weight": kernel.transpose(3, 2, 0, 1),
                f"backbone.{number}.bias": bias,
            }
        scores, centers = network.layers[_SCORES].weights
        rotation, bias = network.layers[_WHITENING].weights
        state |= {
            "netvlad.score_proj.weight": scores.T[:, :, None],
            "netvlad.centers": -centers,  # they have the opposite sign there
            "whiten.weight": rotation.T,
            "whiten.bias": bias,
        }
        arrays = {name: np.asarray(array, np.float32) for name, array in state.items()}
    except (KeyError, AttributeError, IndexError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: found another network ({reason}), expected {_EXPECTED}"
        ) from error
    return Content(arrays, mean=(red / 255, green / 255, blue / 255))


def _as_written(value: Any) -> float:
    """Recover a number of three decimals, such as 123.68, that was rounded to float32."""
    short = round(float(value), 3)
    return short if np.float32(short) == np.float32(value) else float(value)
