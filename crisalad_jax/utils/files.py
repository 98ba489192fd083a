"""Read regular files, and write files so that a reader never sees a partial one."""

import contextlib
import ctypes
import io
import json
import os
import pathlib
import stat
import tempfile
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.lib.format import dtype_to_descr, write_array_header_1_0

from crisalad_jax.utils.checksums import (
    CHECKSUM,
    check_checksum,
    checksummed_json,
)
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.temporaries import in_use, made_folder, temporary_beside

LARGEST = 2**30
"""Maximum bytes of a file that is read into memory, such as an image: a sparse file may claim any
number."""
LARGEST_TEXT, _LARGEST_JSON = 2**27, 2**26
"""The same for text and JSON, whose characters and values take many times as much memory."""


def is_html(start: bytes) -> bool:
    """Return whether a file that starts like this is an HTML page, sent instead of the real file.

    Example:
        >>> is_html(b"<!DOCTYPE html><title>Quota exceeded</title>")
        True
    """
    return start[:512].lstrip().lower().startswith((b"<!doctype html", b"<html"))


def check_source(
    path: str | os.PathLike[str], expected: str, *, largest: int | None = None
) -> None:
    """Check that there is a regular file at `path`.

    Args:
        path: the file.
        expected: what kind of file, for messages.
        largest: maximum size in bytes; None is any.

    Raises:
        InputError: there is no file, it is larger, or `path` is a folder, a pipe or a device.
            Opening a pipe may wait forever, and a device may never end.
    """
    found = _kind_of(path)
    if found == _FILE:
        size = os.stat(path).st_size
        if largest is None or size <= largest:
            return
        found, expected = f"{size} bytes", f"{expected}, of at most {largest}"
    raise InputError(f"{path}: found {found}, expected {expected}")


_NOTHING, _FILE, _FOLDER = "no such file", "a file", "a folder"
_KINDS = {stat.S_IFREG: _FILE, stat.S_IFDIR: _FOLDER, stat.S_IFIFO: "a pipe"}


def _kind_of(path: str | os.PathLike[str]) -> str:
    """Describe what `path` is."""
    try:
        return _KINDS.get(stat.S_IFMT(os.stat(path).st_mode), "a device or a socket")
    except (FileNotFoundError, NotADirectoryError):
        return _NOTHING
    except (OSError, ValueError) as error:  # circular links, a NUL in the name
        return f"a name that cannot be made or read ({getattr(error, 'strerror', error)})"


CACHE = "CRISALAD_CACHE"
"""Environment variable: the folder of everything that this package caches."""


def user_cache() -> pathlib.Path:
    """Return the folder of everything that this package caches, which need not exist yet.

    It is `CRISALAD_CACHE`, or else `crisalad-jax` in the user's cache folder, which
    `XDG_CACHE_HOME` may set; a relative path there is ignored, as in the XDG Base Directory
    Specification. Its folders are models, images, exports, programs, teachers, xla and numba.

    Raises:
        RuntimeError: the user has no home folder.
    """
    own = os.environ.get(CACHE)
    if own:
        return pathlib.Path(own).expanduser()
    named = pathlib.Path(os.environ.get("XDG_CACHE_HOME", ""))
    caches = named if named.is_absolute() else pathlib.Path.home() / ".cache"
    return caches / "crisalad-jax"


def read_bytes(path: str | os.PathLike[str], expected: str, *, largest: int = LARGEST) -> bytes:
    """Read a regular file.

    Args:
        path: the file.
        expected: what kind of file, for messages.
        largest: maximum size in bytes.

    Raises:
        InputError: there is no regular file at `path`, or it is larger.
        PermissionError: the file may not be read.
    """
    check_source(path, expected, largest=largest)
    return pathlib.Path(path).read_bytes()


def read_text(path: str | os.PathLike[str], expected: str) -> str:
    """Read a UTF-8 text file of at most `LARGEST_TEXT` bytes; drop a byte order mark.

    Raises:
        InputError: there is no regular file at `path`, it is larger, or it is not UTF-8.
    """
    try:
        return read_bytes(path, expected, largest=LARGEST_TEXT).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: found bytes that are not UTF-8 (at {error.start}), expected {expected}"
        ) from error


