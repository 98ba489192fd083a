"""A cache on disk of files at addresses, of bounded size, which several processes may share.

fsspec's own caches of whole files have no bound. Here each of 256 folders has an equal share of the
room and drops its least recently used files alone, so that no process waits for another, and a
kill at any moment leaves nothing but whole files, and temporary ones that age like the others.
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
"""Gigabytes that are cached unless a user says otherwise: GSV-Cities has 24."""
_FOLDERS = 256
_SCANS = 32
"""A folder is scanned once for every so many parts of its share that are written, on average: its
files are too many to be counted for each. It then drops four such parts more than it has to."""
_DIGEST = 16


class FileCache:
    """A cache of files at addresses; threads and processes may share its folder.

    A file is compared with that at the address (size and ETag, or what the store has) when a run
    reads it for the first time, and is not asked for again in that run.
    """

    def __init__(self, folder: pathlib.Path, limit: float) -> None:
        """Take the folder, and the most bytes of its files.

        Raises:
            InputError: files cannot be made there.
        """
        check_folder(folder)
        self._folder, self._share, self._began = folder, limit / _FOLDERS, time.time()

    def read(self, path: str | os.PathLike[str]) -> bytes:
        """Read the file at an address, or the same file in the cache.

        Raises:
            InputError: it is in neither, or the address cannot be asked.
        """
        name = _digest(address_of(path).encode()).hex()
        file = self._folder / str(int(name, 16) % _FOLDERS) / name
        state = data = b""
        used = 0.0
        # Another process may remove the file at any moment; what is open stays readable.
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
        """Write a file that is smaller than a folder's share, unless the disk is full."""
        parts = len(whole) / self._share * _SCANS if self._share else _SCANS
        if parts < _SCANS / 2:
            with contextlib.suppress(InputError, OSError):
                if random.random() < parts:
                    self._make_room(file.parent, len(whole))
                with atomic_path(file) as temporary:
                    temporary.write_bytes(whole)

    def _make_room(self, folder: pathlib.Path, size: int) -> None:
        """Remove the files of a folder that were not used for longest."""
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
