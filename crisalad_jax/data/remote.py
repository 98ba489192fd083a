"""Read remote images, at addresses such as s3://bucket/frames, with fsspec.

A path holds an address as `pathlib` writes it, with one slash: `s3:/bucket/frames`. Names, patterns
and folders are therefore paths everywhere, and only code that accesses files uses this module.
"""

import contextlib
import functools
import os
import pathlib
import re
import urllib.parse
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from crisalad_jax.data.frames import stored_bytes
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.extras import missing_extra
from crisalad_jax.utils.files import real_path

_T = TypeVar("_T")
AT_ONCE = 16
"""Number of remote files to read at a time: reading is mostly waiting."""
_ADDRESS = re.compile(r"([a-z][a-z0-9+.-]+):/+(.*)", re.I | re.S)  # C:/ is a drive
_SECRET = re.compile(r"([^:]+://)[^/]*@([^?]*)|(https?://)([^?]*)\?", re.I)
_HEADER = 2**16
"""Bytes to read at a time from the beginning of a file, where EXIF data is."""


def is_remote(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is a remote address.

    Example:
        >>> is_remote(pathlib.Path("s3://bucket/a.jpg")), is_remote("C:/a.jpg")
        (True, False)
    """
    return _ADDRESS.fullmatch(os.fspath(path)) is not None


def address_of(path: str | os.PathLike[str]) -> str:
    """Return the address that a path represents; return other paths unchanged.

    Example:
        >>> address_of(pathlib.Path("s3://bucket/a.jpg"))
        's3://bucket/a.jpg'
    """
    return _ADDRESS.sub(r"\1://\2", os.fspath(path))


def whole_name(folder: pathlib.Path) -> str:
    """Return the address of a remote folder, or a local one's absolute path with links resolved."""
    return address_of(folder) if is_remote(folder) else real_path(folder).as_posix()


def check_address(path: str | os.PathLike[str]) -> None:
    """Check that an address contains no secrets, because names and messages repeat it.

    Raises:
        InputError: the address has a user, or a query string, which may be a signature.
    """
    found = _SECRET.match(address_of(path))
    if found is not None:
        raise InputError(
            f"{''.join(part or '' for part in found.groups())}: found a user or a query in the "
            "address, expected none: fsspec's configuration can hold passwords"
        )


@functools.lru_cache
def _file_system(root: str) -> Any:
    """Return a host's or bucket's file system: one for all threads, to list a folder only once."""
    import fsspec.core

    return fsspec.core.url_to_fs(root)[0]


@contextlib.contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[tuple[Any, str]]:
    """Yield the file system of an address and the path in it; errors become one line.

    Raises:
        InputError: what `check_address` raises; a missing package; or any error of the file system.
    """
    check_address(path)
    address = address_of(path)
    try:
        parts = urllib.parse.urlsplit(address)
        files = _file_system(f"{parts.scheme}://{parts.netloc}")
        yield files, files._strip_protocol(address)
    except ModuleNotFoundError as error:
        raise InputError(missing_extra(error, address)) from error
    except InputError:
        raise
    except Exception as error:  # each file system raises its own errors
        reason = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, FileNotFoundError):
            reason = "found no such file"
        raise InputError(f"{address}: cannot be read: {reason}") from error


def read_remote(path: str | os.PathLike[str]) -> bytes:
    """Return the bytes of the file at an address.

    Raises:
        InputError: the file cannot be read.
    """
    with _opened(path) as (files, there):
        return files.cat_file(there)


@contextlib.contextmanager
def open_beginning(path: str | os.PathLike[str]) -> Iterator[Any]:
    """Open the file at an address for reading its beginning, such as EXIF data.

    Raises:
        InputError: the file cannot be read.
    """
    with _opened(path) as (files, there), files.open(there, block_size=_HEADER) as file:
        yield file


def size_of(path: pathlib.Path) -> int | None:
    """Return the size in bytes of a local or remote image's file; None if there is no file.

    Raises:
        InputError: an address cannot be accessed.
    """
    if is_remote(path):
        return _if_there(path, lambda files, there: files.info(there)["size"])
    return stored_bytes(path)


def is_file(path: pathlib.Path) -> bool:
    """Return whether a local or remote file exists; raise InputError as `size_of` does."""
    if not is_remote(path):
        return path.is_file()
    return bool(_if_there(path, lambda files, there: files.info(there)["type"] == "file"))


def is_folder(path: pathlib.Path) -> bool:
    """Return whether a folder exists (if remote, not empty); raise InputError as `size_of` does."""
    return bool(list_names(path)) if is_remote(path) else path.is_dir()


def list_names(folder: pathlib.Path) -> list[str]:
    """List the names in a local or remote folder; an empty list if there is no folder.

    Raises:
        InputError: an address cannot be accessed.
    """
    if not is_remote(folder):
        try:
            return os.listdir(folder)
        except OSError:
            return []

    def names(files: Any, there: str) -> list[str]:
        files.invalidate_cache(there)
        inside = (each["name"].rstrip("/") for each in files.ls(there, detail=True))
        return [each.rpartition("/")[2] for each in inside if each != there.rstrip("/")]

    return _if_there(folder, names) or []


def state_of(path: pathlib.Path) -> str | None:
    """Return a text that changes when a local or remote file does; None if there is no file.

    Raises:
        InputError: an address cannot be accessed.
    """
    if not is_remote(path):
        with contextlib.suppress(OSError):
            there = path.stat()
            return f"{there.st_size} {there.st_mtime_ns}"
        return None
    return _if_there(path, lambda files, there: files.ukey(there))


def _if_there(path: pathlib.Path, ask: Callable[[Any, str], _T]) -> _T | None:
    with _opened(path) as (files, there):
        try:
            return ask(files, there)
        except FileNotFoundError:
            return None


def for_each(work: Callable[[pathlib.Path], _T], paths: Sequence[pathlib.Path]) -> Iterable[_T]:
    """Return a function's results for paths, in order; several are processed at once if remote."""
    if not any(map(is_remote, paths)):
        return map(work, paths)
    with ThreadPoolExecutor(AT_ONCE) as threads:
        return list(threads.map(work, paths))


def list_remote(path: pathlib.Path, pattern: pathlib.Path | None = None) -> list[pathlib.Path]:
    """List the files below the remote folder `path`, or those below it that match `pattern`.

    Raises:
        InputError: there is no such folder, or the address cannot be accessed.
    """
    with _opened(pattern or path) as (files, there):
        files.invalidate_cache()
        start = len(files._strip_protocol(address_of(path)).rstrip("/"))
        if pattern is None and not files.isdir(there):
            raise InputError(
                f"{address_of(path)}: found no folder there, expected one of images, an image, or "
                "a pattern"
            )
        listing = files.find if pattern is None else files.glob
        found = listing(there, detail=True).items()
        return [path / each[start:].lstrip("/") for each, of in found if of["type"] == "file"]
