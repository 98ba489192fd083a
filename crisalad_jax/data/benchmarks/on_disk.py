"""Find folders, splits and images of evaluation sets on disk."""

import os
import pathlib
from collections.abc import Iterable, Sequence

from crisalad_jax.data.images import OnBadImage, list_images
from crisalad_jax.data.remote import is_file, is_folder, list_names
from crisalad_jax.data.tables import Disk
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import real_path

SPLITS = ("test", "val", "train")


def find_database(folder: pathlib.Path) -> pathlib.Path:
    """Return the path of `database/` in a folder, or of `gallery/` (SVOX) if only that exists."""
    gallery = folder / "gallery"
    database = folder / "database"
    return gallery if is_folder(gallery) and not is_folder(database) else database


def has_sides(folder: pathlib.Path) -> bool:
    """Return whether a folder itself holds `database/` (or `gallery/`) and `queries/`."""
    return is_folder(find_database(folder)) and is_folder(folder / "queries")


def list_part(folder: pathlib.Path) -> tuple[pathlib.Path, ...]:
    """List the images under a folder and its subfolders, sorted by path.

    Raises:
        InputError: there is no such folder (the message lists its siblings), or no image in it.
    """
    if not folder.is_dir():
        parent = folder.parent
        raise InputError(f"{parent}: found {listing(parent)}, expected a folder {folder.name}")
    return tuple(list_images(folder))


def listing(folder: pathlib.Path) -> str:
    """Describe the contents of a folder for a message."""
    if not is_folder(folder):
        return "a file" if is_file(folder) else "no such folder"
    return shown(name + "/" * is_folder(folder / name) for name in list_names(folder))


def shown(names: Iterable[str]) -> str:
    """Join the first eight names for a message, and count the others."""
    ordered = sorted(names)
    some = ", ".join(ordered[:8]) or "nothing"
    return f"{some} and {len(ordered) - 8} more" if len(ordered) > 8 else some


def has_split(root: pathlib.Path) -> bool:
    """Return whether any of `images/{test,val,train}` exists."""
    return any(is_folder(root / "images" / split) for split in SPLITS)


def find_split(root: pathlib.Path, split: str | None) -> tuple[pathlib.Path, str]:
    """Return the folder that holds database/ and queries/, and a name such as "pitts30k/test".

    The folder is `root/images/{split}`. Without `split`, it is `root` itself or, if that does not
    hold them, the first of test and val that exists.

    Raises:
        InputError: there is no such folder.
    """
    # Resolved, so that a root of "." has a name to print too.
    resolved = real_path(root)
    if split is None and has_sides(root):
        if resolved.parent.name == "images":
            return root, f"{resolved.parent.parent.name}/{resolved.name}"
        return root, resolved.name
    splits = [name for name in SPLITS if (root / "images" / name).is_dir()]
    split = split or next((name for name in splits if name != "train"), "test")
    if split not in splits:
        raise InputError(
            f"{root}: found {listing(root)} and splits {', '.join(splits) or 'none'}, expected "
            f"images/{split} with database/ and queries/"
        )
    return root / "images" / split, f"{resolved.name}/{split}"


def find_images(
    named_by: pathlib.Path,
    names: Sequence[str],
    images: str | os.PathLike[str] | None,
    on_bad_image: OnBadImage,
    folders: Sequence[str] = (".",),
) -> tuple[pathlib.Path, ...]:
    """Return the paths of the images that a file names, in its order, as spelled on disk.

    Args:
        named_by: the file, such as a list or a table.
        names: the names of the images in the file.
        images: the folder of the images; None tries the file's folder, then its parent.
        on_bad_image: "stop" refuses missing images; "skip" returns paths for them, too.
        folders: subfolders of `images` that names may be relative to; the first that has any of the
            images is used.

    Raises:
        InputError: images are missing (under "skip": all of them); the message names the first.
    """
    near = (named_by.parent, named_by.parent.absolute().parent)
    tops = near if images is None else (pathlib.Path(images),)
    roots = [top / folder for top in tops for folder in folders]
    disk = Disk(roots[0])
    there = [root for root in roots if is_folder(root)]
    found = (root for root in there if any(disk.find(root, name) is not None for name in names))
    root = next(found, roots[0])
    paths = [disk.find(root, name) for name in names]
    missing = [name for name, path in zip(names, paths, strict=True) if path is None]
    if missing and (on_bad_image == "stop" or len(missing) == len(names)):
        raise InputError(
            f"{named_by}: found {len(missing)} of {len(names)} images missing, expected all in one "
            f"of {', '.join(map(str, roots))} (--images); the first is {missing[0]}"
        )
    return tuple(path or root / name for name, path in zip(names, paths, strict=True))
