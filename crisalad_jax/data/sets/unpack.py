"""Unpack archives that others made: regular files alone, and nothing outside of the folder."""

import contextlib
import os
import pathlib
import shutil
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from typing import IO, NamedTuple

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import is_html, wrap_os_errors
from crisalad_jax.utils.progress import progress_bar

_ZIP, _TAR = (".zip",), (".tar", ".tar.gz", ".tgz", ".tar.bz2", ".tar.xz")


def is_archive(name: str) -> bool:
    """Return whether a file of this name is unpacked.

    Example:
        >>> is_archive("summer.tar.gz"), is_archive("names.txt")
        (True, False)
    """
    return name.lower().endswith(_ZIP + _TAR)


class _Member(NamedTuple):
    name: str
    is_folder: bool
    is_file: bool
    size: int
    contents: IO[bytes] | None


def unpack(archive: pathlib.Path, folder: pathlib.Path, *, quiet: bool = False) -> None:
    """Unpack a zip or tar archive into a folder.

    Links and devices are refused, as are names that lead out of the folder. Permissions, owners and
    times of the archive are not taken over.

    Args:
        archive: the archive.
        folder: where to; it may exist.
        quiet: whether to show no progress bar.

    Raises:
        InputError: it is damaged, holds something else than files and folders, a name that leads
            out of the folder, or more than the disk has room for; or the disk is full.
    """
    with archive.open("rb") as file:
        if is_html(file.read(512)):
            raise InputError(f"{archive}: found a page of HTML, expected an archive")
    label = f"unpacking {archive.name}"
    try:
        with (
            _members(archive) as (members, total),
            progress_bar(label, total / 1e6, "MB", quiet=quiet) as bar,
        ):
            with wrap_os_errors(folder):
                folder.mkdir(parents=True, exist_ok=True)
                _check_room(archive, folder, total)
            for member in members:
                target = _target(archive, folder, member)
                with wrap_os_errors(target):
                    if member.contents is None:
                        target.mkdir(parents=True, exist_ok=True)
                    else:
                        target.parent.mkdir(parents=True, exist_ok=True)
                        with target.open("wb") as out:
                            shutil.copyfileobj(member.contents, out, 2**20)
                bar.advance(member.size / 1e6)
    except (
        *(zipfile.BadZipFile, tarfile.TarError, zlib.error, EOFError, NotImplementedError),
        RuntimeError,  # a zip with a password
    ) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{archive}: cannot be unpacked: {reason}, expected an archive") from error


def _check_room(archive: pathlib.Path, folder: pathlib.Path, size: int) -> None:
    free = shutil.disk_usage(folder).free
    if size > free:
        raise InputError(
            f"{archive}: found {size / 1e9:.1f} GB in it and {free / 1e9:.1f} GB of free disk, "
            "expected room for all"
        )


def _target(archive: pathlib.Path, folder: pathlib.Path, member: _Member) -> pathlib.Path:
    """Return where a member goes, if it may."""
    # As on any system: a name for Windows may lead out there.
    path = pathlib.PurePosixPath(member.name.replace("\\", "/"))
    leads_out = path.is_absolute() or ".." in path.parts or ":" in member.name.split("/")[0]
    if leads_out or "\0" in member.name or not (member.is_folder or member.is_file):
        what = "a name that leads out of the folder" if leads_out else "a link or a device"
        raise InputError(f"{archive}: {member.name}: found {what}, expected files and folders")
    return folder.joinpath(*path.parts)


@contextlib.contextmanager
def _members(archive: pathlib.Path) -> Iterator[tuple[Iterator[_Member], int]]:
    """Yield an archive's members, one after the other, and the bytes of all."""
    if archive.name.lower().endswith(_ZIP):
        with zipfile.ZipFile(archive) as opened:
            yield _of_zip(opened), sum(info.file_size for info in opened.infolist())
    else:
        # The sizes of a compressed tar are known after reading it all.
        with tarfile.open(archive, "r|*") as opened:
            yield _of_tar(opened), os.path.getsize(archive)


def _of_zip(opened: zipfile.ZipFile) -> Iterator[_Member]:
    for info in opened.infolist():
        kind = stat.S_IFMT(info.external_attr >> 16)
        is_file = not info.is_dir() and kind in (0, stat.S_IFREG)
        if not is_file:
            yield _Member(info.filename, info.is_dir(), False, 0, None)
            continue
        with opened.open(info) as contents:
            yield _Member(info.filename, False, True, info.file_size, contents)


def _of_tar(opened: tarfile.TarFile) -> Iterator[_Member]:
    for info in opened:
        contents = opened.extractfile(info) if info.isreg() else None
        yield _Member(info.name, info.isdir(), info.isreg(), info.size, contents)
