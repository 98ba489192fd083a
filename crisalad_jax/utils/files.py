"""Write files atomically, so that a reader never sees half of a file."""

import contextlib
import hashlib
import json
import os
import pathlib
import re
import shutil
import uuid
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from crisalad_jax.utils.errors import InputError


def check_source(path: str | os.PathLike[str], expected: str) -> None:
    """Check that there is a file at `path`; `expected` says of what kind.

    Raises:
        InputError: there is none, or a folder, or no file can have such a name.
    """
    path = pathlib.Path(path)
    try:
        kind = "a folder" if path.is_dir() else None if path.is_file() else "no such file"
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    if kind is not None:
        raise InputError(f"{path}: found {kind}, expected {expected}")


def check_target(path: str | os.PathLike[str], suffix: str | None = None) -> None:
    """Check that a file can be made at `path`, before the work whose result it is to hold.

    Nothing is made yet: work that fails leaves no empty folders.

    Args:
        path: the file.
        suffix: what its name has to end with, as in ".safetensors"; None is anything.

    Raises:
        InputError: `path` is a folder itself, no file can have such a name, or its folder cannot be
            made or written to; or it has another suffix.
    """
    path = pathlib.Path(path)
    if suffix is not None and path.suffix != suffix:
        raise InputError(f"{path}: found the suffix {path.suffix!r}, expected {suffix}")
    try:
        is_folder = path.is_dir()
        nearest = next(folder for folder in path.parents if folder.exists())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be made: {error}") from error
    if "\0" in str(path):  # pathlib treats such a name as a missing file
        raise InputError(f"{path}: cannot be made: found a NUL in the name")
    if is_folder:
        raise InputError(f"{path}: found a folder, expected a file or nothing yet")
    if not nearest.is_dir() or not os.access(nearest, os.W_OK):
        raise InputError(
            f"{path}: cannot be made: found {nearest}, expected a folder that can be written to"
        )


def temporary_beside(path: pathlib.Path) -> pathlib.Path:
    """Return an unused temporary name in the folder of `path`, with its suffix."""
    return path.with_name(f".crisalad-{uuid.uuid4().hex[:12]}{path.suffix}")


def is_temporary(path: pathlib.Path) -> bool:
    """Return whether `path` has a name that `temporary_beside` made."""
    return re.fullmatch(r"\.crisalad-[0-9a-f]{12}(\..*)?", path.name) is not None


def remove_temporaries(folder: pathlib.Path) -> None:
    """Remove the temporary files that a killed writer left in `folder`, and nothing else."""
    for path in filter(is_temporary, folder.glob(".*")):
        if path.is_file():
            path.unlink()


def holds_other_files(folder: pathlib.Path) -> bool:
    """Return whether `folder` holds any file, hidden ones included, besides our temporary files."""
    return not all(map(is_temporary, folder.iterdir()))


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[pathlib.Path]:
    """Yield a temporary path beside `path`; rename it to `path` on success, remove it on any error.

    The temporary name keeps the suffix, for writers that choose a format by it. Parent folders are
    made as needed.

    Raises:
        InputError: what `check_target` raises.
    """
    path = pathlib.Path(path)
    check_target(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path.parent}: cannot make this folder: {error.strerror}") from error
    temporary = temporary_beside(path)
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def durable_path(path: str | os.PathLike[str]) -> Iterator[pathlib.Path]:
    """Yield a temporary path as `atomic_path`, and sync the file to disk, safe from power failure.

    Raises:
        InputError: what `check_target` raises.
    """
    with atomic_path(path) as temporary:
        yield temporary
        _sync(temporary)
    _sync(pathlib.Path(path).parent)


def _sync(path: pathlib.Path) -> None:
    """Sync a file's bytes, or a folder's entries, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_npy(path: pathlib.Path, array: np.ndarray) -> None:
    """Write an array as `np.save` does, and raise if the disk gets full (`np.save` may not).

    Raises:
        OSError: the disk is full, or what `open` raises.
    """
    array = np.ascontiguousarray(array)
    with path.open("wb") as file:
        header = np.lib.format.header_data_from_array_1_0(array)
        np.lib.format.write_array_header_1_0(file, header)
        file.write(array.data)


def write_safetensors(
    path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]
) -> None:
    """Write arrays in C order and texts as a safetensors file, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    import safetensors.numpy  # import here: only writers of weights need it

    with atomic_path(path) as temporary:
        try:
            safetensors.numpy.save_file(dict(arrays), temporary, metadata=dict(metadata))
        except safetensors.SafetensorError as error:  # a full disk too
            raise InputError(f"{path}: cannot be written: {error}") from error
        # The library creates files that only their owner can read: widen their mode.
        temporary.chmod(0o644)


def sha256_of(path: str | os.PathLike[str]) -> str:
    """Compute the SHA-256 digest of a file's bytes, in hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def around(page: pathlib.Path, name: str) -> tuple[str, str]:
    """Split a page around the place `name`, which two comments enclose.

    Raises:
        InputError: there is no such page, or it has no place of this name.
    """
    check_source(page, "a page with a place for the table")
    start, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
    before, opened, rest = page.read_text(encoding="utf-8").partition(start)
    _, closed, after = rest.partition(end)
    if not opened or not closed:
        raise InputError(f"{page}: found no {start.strip()} ... {end}, expected both comments")
    return before + start, end + after


@contextlib.contextmanager
def atomic_folder(path: str | os.PathLike[str]) -> Iterator[pathlib.Path]:
    """Yield a temporary folder beside `path`; rename it to `path` on success, else remove it.

    Raises:
        InputError: what `check_new_folder` raises, or the parent folder cannot be made.
    """
    path = pathlib.Path(path)
    check_new_folder(path)
    temporary = temporary_beside(path)
    try:
        temporary.mkdir(parents=True)
    except OSError as error:
        raise InputError(f"{path}: cannot make this folder: {error.strerror}") from error
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def check_new_folder(path: str | os.PathLike[str]) -> None:
    """Check that a folder can be made at `path`, where there may be an empty one.

    Raises:
        InputError: there is a file, or a folder that holds something; or as `check_target`.
    """
    path = pathlib.Path(path)
    check_target(path / "any")
    if path.is_dir() and path.samefile(os.curdir):
        raise InputError(f"{path}: found the folder that this runs in, expected another")
    if path.is_dir() and any(path.iterdir()):
        raise InputError(f"{path}: found a folder with files in it, expected a new or empty one")


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Write `value` as indented JSON, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")
