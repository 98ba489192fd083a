"""A cache of remote files on disk, of bounded size, which several processes may share.

fsspec's caches of whole files have no size limit. Here each of 256 folders has an equal share of
the space and evicts only its least recently used files, so that no process waits for another. A
killed process leaves only complete files, and temporary ones, which are evicted like the others.
"""

import contextlib
import hashlib
import os
import pathlib
import random
import time

from crisalad_jax.data.remote import address_of, read_remote, state_of
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, check_folder

CACHE_GB = 32.0
"""Default size of the cache in gigabytes; GSV-Cities takes 24."""
_FOLDERS = 256
_SCANS = 32
"""Number of parts of a folder's share. A folder has too many files to count at every write, so it
is scanned, on average, once per part written, and then evicts four parts more than needed."""
_DIGEST = 16


class FileCache:
    """A cache of remote files; threads and processes may share its folder.

    The first time that a run reads a file, the cached copy is compared with the remote file (by
    size and ETag, or what the store offers). The run does not check the file again.
    """

    def __init__(self, folder: pathlib.Path, limit: float) -> None:
        """Create a cache in `folder`, whose files have at most `limit` bytes in total.

        Raises:
            InputError: files cannot be created in the folder.
        """
        check_folder(folder)
        self._folder, self._share, self._began = folder, limit / _FOLDERS, time.time()

    def read(self, path: str | os.PathLike[str]) -> bytes:
        """Read a remote file, from the cache if the copy there is current.

        Raises:
            InputError: there is no such remote file, or the address cannot be accessed.
        """
        name = _digest(address_of(path).encode()).hex()
        file = self._folder / str(int(name, 16) % _FOLDERS) / name
        state = data = b""
        used = 0.0
        # Another process may remove the file at any moment; an open file stays readable.
        with contextlib.suppress(OSError):
            used = file.stat().st_mtime
            with file.open("rb") as opened:
                state, digest, data = (opened.read(size) for size in (_DIGEST, _DIGEST, -1))
            os.utime(file)
            state = state if _digest(data) == digest else b""
        if state and used >= self._began:
            return data
        there = _digest((state_of(pathlib.Path(path)) or "").encode())
        if state != there:
            data = read_remote(path)
            self._add(file, there + _digest(data) + data)
        return data

    def _add(self, file: pathlib.Path, whole: bytes) -> None:
        """Write a file smaller than half a folder's share, unless the disk is full."""
        parts = len(whole) / self._share * _SCANS if self._share else _SCANS
        if parts < _SCANS / 2:
            with contextlib.suppress(InputError, OSError):
                if random.random() < parts:
                    self._make_room(file.parent, len(whole))
                with atomic_path(file) as temporary:
                    temporary.write_bytes(whole)

    def _make_room(self, folder: pathlib.Path, size: int) -> None:
        """Remove the least recently used files of a folder."""
        folder.mkdir(parents=True, exist_ok=True)
        with os.scandir(folder) as entries:
            files = [(each.path, each.stat()) for each in entries]
        excess = sum(of.st_size for _, of in files) + size - self._share * (1 - 4 / _SCANS)
        for path, of in sorted(files, key=lambda each: each[1].st_mtime):
            if excess <= 0:
                return
            pathlib.Path(path).unlink(missing_ok=True)
            excess -= of.st_size


def _digest(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=_DIGEST).digest()