def parse_json(text: str | bytes, source: str, expected: str) -> Any:
    """Parse JSON.

    Args:
        text: the JSON.
        source: what the message begins with, such as a file's name.
        expected: what the JSON should hold, for the message.

    Raises:
        InputError: it is not JSON, has a key twice in an object, or is nested deeper than anything
            that this package writes.
    """
    try:
        return json.loads(text, object_pairs_hook=_each_once)
    except (ValueError, RecursionError) as error:
        reason = "nested too deep" if isinstance(error, RecursionError) else error
        raise InputError(f"{source}: found no JSON ({reason}), expected {expected}") from error


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Make a JSON object, and reject equal keys, of which Python would silently take the last."""
    value = dict(pairs)
    if len(value) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice!r} twice")
    return value


def read_json(path: str | os.PathLike[str], expected: str, *, sealed: bool = True) -> Any:
    """Read the value of a JSON file, and check the checksum that `write_json` put into it.

    Args:
        path: the file.
        expected: what kind of file, for messages.
        sealed: whether to require a checksum; users have to remove it from a file that they edit.

    Returns:
        The value, without its checksum; an object if the file must hold one.

    Raises:
        InputError: the file cannot be read, is not JSON, or lacks or does not match its checksum.
    """
    data = read_bytes(path, expected, largest=_LARGEST_JSON)
    value = parse_json(data, str(path), expected)
    if isinstance(value, dict) and CHECKSUM in value:
        check_checksum(data, value.pop(CHECKSUM), path)
    elif sealed:
        raise InputError(f"{path}: found no checksum, expected {expected}")
    return value


def real_path(path: str | os.PathLike[str]) -> pathlib.Path:
    """Return the absolute path with links resolved; unlike in pathlib, they may be circular."""
    return pathlib.Path(os.path.realpath(path))


def check_target(path: str | os.PathLike[str], suffix: str | None = None) -> None:
    """Check that a file can be made at `path`, before the work that produces it.

    Nothing is made yet, so that work that fails leaves no empty folders.

    Args:
        path: the file.
        suffix: what its name has to end with, as in ".safetensors"; None is anything.

    Raises:
        InputError: `path` is a folder, a pipe or a device, is not a valid name for a file, or has
            another suffix; or its folder cannot be made or written to.
    """
    path = pathlib.Path(path)
    if path.name in ("", "-"):
        raise InputError(f"{path}: found no file name, expected one")
    if suffix is not None and path.suffix != suffix:
        raise InputError(f"{path}: found the suffix {path.suffix!r}, expected {suffix}")
    _check_place(path, _FILE, "a file or nothing yet")


def check_folder(path: str | os.PathLike[str]) -> None:
    """Check that files can be made in a folder, which need not exist yet.

    Raises:
        InputError: `path` is something other than a folder, or cannot be made or written to.
    """
    _check_place(path, _FOLDER, "a folder or nothing yet")


def check_new_folder(path: str | os.PathLike[str]) -> None:
    """Check that a folder can be made at `path`, which may be an empty one already.

    Raises:
        InputError: `path` is a file, a folder that is not empty, or the working directory; or it
            cannot be made.
    """
    path = pathlib.Path(path)
    _check_place(path, _FOLDER, "a new or empty folder")
    if path.exists() and path.samefile(os.curdir):
        raise InputError(f"{path}: found the working directory, expected another folder")
    if path.exists() and any(path.iterdir()):
        raise InputError(f"{path}: found a folder with files in it, expected a new or empty one")


def check_no_links(folder: pathlib.Path, *, itself: bool = False) -> None:
    """Check that nothing in a folder is a link, through which writes would change other files.

    Args:
        folder: the folder, which need not exist; it may come from somebody else.
        itself: whether to reject a link at `folder` too, as for a folder the user did not name.

    Raises:
        InputError: a file or a folder in it, at any depth, is a link.
    """
    if itself and folder.is_symlink():
        raise InputError(f"{folder}: found a link, expected the file or folder itself")
    # It takes a tenth of the time of `rglob`: many images may have been added to a map.
    with os.scandir(folder) if folder.is_dir() else contextlib.nullcontext(()) as entries:
        for entry in entries:
            if entry.is_symlink():
                raise InputError(f"{entry.path}: found a link, expected the file or folder itself")
            if entry.is_dir(follow_symlinks=False):
                check_no_links(pathlib.Path(entry.path))


def _check_place(path: str | os.PathLike[str], kind: str, expected: str) -> None:
    """Check that `path` is of this `kind`, or can be made."""
    path = pathlib.Path(path)
    found = _kind_of(path)
    if found not in (kind, _NOTHING):
        raise InputError(f"{path}: found {found}, expected {expected}")
    places = path.parents if kind == _FILE else (path, *path.parents)
    nearest = next(place for place in places if place.exists())
    try:
        # A folder's permissions say nothing about /proc or about a read-only disk.
        tempfile.TemporaryFile(dir=nearest).close()
    except OSError as error:
        raise InputError(
            f"{path}: cannot be made: found {nearest}, expected a folder that can be written to"
        ) from error


def check_format(what: str, path: str | os.PathLike[str], *suffixes: str) -> None:
    """Check that a file's suffix matches the format that the file will have.

    Args:
        what: the flag that gives the path, for the message.
        path: the file; a name without a suffix is accepted.
        suffixes: what it may end with, as in ".json".

    Raises:
        InputError: it ends with another suffix.
    """
    suffix = pathlib.Path(path).suffix.lower()
    if suffix and suffix not in suffixes:
        ends = " or ".join(suffixes)
        raise InputError(f"{what}: found {path}, expected a name that ends in {ends}")


@contextlib.contextmanager
def wrap_os_errors(path: pathlib.Path) -> Iterator[None]:
    """Turn a disk error in this block into one line that names the file.

    Raises:
        InputError: the block raised an `OSError`, which this replaces.
    """
    try:
        yield
    except OSError as error:
        reason = error.strerror or " ".join(str(error).split())
        raise InputError(f"{path}: cannot be written: {reason}") from error


@contextlib.contextmanager
def atomic_path(
    path: str | os.PathLike[str], within: pathlib.Path | None = None, *, durable: bool = False
) -> Iterator[pathlib.Path]:
    """Yield a temporary path next to `path`; rename it to `path` on success, else remove it.

    The temporary name has the same suffix, from which writers choose a format. Parent folders are
    made as needed.

    Args:
        path: the file.
        within: a folder on the same disk for the temporary file, cleared by its owner; None is
            the folder of `path`.
        durable: whether to sync the file to disk, so that it survives a power failure.

    Raises:
        InputError: no file can be made at `path`; or the disk is full, or fails.
    """
    path = pathlib.Path(path)
    check_target(path)
    temporary = temporary_beside(path if within is None else within / path.name)
    with _renamed_to(path, temporary):
        yield temporary
        if durable:
            _sync(temporary)
    if durable:
        _sync(path.parent)


@contextlib.contextmanager
def _renamed_to(path: pathlib.Path, temporary: pathlib.Path) -> Iterator[None]:
    """Rename what the block makes as `temporary` to `path` on success, else remove it."""
    with made_folder(path.parent), wrap_os_errors(path), in_use(temporary):
        yield
        os.replace(temporary, path)


def _sync(path: pathlib.Path) -> None:
    """Sync a file's bytes, or a folder's entries, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_npy(path: pathlib.Path, array: np.ndarray) -> None:
    """Write an array as `np.save` does, but raise if the disk is full (`np.save` may not).

    Raises:
        OSError: the disk is full, or the file cannot be opened.
    """
    array = np.ascontiguousarray(array)
    with path.open("wb") as file:
        file.write(npy_header(array.dtype, array.shape))
        file.write(array.reshape(-1).view(np.uint8).data)


