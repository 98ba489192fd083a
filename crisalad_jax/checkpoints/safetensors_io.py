"""Read and write safetensors files: arrays by name, and one JSON object with a checksum.

The checksum is the SHA-256 of the object and of every array's name, type, shape and bytes.
"""

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from crisalad_jax.utils.checksums import CHECKSUM, ChangedFileError
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, check_source, parse_json
from crisalad_jax.utils.temporaries import in_use, temporary_beside

WEIGHTS = "crisalad-jax 4"
"""Format of a weight file, the only key of its metadata. Its value is JSON: the file's checksum,
and a `weights.Header`."""
EXPECTED_WEIGHTS = (
    f"a .safetensors file of weights ({WEIGHTS!r}), as this package writes it; `crisalad convert` "
    "reads public checkpoints"
)


def write_safetensors(
    path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]
) -> None:
    """Write arrays, and texts as metadata, to a safetensors file, atomically.

    Raises:
        InputError: the file cannot be written.
    """
    # The library writes the memory as it is laid out, whatever the order of the axes.
    arrays = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    with atomic_path(path) as temporary, in_use(folder := temporary_beside(temporary)):
        temporary.touch()
        # The library writes under a random name in the folder; a killed process would leave it.
        folder.mkdir()
        file = folder / temporary.name
        try:
            safetensors.numpy.save_file(arrays, file, metadata=dict(metadata))
        except safetensors.SafetensorError as error:  # also if the disk is full
            raise InputError(f"{path}: cannot be written: {error}") from error
        file.chmod(temporary.stat().st_mode)  # only the owner can read the library's files
        os.replace(file, temporary)


def write_sealed(
    path: str | os.PathLike[str],
    arrays: Mapping[str, np.ndarray],
    form: str,
    value: Mapping[str, Any],
) -> None:
    """Write arrays and a JSON object, with the checksum of both, to a safetensors file, atomically.

    Args:
        path: the file.
        arrays: arrays by name.
        form: the format and its version, such as `WEIGHTS`. It is the only key of the metadata,
            because safetensors does not preserve the order of several keys.
        value: the object, as JSON values.

    Raises:
        InputError: the file cannot be written.
    """
    sealed = {CHECKSUM: _checksum(value, arrays), **value}
    write_safetensors(path, arrays, {form: json.dumps(sealed)})


def _checksum(value: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    names = sorted(arrays)
    contiguous = [np.asarray(arrays[name], order="C") for name in names]
    digest = hashlib.sha256(json.dumps(value).encode())
    with ThreadPoolExecutor() as pool:
        parts = pool.map(lambda array: hashlib.sha256(array.data).digest(), contiguous)
        for name, array, part in zip(names, contiguous, parts, strict=True):
            digest.update(f"{name} {array.dtype} {array.shape}".encode() + part)
    return digest.hexdigest()


@contextlib.contextmanager
def _opened(path: str | os.PathLike[str], expected: str) -> Iterator[Any]:
    """Open a file, and report what is wrong with it in one line."""
    check_source(path, expected)
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            yield file
    except AttributeError as error:  # safetensors' error for a type that numpy lacks
        raise InputError(f"{path}: found a type that numpy does not know: {error}") from error
    except (safetensors.SafetensorError, OSError) as error:
        raise InputError(
            f"{path}: not a whole safetensors file ({error}), expected {expected}"
        ) from error


def read_safetensors(
    path: str | os.PathLike[str], expected: str
) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """Read (metadata, arrays by name) from any safetensors file.

    Args:
        path: the file.
        expected: description of the kind of file, for messages.

    Raises:
        InputError: the file is missing, incomplete or of another kind, or has a type NumPy lacks.
    """
    with _opened(path, expected) as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return file.metadata() or {}, arrays


def read_metadata(path: str | os.PathLike[str], expected: str) -> dict[str, str]:
    """Read only the metadata of any safetensors file; arguments as for `read_safetensors`."""
    with _opened(path, expected) as file:
        return file.metadata() or {}


def read_header(weights: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the header of a weight file of this package, without its arrays.

    The checksum is not verified.

    Args:
        weights: the file.

    Returns:
        The fields of `weights.Header` as JSON values, such as "model_sha256" and "config".

    Raises:
        InputError: the file is missing, incomplete, or not a weight file of this package.
    """
    return _value(weights, read_metadata(weights, EXPECTED_WEIGHTS), WEIGHTS, EXPECTED_WEIGHTS)[0]


def read_sealed(
    path: str | os.PathLike[str], form: str, expected: str, *, verify: bool = True
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read a file that `write_sealed` wrote.

    Args:
        path: the file.
        form: its format, as `write_sealed` took it.
        expected: description of the kind of file, for messages.
        verify: whether to compare its contents with the checksum.

    Returns:
        (the JSON object without the checksum, arrays by name).

    Raises:
        InputError: the file is missing, incomplete, changed or of another format.
    """
    metadata, arrays = read_safetensors(path, expected)
    value, checksum = _value(path, metadata, form, expected)
    if verify and checksum != _checksum(value, arrays):
        raise ChangedFileError(path)
    return value, arrays


def _value(
    path: str | os.PathLike[str], metadata: Mapping[str, str], form: str, expected: str
) -> tuple[dict[str, Any], Any]:
    """Return the object in the metadata, and its checksum."""
    if form not in metadata:
        raise InputError(f"{path}: found metadata {sorted(metadata)}, expected {expected}")
    value = parse_json(metadata[form], f"{path} (metadata)", expected)
    if not isinstance(value, dict) or CHECKSUM not in value:
        raise InputError(f"{path} (metadata): found no {CHECKSUM}, expected one in {form!r}")
    return value, value.pop(CHECKSUM)
