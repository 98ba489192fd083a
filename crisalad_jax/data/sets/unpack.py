"""Unpack untrusted archives with Python's own filters: nothing is written outside the folder."""

import contextlib
import os
import pathlib
import shutil
import sys
import zipfile
import zlib

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import is_html, wrap_os_errors
from crisalad_jax.utils.progress import Bar, progress_bar

if sys.version_info >= (3, 11, 4):
    import tarfile
else:  # Debian 12 has 3.11.2, whose tarfile has no filters
    from backports import tarfile

_ZIP, _TAR = (".zip",), (".tar", ".tar.gz", ".tgz", ".tar.bz2", ".tar.xz")


def is_archive(name: str) -> bool:
    """Return whether a name is that of an archive to unpack.

    Example:
        >>> is_archive("summer.tar.gz"), is_archive("names.txt")
        (True, False)
    """
    return name.lower().endswith(_ZIP + _TAR)


def unpack(archive: pathlib.Path, folder: pathlib.Path, *, quiet: bool = False) -> None:
    """Unpack a zip or tar archive into a folder.

    A tar is filtered by `tarfile.data_filter`, which refuses devices, and names and links that lead
    out of the folder. A zip has only files and folders, whose names are cut to stay inside.

    Args:
        archive: the archive.
        folder: the folder to unpack into; it may exist.
        quiet: whether to hide the progress bar.

    Raises:
        InputError: the archive is damaged, contains something that the filter refuses, or does not
            fit on the disk.
    """
    with archive.open("rb") as file:
        if is_html(file.read(512)):
            raise InputError(f"{archive}: found a page of HTML, expected an archive")
    try:
        with wrap_os_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            if archive.name.lower().endswith(_ZIP):
                _unpack_zip(archive, folder, quiet)
            else:
                _unpack_tar(archive, folder, quiet)
    except (
        *(zipfile.BadZipFile, tarfile.TarError, zlib.error, EOFError, NotImplementedError),
        RuntimeError,  # a zip with a password
    ) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{archive}: cannot be unpacked: {reason}, expected an archive") from error


def _unpack_zip(archive: pathlib.Path, folder: pathlib.Path, quiet: bool) -> None:
    with zipfile.ZipFile(archive) as opened:
        total = sum(info.file_size for info in opened.infolist())
        with _bar(archive, folder, total, quiet) as bar:
            for info in opened.infolist():
                opened.extract(info, folder)
                bar.advance(info.file_size / 1e6)


def _unpack_tar(archive: pathlib.Path, folder: pathlib.Path, quiet: bool) -> None:
    # The sizes in a compressed tar are known only after reading all of it.
    total = os.path.getsize(archive)
    with tarfile.open(archive, "r|*") as opened, _bar(archive, folder, total, quiet) as bar:
        for info in opened:
            opened.extract(info, folder, filter="data")
            bar.advance(info.size / 1e6)


def _bar(
    archive: pathlib.Path, folder: pathlib.Path, size: int, quiet: bool
) -> contextlib.AbstractContextManager[Bar]:
    """Check that the disk has room for `size` bytes, and return their progress bar."""
    free = shutil.disk_usage(folder).free
    if size > free:
        raise InputError(
            f"{archive}: found {size / 1e9:.1f} GB in it and {free / 1e9:.1f} GB of free disk, "
            "expected room for all"
        )
    return progress_bar(f"unpacking {archive.name}", size / 1e6, "MB", quiet=quiet)
