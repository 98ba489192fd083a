"""Files of descriptors: .npy with a list of names, or HDF5 as hloc reads it."""

import os
import pathlib
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from crisalad_jax.config.checks import choose
from crisalad_jax.retrieval.chunks import as_rows
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, check_source, write_npy

Descriptors = Float[np.ndarray, "image descriptor"]


def writer_for(
    path: str | os.PathLike[str],
) -> Callable[[pathlib.Path, Descriptors, Sequence[str]], None]:
    """Return the function that writes files of this suffix; call it before any work is done.

    Raises:
        InputError: the suffix is neither .npy nor .h5.
    """
    path = pathlib.Path(path)
    writers: Mapping[str, Callable[[pathlib.Path, Descriptors, Sequence[str]], None]] = {
        ".npy": _write_npy,
        ".h5": _write_h5,
    }
    return choose(f"{path}: suffix of the descriptors' file", path.suffix, writers)


def config_of(path: pathlib.Path) -> pathlib.Path:
    """Return the path of the JSON file that tells how the descriptors in `path` were made."""
    return path.with_suffix(".config.json")


def targets(path: pathlib.Path) -> list[pathlib.Path]:
    """List all files that a set of descriptors in `path` consists of."""
    names = [_names_of(path)] if path.suffix == ".npy" else []
    return [path, *names, config_of(path)]


def _names_of(path: pathlib.Path) -> pathlib.Path:
    return path.with_suffix(".names.txt")


def open_npy(path: str | os.PathLike[str]) -> Descriptors:
    """Memory-map the array in a .npy file: float32, float16, float64 or bfloat16.

    Raises:
        InputError: there is no such file, or it holds no matrix of such numbers.
    """
    path = pathlib.Path(path)
    check_source(path, "a .npy file of descriptors")
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"{path}: not a whole .npy file: {error}") from error
    if not isinstance(array, np.ndarray) or (
        array.dtype.kind != "f" and array.dtype != np.dtype("V2")
    ):
        dtype = array.dtype if isinstance(array, np.ndarray) else "an archive"
        raise InputError(f"{path}: found {dtype}, expected an array of floating-point numbers")
    return as_rows(array, str(path))


def _write_npy(path: pathlib.Path, descriptors: Descriptors, names: Sequence[str]) -> None:
    """Write a .npy file; line i of the file with the suffix .names.txt names row i."""
    with atomic_path(_names_of(path)) as temporary:
        temporary.write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    with atomic_path(path) as temporary:
        write_npy(temporary, descriptors)


def _write_h5(path: pathlib.Path, descriptors: Descriptors, names: Sequence[str]) -> None:
    """Write a group for each image, with a dataset `global_descriptor`, as hloc does."""
    import h5py

    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        for name, descriptor in zip(names, descriptors, strict=True):
            if f"{name}/global_descriptor" in file:
                raise InputError(f"{path}: found the image name {name!r} twice, expected it once")
            file.create_dataset(f"{name}/global_descriptor", data=descriptor)


def read_descriptors(path: str | os.PathLike[str]) -> tuple[list[str], Descriptors]:
    """Read names and descriptors from a file of `writer_for` or of hloc, of any float type.

    A .npy file is memory-mapped: its rows are read when they are used.

    Raises:
        InputError: the file, or the names beside a .npy, is missing, not whole, or holds something
            else.
    """
    path = pathlib.Path(path)
    readers = {".npy": _read_npy, ".h5": _read_h5}
    read = choose(f"{path}: suffix of the descriptors' file", path.suffix, readers)
    check_source(path, "a file of descriptors")
    return read(path)


def _read_npy(path: pathlib.Path) -> tuple[list[str], Descriptors]:
    listed = _names_of(path)
    check_source(listed, f"the names of the images in {path.name}")
    names = listed.read_text(encoding="utf-8").splitlines()
    descriptors = open_npy(path)
    if len(descriptors) != len(names):
        raise InputError(
            f"{path}: found {len(descriptors)} descriptors, expected {len(names)}, one for each "
            f"name in {listed.name}"
        )
    return names, descriptors


def _read_h5(path: pathlib.Path) -> tuple[list[str], Descriptors]:
    import h5py

    names: list[str] = []
    rows: list[np.ndarray] = []

    def take(name: str, item: object) -> None:
        group, _, last = name.rpartition("/")
        if last != "global_descriptor" or not isinstance(item, h5py.Dataset):
            return
        if item.ndim != 1 or item.dtype.kind != "f" or (rows and item.shape != rows[0].shape):
            raise InputError(
                f"{path}: found {item.dtype} {item.shape} as {name}, expected floats "
                f"{rows[0].shape if rows else '(descriptor,)'}"
            )
        names.append(group)
        rows.append(item[()])

    try:
        with h5py.File(path) as file:
            file.visititems(take)
    except OSError as error:
        raise InputError(f"{path}: not a whole HDF5 file: {error}") from error
    if not rows:
        raise InputError(f"{path}: found no dataset global_descriptor, expected one for each image")
    return names, np.stack(rows)
