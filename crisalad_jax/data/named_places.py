"""Training places of any images: a folder or a table that says them, or by position or order.

No two images of one batch are negatives of each other while they are as near as two images of one
place may be: places that are too near for that are listed as such, and do not meet in a batch.
"""

import collections
import itertools
import math
import os
import pathlib
from typing import NamedTuple

import numpy as np

from crisalad_jax.data.benchmarks.on_disk import find_images, has_sides, has_split, listing
from crisalad_jax.data.images import OnBadImage, list_images
from crisalad_jax.data.metres import comparable
from crisalad_jax.data.positions import AXES, Positions, exif_positions, positions_of, utm_positions
from crisalad_jax.data.sources import ImageSource, check_rate_used, open_source
from crisalad_jax.data.tables import read_table
from crisalad_jax.data.video import file_of, frame_time, is_video
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.shapes import Float64, Int64

TABLE = "places.csv"
_COLUMNS = "name,place[,lat,lon[,heading]]"
_LAYOUTS = f"the layout of GSV-Cities (Dataframes/, Images/), {TABLE}, or one folder a place"
_GROUPED = "--place-radius METRES makes places by positions, --place-frames N of images in order"
_VIEW = {"lat": 90.0, "lon": 180.0, "heading": math.inf}
"""Columns of where an image was taken, and their largest numbers."""
_APART = 4
"""Radii between the centres of two places of a batch, at least. Images of one place are at most two
radii apart, and so those of two places are no nearer."""


class NamedPlaces(NamedTuple):
    """The images of each place by the place's name, and where they were taken."""

    root: pathlib.Path
    images: dict[str, list[str]]
    """Place -> paths relative to `root`."""
    views: dict[str, list[float]] | None = None
    """Image -> latitude, longitude and heading, NaN where unknown; None without positions."""
    near: dict[str, list[str]] | None = None
    """Place -> places too near to be in a batch with it; None where any two may be."""


def read_named_places(root: pathlib.Path, on_bad_image: OnBadImage) -> NamedPlaces:
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


def _read_folders(root: pathlib.Path) -> NamedPlaces:
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
                f"{path}: found an image next to the folders, expected it in the folder of its "
                f"place; {_GROUPED}"
            )
        images.setdefault(name.parent.as_posix(), []).append(name.as_posix())
    return NamedPlaces(root, images)


def _read_table(path: pathlib.Path, on_bad_image: OnBadImage) -> NamedPlaces:
    table = read_table(path, "name")
    given = [column for column in _VIEW if column in table.columns]
    # A heading is of use with a position alone.
    if "place" not in table.columns or given not in ([], [*_VIEW][:2], [*_VIEW]):
        raise InputError(
            f"{path}: found columns {', '.join(table.columns)}, expected {_COLUMNS}"
            + f"; {_GROUPED}" * ("place" not in table.columns)
        )
    rows = list(table.named_rows())
    if not rows:
        raise InputError(f"{path}: found no row below the header, expected {_COLUMNS}")
    root = path.parent
    places: dict[str, list[str]] = {}
    views: dict[str, list[float]] = {}
    missing = 0
    paths = find_images(path, root, [name for name, _ in rows], on_bad_image=on_bad_image)
    for image, (name, row) in zip(paths, rows, strict=True):
        place = row.fields["place"]
        if not place:
            raise InputError(f"{row.where}: found no place, expected {_COLUMNS}")
        if on_bad_image == "skip" and not image.is_file():
            missing += 1
            continue
        inside = image.is_relative_to(root)
        file = "/".join(image.parts[len(root.parts) :]) if inside else name
        places.setdefault(place, []).append(file)
        if given:
            views[file] = [
                row.number(column, most) if column in given else math.nan
                for column, most in _VIEW.items()
            ]
    if not places:
        raise InputError(f"{path}: found none of {missing} images, expected some")
    if missing:
        warn(f"{path}: left out {missing} of {len(rows)} images, which are missing")
    return NamedPlaces(root, places, views or None)


