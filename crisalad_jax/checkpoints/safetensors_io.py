"""Read and write safetensors files: arrays by name, and one object of JSON with a checksum."""

import json
import mmap
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import safetensors
import safetensors.numpy

from crisalad_jax.utils.checksums import CHECKSUM, seal_safetensors, with_blank
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, check_source, parse_json


class Contents(NamedTuple):
    """What a file holds."""

    value: Any
    """The object beside the arrays, without its checksum."""
    arrays: dict[str, np.ndarray]
    """Read-only views of the file, by name: what writes into the file would change them."""


def write_safetensors(
    path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]
) -> None:
    """Write arrays and texts as a safetensors file, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    with atomic_path(path) as temporary:
        _write(pathlib.Path(path), temporary, arrays, metadata)


def write_sealed(
    path: str | os.PathLike[str],
    arrays: Mapping[str, np.ndarray],
    form: str,
    value: Mapping[str, Any],
) -> None:
    """Write arrays and an object with the file's checksum, whole or not at all.

    Args:
        path: the file.
        arrays: by name.
        form: the format and its version, the one key of the metadata: safetensors keeps no order of
            several.
        value: the object, as JSON values.

    Raises:
        InputError: the file cannot be written.
    """
    metadata = {form: json.dumps(with_blank(value))}
    with atomic_path(path) as temporary:
        _write(pathlib.Path(path), temporary, arrays, metadata)
        seal_safetensors(temporary)


def _write(
    path: pathlib.Path,
    temporary: pathlib.Path,
    arrays: Mapping[str, np.ndarray],
    metadata: Mapping[str, str],
) -> None:
    # The library writes the memory as it lies, whatever the order of the axes.
    arrays = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    try:
        safetensors.numpy.save_file(arrays, temporary, metadata=dict(metadata))
    except safetensors.SafetensorError as error:  # a full disk too
        raise InputError(f"{path}: cannot be written: {error}") from error
    # The library creates files that only their owner can read: widen their mode.
    temporary.chmod(0o644)


def read_sealed(path: pathlib.Path, form: str, expected: str, *, but: str = "\0") -> Contents:
    """Read a file that `write_sealed` wrote; `checksums.checked_safetensors` checks its bytes.

    Args:
        path: the file.
        form: its format.
        expected: what kind of file, for messages.
        but: beginning of the names of arrays that are not read.

    Raises:
        InputError: the file is missing, not whole, of another format, or lacks its checksum.
    """
    check_source(path, expected)
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            if form not in metadata:
                raise InputError(f"{path}: found metadata {sorted(metadata)}, expected {expected}")
            names = [name for name in file.keys() if not name.startswith(but)]  # noqa: SIM118
        arrays = _views(path, names)
    except (safetensors.SafetensorError, OSError) as error:
        raise InputError(
            f"{path}: not a whole safetensors file ({error}), expected {expected}"
        ) from error
    value = parse_json(metadata[form], f"{path} (metadata)", expected)
    if not isinstance(value, dict) or CHECKSUM not in value:
        raise InputError(f"{path} (metadata): found no {CHECKSUM}, expected one in {form!r}")
    del value[CHECKSUM]
    return Contents(value, arrays)


_TYPES = {
    "BOOL": "?",
    "U8": "u1",
    "I8": "i1",
    "U16": "<u2",
    "I16": "<i2",
    "F16": "<f2",
    "U32": "<u4",
    "I32": "<i4",
    "F32": "<f4",
    "U64": "<u8",
    "I64": "<i8",
    "F64": "<f8",
}
"""numpy's types by the format's names, without those that numpy lacks."""


def _views(path: pathlib.Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Map arrays of a file that `safetensors` found whole into memory: nothing is copied."""
    with path.open("rb") as file:
        count = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(count))
        data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))[8 + count :]
    arrays = {}
    for name in names:
        entry = header[name]
        start, end = entry["data_offsets"]
        if entry["dtype"] not in _TYPES:
            known = ", ".join(_TYPES)
            raise InputError(f"{path}: found {name} of {entry['dtype']}, expected one of {known}")
        values = np.frombuffer(data[start:end], _TYPES[entry["dtype"]])
        arrays[name] = values.reshape(entry["shape"])
    return arrays
