"""Training places of one's own: one folder a place, or a table of names and places."""

import math
import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from crisalad_jax.data.benchmarks.folders_on_disk import find_images, has_sides, has_split, listing
from crisalad_jax.data.images import OnBadImage, list_images
from crisalad_jax.data.named_table import NamedRow, named_rows
from crisalad_jax.data.video import is_video
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.shapes import Float64

TABLE = "places.csv"
_COLUMNS = "name,place[,lat,lon[,heading]]"
_LAYOUTS = f"the layout of GSV-Cities (Dataframes/, Images/), {TABLE}, or one folder a place"
_GROUPED = "--place-radius METRES makes places by positions, --place-frames N of images in order"
_VIEW = ("lat", "lon", "heading")


class OwnPlaces(NamedTuple):
    """The images of each place by the place's name, and where they were taken."""

    root: pathlib.Path
    images: dict[str, list[str]]
    """Place -> paths relative to `root`."""
    views: dict[str, tuple[float, float, float]] | None
    """Image -> latitude, longitude and heading, NaN where unknown; None without positions."""
    near: dict[str, list[str]] | None = None
    """Place -> places too near to be in a batch with it; None where any two may be."""


def read_own_places(root: pathlib.Path, on_bad_image: OnBadImage) -> OwnPlaces:
    """Read a table, a folder with a table in it, or a folder with one folder a place.

    Under "skip" a note counts the images of the table that are missing, and they are left out.

    Raises:
        InputError: it is none of these, or what is there does not fit.
    """
    if is_video(root):
        raise InputError(f"{root}: found a video, expected places: {_GROUPED}")
    if root.is_file():
        return _read_table(root, on_bad_image)
    if (root / TABLE).is_file():
        return _read_table(root / TABLE, on_bad_image)
    return _read_folders(root)


def views_in_order(found: OwnPlaces, files: list[str]) -> Float64[np.ndarray, "images 3"] | None:
    """Return where files were taken, in their order."""
    if found.views is None:
        return None
    return np.array([found.views[file] for file in files], np.float64).reshape(-1, 3)


def _read_folders(root: pathlib.Path) -> OwnPlaces:
    """Read a folder in which each folder that holds images is a place."""
    if has_sides(root) or has_split(root):
        raise InputError(
            f"{root}: found an evaluation set (database/ and queries/), expected {_LAYOUTS}"
        )
    inside = root.is_dir() and any(
        not path.name.startswith(".") and path.is_dir() for path in root.iterdir()
    )
    if not inside:
        raise InputError(f"{root}: found {listing(root)}, expected {_LAYOUTS}; {_GROUPED}")
    images: dict[str, list[str]] = {}
    for path in list_images(root):
        name = path.relative_to(root)
        if name.parent == pathlib.Path():
            raise InputError(
                f"{path}: found an image beside the folders, expected it in the folder of its "
                f"place; {_GROUPED}"
            )
        images.setdefault(name.parent.as_posix(), []).append(name.as_posix())
    return OwnPlaces(root, images, None)


def _read_table(table: pathlib.Path, on_bad_image: OnBadImage) -> OwnPlaces:
    rows: list[tuple[str, str, tuple[float, float, float] | None]] = []
    for row in named_rows(table, lambda header: _check_header(table, header)):
        place = row.fields["place"]
        if not place:
            raise InputError(f"{row.where}: found no place, expected {_COLUMNS}")
        rows.append((row.name, place, _view(row) if "lat" in row.fields else None))
    if not rows:
        raise InputError(f"{table}: found no row below the header, expected {_COLUMNS}")
    places: dict[str, list[str]] = {}
    views: dict[str, tuple[float, float, float]] = {}
    names = [name for name, _, _ in rows]
    paths = find_images(table, table.parent, names, on_bad_image=on_bad_image)
    depth = len(table.parent.parts)
    missing = 0
    for path, (name, place, view) in zip(paths, rows, strict=True):
        if on_bad_image == "skip" and not path.is_file():
            missing += 1
            continue
        file = "/".join(path.parts[depth:]) if path.is_relative_to(table.parent) else name
        places.setdefault(place, []).append(file)
        if view is not None:
            views[file] = view
    if not places:
        raise InputError(f"{table}: found none of {missing} images, expected some")
    if missing:
        warn(f"{table}: left out {missing} of {len(rows)} images, which are missing")
    return OwnPlaces(table.parent, places, views or None)


def _check_header(table: pathlib.Path, header: Sequence[str]) -> None:
    known = {"name", "place", *_VIEW}
    twice = [name for name in header if name in known and header.count(name) > 1]
    halves = ("lat" in header) != ("lon" in header) or ("heading" in header and "lat" not in header)
    if twice or halves or not {"name", "place"} <= set(header):
        raise InputError(
            f"{table}: found columns {', '.join(header) or 'none'}, expected {_COLUMNS}"
            + f"; {_GROUPED}" * ("name" in header and "place" not in header)
        )


def _view(row: NamedRow) -> tuple[float, float, float]:
    """Read latitude, longitude and heading in degrees."""
    values = []
    for column, limit in zip(_VIEW, (90.0, 180.0, math.inf), strict=True):
        if column not in row.fields:
            values.append(math.nan)
            continue
        value = row.number(column)
        if not (math.isfinite(value) and abs(value) <= limit):
            found = row.fields[column]
            raise InputError(f"{row.where}: {column}: found {found!r}, expected degrees")
        values.append(value)
    return values[0], values[1], values[2]
