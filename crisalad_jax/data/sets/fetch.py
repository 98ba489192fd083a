"""Download a public data set, and arrange it as `evaluate` and `train` read it."""

import os
import pathlib
import shutil
import subprocess
from collections.abc import Iterator

from crisalad_jax.config.checks import PATH, require, takes
from crisalad_jax.data.benchmarks.on_disk import listing
from crisalad_jax.data.images import list_images
from crisalad_jax.data.sets.table import PublishedSet, SetFile, find_set
from crisalad_jax.data.sets.unpack import is_archive, unpack
from crisalad_jax.utils import hub
from crisalad_jax.utils.checksums import sha256_of
from crisalad_jax.utils.download import OFFLINE, download, is_offline
from crisalad_jax.utils.errors import InputError, locate_errors
from crisalad_jax.utils.files import check_new_folder, read_text, wrap_os_errors
from crisalad_jax.utils.locks import lock

_ROOM = 2.1
"""Disk space needed, as a multiple of the download: the archive and its contents."""

_LAYOUTS = ("images", "train_val")
"""Folders that belong to a layout, unlike other folders around a set."""


@takes(to=PATH)
def fetch_set(name: str, to: str | os.PathLike[str], *, quiet: bool = False) -> pathlib.Path:
    """Download a public data set into a new folder.

    Unfinished downloads are in a folder `to`.part next to it, from which the next call resumes. The
    folder `to` appears when everything is complete.

    Args:
        name: name of a set in `SETS`.
        to: folder for the set, new or empty.
        quiet: whether to hide progress bars.

    Returns:
        The path of the folder.

    Raises:
        InputError: there is no such set, or only a person can get it; `to` is not empty; the
            network is forbidden; the disk lacks space; a download fails or an archive is damaged;
            or the files are not those of the set.
        ModuleNotFoundError: the set is on Hugging Face or Kaggle, and the extra `data` is missing.

    Example:
        >>> fetch_set("msls", folder / "msls")
        Traceback (most recent call last):
        ...
        crisalad_jax.utils.errors.InputError: msls: found a set that only a person can get...
    """
    published, to = find_set(name), pathlib.Path(to)
    require(
        published.is_fetched,
        f"{name}: found a set that only a person can get ({published.ask}), expected one to "
        f"download; `crisalad data list {name}` lists the steps by hand",
    )
    check_new_folder(to)
    require(not is_offline(), f"{name}: {OFFLINE} forbids the network")
    work = to.with_name(f"{to.name}.part")
    _check_room(published, to, work)
    with locate_errors(before=f"{name}: "), lock(work):
        made = work / "made"
        with wrap_os_errors(work):
            shutil.rmtree(made, ignore_errors=True)
            _bring(published, work, quiet=quiet)
            _arrange(published, work / "files", made)
            os.replace(made, to)
            shutil.rmtree(work)
    return to


def _check_room(published: PublishedSet, to: pathlib.Path, work: pathlib.Path) -> None:
    """Check that the disk has room for the files and their contents, if their size is known.

    Files downloaded by an earlier call already take part of that room.
    """
    nearest = next(each for each in to.absolute().parents if each.exists())
    there = sum(path.stat().st_size for path in work.rglob("*") if path.is_file())
    free = (shutil.disk_usage(nearest).free + there) / 1e9
    needed = (published.gigabytes or 0) * _ROOM
    require(
        free > needed,
        f"{to}: found {free:.1f} GB of free disk, expected {needed:.1f} GB for {published.name} "
        f"({published.gigabytes} GB, packed and unpacked)",
    )


def _bring(published: PublishedSet, work: pathlib.Path, *, quiet: bool) -> None:
    """Download a set's files into work/archives, and unpack them into work/files."""
    files, archives = work / "files", work / "archives"
    archives.mkdir(exist_ok=True)
    for file in published.files:
        if published.host == "kaggle":
            shutil.rmtree(files, ignore_errors=True)
            os.replace(hub.download_kaggle(file.address, archives, quiet=quiet), files)
            continue
        if published.host == "rsync":
            _rsync(file.address, files, quiet=quiet)
            continue
        archive = archives / file.name
        if not archive.is_file():
            archive = _download(published, file, archives, quiet=quiet)
        target = files / file.into
        shutil.rmtree(target, ignore_errors=True)
        try:
            if file.sha256 is not None and (found := sha256_of(archive)) != file.sha256:
                words = f"found SHA-256 {found[:12]}..., expected {file.sha256[:12]}..."
                raise InputError(f"{archive}: {words}")
            _open(file, archive, target, quiet=quiet)
        except InputError:
            archive.unlink(missing_ok=True)  # download a damaged file again
            raise


