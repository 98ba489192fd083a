"""Writing files so that a reader never meets half of one."""

import contextlib
import hashlib
import json
import os
import pathlib
import shutil
import uuid
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from crisalad_jax.errors import InputError


def check_source(path: str | os.PathLike[str], expected: str) -> None:
    """Check that there is a file at `path`; `expected` says of what kind.

    Raises:
        InputError: there is none, or a folder, or no file can have such a name.
    """
    path = pathlib.Path(path)
    try:
        found = "a folder" if path.is_dir() else None if path.is_file() else "no such file"
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    if found is not None:
        raise InputError(f"{path}: found {found}, expected {expected}")


def check_target(path: str | os.PathLike[str]) -> None:
    """Check that a file can be made at `path`, before the work whose result it is to hold.

    Nothing is made yet: work that fails leaves no empty folders.

    Raises:
        InputError: `path` is a folder itself, no file can have such a name, or its folder cannot be
            made or written to.
    """
    path = pathlib.Path(path)
    try:
        is_folder = path.is_dir()
        nearest = next(folder for folder in path.parents if folder.exists())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be made: {error}") from error
    if "\0" in str(path):  # which pathlib takes for the name of a file that is not there
        raise InputError(f"{path}: cannot be made: found a NUL in the name")
    if is_folder:
        raise InputError(f"{path}: found a folder, expected a file or nothing yet")
    if not nearest.is_dir() or not os.access(nearest, os.W_OK):
        raise InputError(
            f"{path}: cannot be made: found {nearest}, expected a folder that can be written to"
        )


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
    temporary = path.with_name(f".{uuid.uuid4().hex[:12]}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def durable_path(path: str | os.PathLike[str]) -> Iterator[pathlib.Path]:
    """As `atomic_path`; afterwards the file is on the disk, even if the power fails.

    Raises:
        InputError: what `check_target` raises.
    """
    with atomic_path(path) as temporary:
        yield temporary
        _sync(temporary)
    _sync(pathlib.Path(path).parent)


def _sync(path: pathlib.Path) -> None:
    """A file's bytes, or a folder's names, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_npy(path: pathlib.Path, array: np.ndarray) -> None:
    """As `np.save`, which says nothing where the end of an array finds the disk full.

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
    import safetensors.numpy  # which those who write no weights need not load

    with atomic_path(path) as temporary:
        try:
            safetensors.numpy.save_file(dict(arrays), temporary, metadata=dict(metadata))
        except safetensors.SafetensorError as error:  # a full disk too
            raise InputError(f"{path}: cannot be written: {error}") from error
        # The library makes files that only their owner can read.
        temporary.chmod(0o644)


def sha256_of(path: str | os.PathLike[str]) -> str:
    """The digest of a file's bytes, in hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def around(page: pathlib.Path, name: str) -> tuple[str, str]:
    """A page up to the place of what is called so, and from its end on: between two comments.

    Raises:
        InputError: there is no such page, or it has no place of this name.
    """
    check_source(page, "a page with a place for the table")
    start, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
    before, found, rest = page.read_text(encoding="utf-8").partition(start)
    _, closed, after = rest.partition(end)
    if not found or not closed:
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
    temporary = path.with_name(f".{uuid.uuid4().hex[:12]}")
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