def places_by_position(
    root: pathlib.Path,
    radius: float,
    positions: str | os.PathLike[str] | None,
    fps: float | None,
    on_bad_image: OnBadImage,
) -> NamedPlaces:
    """Group images into places of a radius, each called by the name of the image at its centre.

    In the order of the images, one that is farther than the radius from all centres becomes a
    centre. Then every image is of the place with the nearest centre.

    Args:
        root: a source of images (`open_source`).
        radius: in metres.
        positions: a table (`read_positions`); None is what the source says, if that is a table,
            else what @UTM names say, else the EXIF data of JPEGs.
        fps: frames a second of videos.
        on_bad_image: as of `open_source`.

    Raises:
        InputError: the radius is not above 0; no image has a position; or what `open_source` and
            `read_positions` raise.
    """
    if not 0 < radius < math.inf:
        raise InputError(f"--place-radius: found {radius:g}, expected metres above 0")
    source = _open(root, fps, on_bad_image)
    found = _positions(source, root, positions)
    names = [name for name in source.names if name in found.of]
    if not names:
        raise InputError(
            f"{root}: found no position of {len(source.names)} images, which --place-radius asks "
            "for, expected --positions TABLE (name,lat,lon or name,east,north or name,x,y), such a "
            "table as --data, @UTM names or EXIF data; --place-frames takes images in order"
        )
    if len(names) < len(source.names):
        warn(
            f"{root}: left out {len(source.names) - len(names)} of {len(source.names)} images, "
            "which have no position"
        )
    points = np.array([found.of[name] for name in names], np.float64)
    if found.axes == AXES[1]:
        points = comparable(*points.T)
    centres, place, near = _divide(points, radius)
    called = [names[centre] for centre in centres]
    images: dict[str, list[str]] = {name: [] for name in called}
    for name, number in zip(names, place.tolist(), strict=True):
        images[called[number]].append(name)
    neighbours = {
        name: [called[other] for other in others if other != number]
        for number, (name, others) in enumerate(zip(called, near, strict=True))
    }
    return NamedPlaces(source.root, images, near=neighbours)


def places_by_order(
    root: pathlib.Path, frames: int, fps: float | None, on_bad_image: OnBadImage
) -> NamedPlaces:
    """Make a place of every so many images of a folder or video in order, called by the first one.

    A place and the next one of the same folder or video are too near for one batch.

    Args:
        root: a source of images (`open_source`).
        frames: number of images of a place.
        fps: frames a second of videos.
        on_bad_image: as of `open_source`.

    Raises:
        InputError: less than two frames, or what `open_source` raises.
    """
    if frames < 2:
        raise InputError(f"--place-frames: found {frames}, expected at least 2")
    source = _open(root, fps, on_bad_image)
    sequences: dict[pathlib.Path, list[str]] = collections.defaultdict(list)
    for path, name in zip(source.paths, source.names, strict=True):
        sequences[path.parent if frame_time(path) is None else file_of(path)].append(name)
    images: dict[str, list[str]] = {}
    near: dict[str, list[str]] = {}
    for sequence in sequences.values():
        parts = [sequence[start : start + frames] for start in range(0, len(sequence), frames)]
        images |= {part[0]: part for part in parts}
        near |= {part[0]: [] for part in parts}
        for (first, *_), (second, *_) in itertools.pairwise(parts):
            near[first].append(second)
            near[second].append(first)
    return NamedPlaces(source.root, images, near=near)


def _open(root: pathlib.Path, fps: float | None, on_bad_image: OnBadImage) -> ImageSource:
    if (root / "Dataframes").is_dir():
        raise InputError(
            f"{root}: found the layout of GSV-Cities, which has places, expected it without "
            "--place-radius and --place-frames"
        )
    source = open_source(root, fps=fps, on_bad_image=on_bad_image)
    check_rate_used(fps, source.paths)
    return source


def _positions(
    source: ImageSource, root: pathlib.Path, table: str | os.PathLike[str] | None
) -> Positions:
    if table is None:
        found = source.positions or utm_positions(source.names)
        pictures = [path for path in source.paths if frame_time(path) is None]
        if found.of or len(pictures) < len(source.paths):
            return found
        return exif_positions(zip(source.names, pictures, strict=True))
    return positions_of(table, source.names, root)


def _divide(
    points: Float64[np.ndarray, "images axis"], radius: float
) -> tuple[list[int], Int64[np.ndarray, " images"], list[list[int]]]:
    """Return the images at the centres, each image's place, and the places near each place."""
    from scipy.spatial import KDTree  # takes a fifth of a second, which few readers need

    tree = KDTree(points)
    centres: list[int] = []
    is_near = np.zeros(len(points), bool)
    for image, point in enumerate(points):
        if not is_near[image]:
            centres.append(image)
            is_near[tree.query_ball_point(point, radius)] = True
    tree = KDTree(points[centres])
    near = tree.query_ball_point(points[centres], _APART * radius, return_sorted=True)
    return centres, np.asarray(tree.query(points)[1]), list(near)
