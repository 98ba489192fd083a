"""Checksums: a file that this package writes holds the SHA-256 of its own bytes.

The digest is part of the file's text, and is computed with zeros in place of its digits, so that
every byte of the file counts.
"""

import hashlib
import json
import os
from collections.abc import Mapping
from typing import Any

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn

CHECKSUM = "checksum"
"""Key of the digest, the first key of the JSON object."""
_BLANK = "0" * 64


def sha256_of(path: str | os.PathLike[str]) -> str:
    """Compute the SHA-256 digest of a file's bytes, in hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def checksummed_json(value: Mapping[str, Any], indent: int | None = None) -> bytes:
    """Return an object as the bytes of a JSON file, with its checksum before all other keys."""
    blank = {CHECKSUM: _BLANK} | {**value, CHECKSUM: _BLANK}
    data = (json.dumps(blank, indent=indent) + "\n").encode()
    return data.replace(_BLANK.encode(), hashlib.sha256(data).hexdigest().encode(), 1)


def check_checksum(data: bytes, digest: Any, path: object) -> None:
    """Check a file's bytes against the checksum that they contain.

    Args:
        data: the bytes.
        digest: the value of the key `CHECKSUM` in the file.
        path: the file, for the message.

    Raises:
        ChangedFileError: the bytes and the checksum do not match.
    """
    blank = data.replace(str(digest).encode(errors="replace"), _BLANK.encode(), 1)
    if hashlib.sha256(blank).hexdigest() != digest:
        raise ChangedFileError(path)


class ChangedFileError(InputError):
    """A file whose bytes do not match their checksum."""

    def __init__(self, path: object) -> None:
        """Name the file in the message."""
        super().__init__(
            f"{path}: found other bytes than were written, expected those of its checksum "
            "(SHA-256): the file is damaged or was changed"
        )


def tell_unchecked(path: object, missing: str = "no checksum") -> None:
    """Warn that a file is not checked, as it has no checksum; `missing` says what it lacks."""
    warn(f"{path}: found {missing}, as in files of other programs; not checked")