def npy_header(dtype: np.dtype, shape: tuple[int, ...]) -> bytes:
    """Return the header of a .npy file for an array in C order."""
    file = io.BytesIO()
    values = {"descr": dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    write_array_header_1_0(file, values)
    return file.getvalue()


@contextlib.contextmanager
def atomic_folder(path: str | os.PathLike[str]) -> Iterator[pathlib.Path]:
    """Yield a temporary folder next to `path`; rename it to `path` on success, else remove it.

    Raises:
        InputError: `path` exists and is not an empty folder, or it cannot be made.
    """
    path = pathlib.Path(path)
    check_new_folder(path)
    temporary = temporary_beside(path)
    with _renamed_to(path, temporary):
        temporary.mkdir()
        yield temporary


def _renameat2() -> Any:
    """Return Linux's function of that name; None on other systems."""
    return getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)


def exchange(first: pathlib.Path, second: pathlib.Path) -> None:
    """Exchange the names of two folders atomically, with Linux's `renameat2`.

    Raises:
        InputError: the system or file system has no such call; both folders stay as they are.
    """
    call = _renameat2()
    here, both = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of <fcntl.h> and <linux/fs.h>
    given = here, os.fsencode(first), here, os.fsencode(second), both
    if call is None or call(*given) != 0:
        why = "no renameat2" if call is None else os.strerror(ctypes.get_errno())
        raise InputError(f"{second}: could not exchange it with {first} ({why})")


def write_json(path: str | os.PathLike[str], value: Mapping[str, Any]) -> None:
    """Write an object as indented JSON with its checksum, atomically.

    Raises:
        InputError: the file cannot be written.
    """
    data = checksummed_json(value, indent=2)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
