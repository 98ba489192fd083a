"""Read MATLAB's `.mat` files with scipy, which runs no code in them."""

import os
import struct
import zlib
from typing import Any

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import LARGEST, check_source

_COMPRESSED = 15
"""Type of an element that zlib compressed (MAT-File Format, MathWorks, table 1-1)."""


def load_mat(
    path: str | os.PathLike[str],
    expected: str,
    *,
    damaged: str,
    largest: int = LARGEST,
    **options: Any,
) -> dict[str, Any]:
    """Read the variables of a `.mat` file, by their names.

    Args:
        path: the file.
        expected: what kind of file, for messages.
        damaged: what the message calls a file that scipy cannot read.
        largest: maximum size in bytes, compressed or not.
        **options: options of `scipy.io.loadmat`.

    Raises:
        InputError: the file is missing, too large, damaged, or of MATLAB's format 7.3.
    """
    # Import here: scipy takes half a second.
    import scipy.io

    check_source(path, expected, largest=largest)
    if not _unpacks_to(path, largest):
        raise InputError(
            f"{path}: found more than {largest} bytes once it is unpacked, expected {expected}"
        )
    try:
        return scipy.io.loadmat(path, **options)
    except NotImplementedError as error:
        raise InputError(
            f"{path}: found MATLAB's format 7.3, expected 7 or older (save it with '-v7')"
        ) from error
    except Exception as error:  # a damaged file can raise anything at all
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(f"{path}: {damaged}: {reason}") from error


def _unpacks_to(path: str | os.PathLike[str], largest: int) -> bool:
    """Return whether compressed elements of a version 5 file unpack to at most `largest` bytes."""
    with open(path, "rb") as file:
        order = {b"IM": "<", b"MI": ">"}.get(file.read(128)[126:])
        while order and len(tag := file.read(8)) == 8 and largest >= 0:
            kind, left = struct.unpack(f"{order}II", tag)
            if not left:
                break
            if kind != _COMPRESSED:
                file.seek(left, os.SEEK_CUR)
                continue
            unpack = zlib.decompressobj()
            while left and largest >= 0 and (data := file.read(min(left, 2**16))):
                left -= len(data)
                try:
                    largest -= len(unpack.decompress(data))
                except zlib.error:  # scipy says what is damaged
                    return True
    return largest >= 0
