"""Checksums: a file that this package writes holds the SHA-256 of its own bytes.

The digest stands in the file's text, and is computed as if its digits were zeros there. So every
byte of the file counts, and one rule serves JSON and the metadata of safetensors.
"""

import contextlib
import hashlib
import json
import mmap
import os
import pathlib
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn

CHECKSUM = "checksum"
"""Key of the digest, the first of its object."""
BLANK = "0" * 64
_HEADER_LIMIT = 2**27
"""Largest header of a safetensors file in bytes; the library allows 100 MB."""


def sha256_of(path: str | os.PathLike[str]) -> str:
    """Compute the SHA-256 digest of a file's bytes, in hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def with_blank(value: Mapping[str, Any]) -> dict[str, Any]:
    """Return an object with zeros for its checksum ahead of all other keys.

    A checksum that it has already, as of another file, is left out.
    """
    return {CHECKSUM: BLANK} | {key: each for key, each in value.items() if key != CHECKSUM}


def checksummed_json(value: Mapping[str, Any], indent: int | None = None) -> bytes:
    """Return an object as the bytes of a JSON file, with its checksum ahead of all other keys."""
    data = (json.dumps(with_blank(value), indent=indent) + "\n").encode()
    return data.replace(BLANK.encode(), hashlib.sha256(data).hexdigest().encode(), 1)


def check_sealed(data: bytes, digest: Any, path: object) -> None:
    """Check that a file's bytes have the checksum that stands in them.

    Args:
        data: the bytes.
        digest: the value at `CHECKSUM` among them.
        path: the file, for the message.

    Raises:
        InputError: they do not.
    """
    if not _is_digest(digest):
        raise InputError(f"{path}: found checksum {digest!r}, expected 64 hexadecimal digits")
    blank = data.replace(digest.encode(), BLANK.encode(), 1)
    if hashlib.sha256(blank).hexdigest() != digest:
        raise ChangedFileError(path)


class ChangedFileError(InputError):
    """A file whose bytes do not have their checksum."""

    def __init__(self, path: object) -> None:
        """Take the file, for the message."""
        super().__init__(
            f"{path}: found other bytes than were written, expected those of its checksum "
            "(SHA-256): the file is damaged or was changed"
        )


def tell_unchecked(path: object, missing: str = "no checksum") -> None:
    """Tell that a file, as of another program, has no checksum."""
    warn(f"{path}: found {missing}, as of other programs; not checked")


def has_damaged_key(value: Mapping[str, Any]) -> bool:
    """Return whether an object begins with a digest whose key has other letters than `CHECKSUM`."""
    key = next(iter(value), "")
    return key != CHECKSUM and len(key) == len(CHECKSUM) and _is_digest(value[key])


def _is_digest(value: Any) -> bool:
    digits = "0123456789abcdef"
    return isinstance(value, str) and len(value) == 64 and all(each in digits for each in value)


_APPENDED = b"\nsha256 "
_APPENDED_SIZE = len(_APPENDED) + 64 + 1


def append_checksum(path: pathlib.Path) -> None:
    """Append a line with the digest of the bytes before it, where readers of the format stop."""
    line = _APPENDED + sha256_of(path).encode() + b"\n"
    with path.open("ab") as file:
        file.write(line)


def check_appended(path: pathlib.Path) -> None:
    """Check the line that `append_checksum` wrote; a note tells of a file without one.

    Raises:
        InputError: the file has other bytes than the line says.
    """
    with path.open("rb") as file:
        size = max(0, os.fstat(file.fileno()).st_size - _APPENDED_SIZE)
        file.seek(size)
        line = file.read()
        if not line.startswith(_APPENDED):
            tell_unchecked(path)
            return
        file.seek(0)
        digester = hashlib.sha256()
        while size and (data := file.read(min(size, 2**20))):
            digester.update(data)
            size -= len(data)
    if line != _APPENDED + digester.hexdigest().encode() + b"\n":
        raise ChangedFileError(path)


def seal_safetensors(path: pathlib.Path) -> None:
    """Replace the zeros in the metadata of a safetensors file by the checksum of the file."""
    header = _header_of(path)
    place = header.index(BLANK.encode())
    digest = sha256_of(path)
    with path.open("r+b") as file:
        file.seek(place)
        file.write(digest.encode())


@contextlib.contextmanager
def checked_safetensors(path: pathlib.Path, *, verify: bool) -> Iterator[None]:
    """Check a safetensors file's checksum in a thread, while the block reads the file.

    A file without a checksum passes: the block knows which formats have one.

    Raises:
        InputError: the file has other bytes than its checksum says; also in place of any other
            `InputError` of the block.
    """
    if not verify or not path.is_file():  # opening a pipe would wait, before the block refuses it
        yield
        return
    with ThreadPoolExecutor(1) as thread:
        right = thread.submit(_safetensors_are_right, path)
        try:
            yield
        except InputError as error:
            if not right.result():
                raise ChangedFileError(path) from error
            raise
        if not right.result():
            raise ChangedFileError(path)


def _safetensors_are_right(path: pathlib.Path) -> bool:
    """Return whether a file has its checksum; True where it holds none that can be read."""
    try:
        header = _header_of(path)
        metadata = json.loads(header[8:])["__metadata__"]
        (digest,) = (json.loads(text)[CHECKSUM] for text in metadata.values())
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return True
    if not _is_digest(digest) or digest.encode() not in header:
        return False
    digester = hashlib.sha256(header.replace(digest.encode(), BLANK.encode(), 1))
    # One call for all: between calls this thread waits for Python's lock, which the block holds.
    with (
        path.open("rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
        memoryview(data)[len(header) :] as rest,
    ):
        digester.update(rest)
    return digester.hexdigest() == digest


def _header_of(path: pathlib.Path) -> bytes:
    """Read the length and the JSON at the beginning of a safetensors file."""
    with path.open("rb") as file:
        length = file.read(8)
        count = int.from_bytes(length, "little")
        if count > _HEADER_LIMIT:
            raise ValueError("no header of a safetensors file")
        return length + file.read(count)
