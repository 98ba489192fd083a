"""Read and write NetVLAD's networks in MATLAB files, as MatConvNet has them.

scipy reads them, which runs nothing of the file. Axes of length 1 are dropped, as by hloc's reader.
"""

import pathlib
import re
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path
from crisalad_jax.utils.mat_files import load_mat

MATLAB_SUFFIX = ".mat"
AVERAGE = "net.meta.normalization.averageImage"
"""Name of the image that is subtracted from pixels of 0 to 255."""
_WEIGHTS = re.compile(r"net\.layers\[(\d+)\]\.weights\[(\d)\]")
_SETTINGS = "crisalad"
"""Name of a field of net.meta."""
_EXPECTED = "a MATLAB file of a network: net.layers with weights, and its averageImage"


class Network(NamedTuple):
    """What a file holds."""

    state: dict[str, np.ndarray]
    """Weights as float32, and the average image, by their paths."""
    settings: str | None
    """The text that `write_matlab` added."""


def read_matlab(path: pathlib.Path) -> Network:
    """Read all weights of a network, and its average image.

    Raises:
        InputError: the file is cut short, or no network.
    """
    content = load_mat(
        path,
        _EXPECTED,
        damaged="not a whole MATLAB file",
        struct_as_record=False,
        squeeze_me=True,
    )
    try:
        network = content["net"]
        average = network.meta.normalization.averageImage
        layers = [np.atleast_1d(getattr(layer, "weights", ())) for layer in network.layers]
    except KeyError as error:
        raise InputError(f"{path}: found no {error}, expected {_EXPECTED}") from error
    except (AttributeError, TypeError) as error:
        raise InputError(
            f"{path}: found a net without layers or averageImage, expected {_EXPECTED}"
        ) from error
    state = {AVERAGE: _numbers(path, AVERAGE, average)}
    for number, weights in enumerate(layers):
        for i, array in enumerate(weights):
            name = f"net.layers[{number}].weights[{i}]"
            state[name] = _numbers(path, name, array)
    text = getattr(network.meta, _SETTINGS, None)
    return Network(state, None if text is None else str(text))


def _numbers(path: pathlib.Path, name: str, value: Any) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in "fu":
        raise InputError(f"{path}: {name} found {array.dtype}, expected numbers")
    return array.astype(np.float32)


def write_matlab(path: pathlib.Path, state: dict[str, np.ndarray], settings: str | None) -> None:
    """Write a network under the paths that `read_matlab` returns, and a text with it, if any.

    Raises:
        InputError: the file cannot be made.
    """
    import scipy.io

    found = {name: _WEIGHTS.fullmatch(name) for name in state}
    count = 1 + max(int(match[1]) for match in found.values() if match)
    layers = np.empty(count, object)
    for number in range(count):
        arrays = [state[n] for n, match in found.items() if match and int(match[1]) == number]
        weights = np.empty(len(arrays), object)
        weights[:] = arrays
        layers[number] = {"name": f"layer {number}", "weights": weights}
    meta: dict[str, Any] = {"normalization": {"averageImage": state[AVERAGE]}}
    if settings is not None:
        meta[_SETTINGS] = settings
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        scipy.io.savemat(file, {"net": {"layers": layers, "meta": meta}}, oned_as="column")
