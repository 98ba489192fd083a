"""Read .npy files, pickled ones included, without running code from them.

Published ground truths are arrays of lists, which numpy can only save as a pickle.
"""

import io
import pathlib
import pickle
from typing import Any

import numpy as np

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_bytes

_NAMES = frozenset(
    (
        ("numpy", "ndarray"),
        ("numpy", "dtype"),
        ("numpy._core.multiarray", "_reconstruct"),
        ("numpy._core.multiarray", "scalar"),
        ("numpy._core.numeric", "_frombuffer"),
        ("_codecs", "encode"),
        ("__builtin__", "bytes"),
    )
)
"""All that a pickled array asks for; the last two spell bytes for Python 2. None of it runs code of
the file, calls back into it, or can be changed by it."""


def read_npy(path: pathlib.Path) -> np.ndarray:
    """Read a .npy file; a pickled one may hold lists, tuples, text, bytes, numbers and arrays.

    Raises:
        InputError: the file is missing, damaged, or holds anything else.
    """
    file = io.BytesIO(read_bytes(path, "a .npy file"))
    try:
        return _read(file)
    except Exception as error:  # a damaged pickle can raise anything at all
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: cannot be read as an array: {type(error).__name__}: {reason}"
        ) from error


def _read(file: io.BytesIO) -> np.ndarray:
    version = np.lib.format.read_magic(file)
    wide = version > (1, 0)
    header = np.lib.format.read_array_header_2_0 if wide else np.lib.format.read_array_header_1_0
    shape, _, dtype = header(file)
    if not dtype.hasobject:
        file.seek(0)
        return np.lib.format.read_array(file, allow_pickle=False)
    array = _Unpickler(file, encoding="latin1").load()
    if not isinstance(array, np.ndarray) or array.shape != shape:
        raise ValueError(f"found a pickled {type(array).__name__}, expected an array of {shape}")
    return array


class _Unpickler(pickle._Unpickler):
    """Looks up `_NAMES` alone.

    Python's own: the one in C allocates as much memory as a damaged file says.
    """

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        # numpy 2 moved its modules, and files of numpy 1 and 2 both exist.
        module = module_name.replace("numpy.core.", "numpy._core.")
        if (module, global_name) not in _NAMES:
            raise pickle.UnpicklingError(f"the file asks for {module}.{global_name}")
        return super().find_class(module, global_name)