def _download(
    published: PublishedSet, file: SetFile, archives: pathlib.Path, *, quiet: bool
) -> pathlib.Path:
    if published.host == "huggingface":
        where = {"is_dataset": True, "folder": archives, "quiet": quiet}
        return hub.download_file(hub.HubAddress(file.address, None, file.file), **where)
    target = archives / file.name
    download(file.address, target, label=file.name, quiet=quiet)
    return target


def _rsync(address: str, folder: pathlib.Path, *, quiet: bool) -> None:
    """Copy a folder with rsync, which resumes where it was interrupted."""
    require(shutil.which("rsync") is not None, f"{address}: found no program rsync, expected one")
    shown = ["--quiet"] if quiet else ["--info=progress2"]
    command = ["rsync", "-rtz", "--partial", *shown, f"{address}/", str(folder)]
    done = subprocess.run(command, check=False, stderr=subprocess.PIPE, text=True)
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise InputError(f"{address}: found rsync's code {done.returncode} ({said}), expected 0")


def _open(file: SetFile, archive: pathlib.Path, target: pathlib.Path, *, quiet: bool) -> None:
    """Unpack an archive and any archive in it, or copy a file to its place."""
    if not is_archive(archive.name):
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(archive, target)
        return
    unpack(archive, target, quiet=quiet)
    if file.inside:
        inner = _found(target, file.inside)
        unpack(inner, target, quiet=quiet)
        inner.unlink()


def _found(folder: pathlib.Path, name: str) -> pathlib.Path:
    """Find a file or folder by its name, at any depth; the first by depth and name."""
    there = sorted(folder.rglob(name), key=lambda path: (len(path.parts), path))
    if not there:
        raise InputError(f"{folder}: found {listing(folder)}, expected {name}")
    return there[0]


def _arrange(published: PublishedSet, files: pathlib.Path, made: pathlib.Path) -> None:
    """Arrange a set's files as `evaluate` and `train` read them.

    Raises:
        InputError: they are not those of the set.
    """
    if published.pairs:
        moves = _pairs(published, files)
    elif published.frames:
        moves = _frames(published, files)
    else:
        top = _top(files)
        for old, new in published.renamed.items():
            os.replace(_found(top, old), top / new)
        os.replace(top, made)
        return
    for source, name in list(moves):  # find all before moving any
        target = made / "images" / "test" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(source, target)


def _top(folder: pathlib.Path) -> pathlib.Path:
    """Return the folder that holds a set, below any outer folders of its archive."""
    while True:
        there = [path for path in folder.iterdir() if not path.name.startswith((".", "__MACOSX"))]
        if len(there) != 1 or not there[0].is_dir() or there[0].name in _LAYOUTS:
            return folder
        folder = there[0]


def _pairs(published: PublishedSet, files: pathlib.Path) -> Iterator[tuple[pathlib.Path, str]]:
    """Yield the images of a set of pairs, and their new names: placeholder positions 1 km apart."""
    sides = {
        side: {path.stem: path for path in list_images(_found(files, folder))}
        for side, folder in published.pairs.items()
    }
    numbers, others = (set(images) for images in sides.values())
    wrong = sorted((numbers ^ others) | {name for name in numbers if not name.isdecimal()})
    if wrong:
        raise InputError(
            f"{files}: found {len(wrong)} images without their pair ({wrong[0]}), expected numbers "
            f"as names, and the same in {' and '.join(published.pairs.values())}"
        )
    for side, images in sides.items():
        for stem, path in images.items():
            yield path, f"{side}/@0@{1000 * int(stem)}@@@@@{stem}@@@@@@@@{path.suffix}"


def _frames(published: PublishedSet, files: pathlib.Path) -> Iterator[tuple[pathlib.Path, str]]:
    """Yield the listed frames of two rides, and their new names: positions `metres` apart."""
    how = published.frames
    lines = read_text(files / how["names"], "a list of frames").split()
    names = [line.rpartition("/")[2] for line in lines]
    for side in ("database", "queries"):
        images = {path.name: path for path in list_images(files / how[side])}
        missing = [name for name in names if name not in images]
        if missing or not names:
            raise InputError(
                f"{files / how[side]}: found {len(missing)} of {len(names)} listed frames missing "
                f"({''.join(missing[:1])}), expected all"
            )
        for number, name in enumerate(names):
            north = f"{number * how['metres']:07.1f}"
            suffix = images[name].suffix
            yield images[name], f"{side}/@0@{north}@@@@@{number:05}@@@@@@@@{suffix}"
