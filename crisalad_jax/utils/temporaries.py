"""Temporary files and locks: their names, and their removal on errors and signals.

This module imports nothing but the standard library, so that the command line can handle signals
before it imports anything else.
"""

import contextlib
import pathlib
import re
import shutil
import uuid
from collections.abc import Iterator, Sequence

from crisalad_jax.utils.errors import InputError

LOCK = ".crisalad-lock"
"""Name of the file that a folder's writer locks (see `locks.lock`)."""


def holds_other_files(folder: pathlib.Path) -> bool:
    """Return whether `folder` holds any file, even a hidden one, other than our temporary files."""
    return not all(is_temporary(path) or path.name == LOCK for path in folder.iterdir())


def temporary_beside(path: pathlib.Path) -> pathlib.Path:
    """Return an unused temporary name in the folder of `path`, with the same suffix."""
    return path.with_name(f".crisalad-{uuid.uuid4().hex[:12]}{path.suffix}")


def is_temporary(path: pathlib.Path) -> bool:
    """Return whether `path` has a name that `temporary_beside` made."""
    return re.fullmatch(r"\.crisalad-[0-9a-f]{12}(\..*)?", path.name) is not None


def remove_temporaries(folder: pathlib.Path) -> None:
    """Remove what a killed writer left in `folder` under temporary names, and nothing else."""
    for path in filter(is_temporary, folder.glob(".*")):
        _remove(path)


_in_use: set[pathlib.Path] = set()
"""Temporary files and folders that a block of this process is using now."""
_made: list[pathlib.Path] = []
"""Folders that a block of this process has made, the innermost of each first."""


@contextlib.contextmanager
def in_use(path: pathlib.Path) -> Iterator[None]:
    """Remove a temporary file or folder after the block, or when a signal ends the process."""
    _in_use.add(path)
    try:
        yield
    finally:
        _remove(path)
        _in_use.discard(path)


def remove_all_in_use() -> None:
    """Remove the temporary files of this process, which a signal is ending."""
    for path in tuple(_in_use):
        _remove(path)
    _remove_empty(_made)


def _remove(path: pathlib.Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


@contextlib.contextmanager
def made_folder(folder: pathlib.Path) -> Iterator[None]:
    """Make a folder and its parents; if the block raises, remove those that are still empty.

    Raises:
        InputError: the folder cannot be made.
    """
    new = [each for each in (folder, *folder.parents) if not each.exists()]
    _made[:0] = new
    try:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot make this folder: {error.strerror}") from error
        yield
    except BaseException:
        _remove_empty(new)
        raise
    finally:
        for each in new:
            _made.remove(each)


def _remove_empty(folders: Sequence[pathlib.Path]) -> None:
    """Remove the folders that are empty; the innermost come first."""
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()
