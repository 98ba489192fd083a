"""Find training places in GSV-Cities, MSLS, a folder or a table, or by position or order.

GSV-Cities (Ali-bey et al. 2022) has `Dataframes/{city}.csv` with one row per image, which is
`Images/{city_id}/{city_id}_{place_id:07d}_{year:04d}_{month:02d}_{northdeg:03d}_{lat}_{lon}_{panoid}.jpg`.

Two places can be so close that their images are no farther apart than images of one place. Such
places are listed as `near` each other and never share a batch, so they are never negatives.
"""

import collections
import functools
import itertools
import math
import operator
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from crisalad_jax.data.benchmarks.msls import MSLS_CITIES, city_folders, read_side
from crisalad_jax.data.benchmarks.on_disk import find_images, has_sides, has_split, listing
from crisalad_jax.data.frames import by_sequence, has_frames
from crisalad_jax.data.images import OnBadImage, is_image, list_images
from crisalad_jax.data.metres import comparable
from crisalad_jax.data.positions import AXES
from crisalad_jax.data.remote import address_of, for_each, is_file, is_folder, is_remote, list_names
from crisalad_jax.data.sources import ImageSource
from crisalad_jax.data.tables import Disk, normal_name, read_table
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.shapes import Float64, Int64

COLUMNS = ("place_id", "year", "month", "northdeg", "city_id", "lat", "lon", "panoid")
"""Columns of GSV-Cities' tables."""
_IDS_PER_CITY = 10**5
TABLE = "places.csv"
_COLUMNS = "name,place[,lat,lon[,heading]][,city]"
_LAYOUTS = (
    f"the layout of GSV-Cities (Dataframes/, Images/) or MSLS, {TABLE}, or one folder a place"
)
_GROUPED = "--place-radius METRES makes places by positions, --place-frames N of images in order"
_VIEW = ("lat", "lon", "heading")
"""Columns of an image's position and heading."""
_APART = 4
"""Smallest distance between the centres of two places of a batch, in radii. Images of one place are
at most two radii apart, and those of two places at least two."""

View = Sequence[float]
"""Latitude, longitude and heading of an image in degrees; NaN for an unknown heading."""


class FoundPlace(NamedTuple):
    """A training place as found by a reader; `city` is an index in the reader's list of cities."""

    name: str
    images: Mapping[str, View | None]
    """View of each image by its path relative to the root; None if its position is unknown."""
    near: Sequence[int] = ()
    """Indices of places that are too close to share a batch with this one."""
    city: int = 0


def read_gsv_cities(
    root: pathlib.Path, cities: Sequence[str] | None, on_bad_image: OnBadImage
) -> tuple[tuple[str, ...], list[FoundPlace]]:
    """Return the names of the cities of GSV-Cities, and their places sorted by id.

    Images may end in .jpg or .JPG, and may be in a folder named after the city id or the CSV file.

    Raises:
        InputError: a city is unknown or named twice, a row is not valid, or its image is missing.
    """
    folder = root / "Dataframes"
    paths = (folder / name for name in sorted(list_names(folder)))
    tables = {path.stem: path for path in paths if path.suffix == ".csv" and path.name[0] != "."}
    chosen = tuple(tables if cities is None else cities)
    if not chosen or len(set(chosen)) < len(chosen) or not tables.keys() >= set(chosen):
        raise InputError(
            f"cities (--cities): found {', '.join(chosen) or 'none'}, expected some of those in "
            f"{folder}, each once: {', '.join(tables) or 'found no CSV file'}"
        )
    return chosen, [
        FoundPlace(f"{place} of {city}", images, city=number)
        for number, city in enumerate(chosen)
        for place, images in sorted(_read_city(root, tables[city], on_bad_image).items())
    ]


def _read_city(
    root: pathlib.Path, path: pathlib.Path, on_bad_image: OnBadImage
) -> dict[int, dict[str, View]]:
    """Return each place's images; a row that repeats an earlier one counts once."""
    disk = Disk()

    @functools.cache
    def listing(folder: str) -> tuple[str, dict[str, str]]:
        """Return a folder's name on disk, and the names in it."""
        there = disk.find(root / "Images", folder)
        return ("", {}) if there is None else (there.name, disk.names(there))

    def find(folders: Sequence[str], stem: str) -> str | None:
        """Return the path of an image relative to the root; None if there is none."""
        for folder in folders:
            there, files = listing(folder)
            for name in (f"{stem}.jpg", f"{stem}.JPG"):
                if (file := files.get(name) or files.get(normal_name(name))) is not None:
                    return f"Images/{there}/{file}"
        return None

    places: dict[int, dict[str, View]] = collections.defaultdict(dict)
    missing = 0
    table = read_table(path, *COLUMNS)
    fields = operator.itemgetter(*map(table.columns.index, COLUMNS))
    for line, row in table.lines:
        *numbers, city_id, latitude, longitude, panorama = fields(row)
        try:
            place, year, month, north = map(int, numbers)
            view = (float(latitude), float(longitude), float(north))
        except ValueError as error:
            raise InputError(
                f"{path}: line {line}: found {', '.join(fields(row)[:-1])}, expected whole numbers "
                "for place_id, year, month and northdeg, and degrees for lat and lon"
            ) from error
        place %= _IDS_PER_CITY
        stem = (
            f"{city_id}_{place:07d}_{year:04d}_{month:02d}_{north:03d}"
            f"_{latitude}_{longitude}_{panorama}"
        )
        if (image := find((city_id, path.stem), stem)) is not None:
            places[place][image] = view
        elif on_bad_image == "skip":
            missing += 1
        else:
            raise InputError(
                f"{path}: line {line}: found no file Images/{city_id}/{stem}.jpg (nor .JPG, nor "
                f"under Images/{path.stem}/), expected the images of all rows; --cities reads "
                "only the cities that it names"
            )
    if missing:
        warn(f"{path}: left out {missing} rows, whose images are missing")
    return places


def read_msls_places(
    root: pathlib.Path, cities: Sequence[str] | None, on_bad_image: OnBadImage
) -> tuple[tuple[str, ...], list[FoundPlace]]:
    """Return the cities of MSLS as published, and their places: the clusters of its tables.

    If `cities` is None, they are those of the training set. A place has images of the database and
    of the queries; panoramas are left out.

    Raises:
        InputError: there are no such cities; a table is not valid; or an image is missing.
    """
    folders = city_folders(root, MSLS_CITIES["train"] if cities is None else cities)
    found: list[FoundPlace] = []
    for number, folder in enumerate(folders):
        places: dict[str, dict[str, View | None]] = collections.defaultdict(dict)
        for part in ("database", "query"):
            side = read_side(folder / part, on_bad_image, headings=True, clusters=True)
            views = np.column_stack([side.degrees, side.headings]).tolist()
            for path, cluster, view in zip(side.images, side.clusters.tolist(), views, strict=True):
                places[cluster][path.relative_to(root).as_posix()] = view
        found += [
            FoundPlace(f"{cluster} of {folder.name}", images, city=number)
            for cluster, images in places.items()
        ]
    return tuple(folder.name for folder in folders), found


def read_named_places(
    root: pathlib.Path, on_bad_image: OnBadImage
) -> tuple[pathlib.Path, tuple[str, ...], list[FoundPlace]]:
    """Read a table, a folder with a table in it, or a folder with one subfolder per place.

    Returns:
        The folder that the images' paths are relative to, the cities that the table names, and the
        places, ordered by city.

    Raises:
        InputError: `root` is none of these, the table is not valid, or an image is missing.
    """
    if is_file(root / TABLE):
        root = root / TABLE
    is_table = root.suffix.lower() == ".csv" if is_remote(root) else root.is_file()
    if is_table and not has_frames(root):
        return root.parent, *_read_table(root, on_bad_image)
    return root, (), _read_folders(root)


def _read_folders(root: pathlib.Path) -> list[FoundPlace]:
    """Read a folder in which each folder that holds images is a place."""
    inside = (name for name in list_names(root) if is_image(name) and name[0] != ".")
    flat = any(is_file(root / name) for name in inside)
    if flat or not is_folder(root) or has_sides(root) or has_split(root):
        raise InputError(
            f"{address_of(root)}: found {listing(root)}, expected {_LAYOUTS}, without an image "
            f"next to the folders; {_GROUPED}"
        )
    images: dict[str, dict[str, None]] = collections.defaultdict(dict)
    for path in list_images(root):
        name = path.relative_to(root)
        images[name.parent.as_posix()][name.as_posix()] = None
    return [FoundPlace(name, files) for name, files in images.items()]


def _read_table(
    path: pathlib.Path, on_bad_image: OnBadImage
) -> tuple[tuple[str, ...], list[FoundPlace]]:
    """Read the cities and places of a table; under "skip" a warning counts missing images."""
    table = read_table(path, "name", any_spelling=True)
    given = [column for column in _VIEW if column in table.columns]
    # A heading is only useful with a position.
    if "place" not in table.columns or given not in ([], ["lat", "lon"], [*_VIEW]):
        raise InputError(
            f"{path}: found columns {', '.join(table.columns)}, expected {_COLUMNS}; {_GROUPED}"
        )
    rows, root = list(table.named_rows()), path.parent
    paths = find_images(path, [name for name, _ in rows], root, on_bad_image)
    has_cities = "city" in table.columns
    places: dict[tuple[str, str], dict[str, View | None]] = collections.defaultdict(dict)
    missing = 0
    found = for_each(is_file, paths) if on_bad_image == "skip" else itertools.repeat(True)
    for image, is_there, (name, row) in zip(paths, found, rows):  # noqa: B905, `found` repeats
        place = row.text("city") if has_cities else "", row.text("place")
        if not is_there:
            missing += 1
            continue
        inside = image.is_relative_to(root)
        file = "/".join(image.parts[len(root.parts) :]) if inside else name
        view = [row.number(column) if column in given else math.nan for column in _VIEW]
        places[place][file] = view if given else None
    if missing:
        warn(f"{path}: left out {missing} of {len(rows)} images, which are missing")
    cities = tuple(sorted({city for city, _ in places}))
    found = [
        FoundPlace(f"{name} of {city}" if city else name, files, city=cities.index(city))
        for (city, name), files in places.items()
    ]
    return cities if has_cities else (), sorted(found, key=lambda place: place.city)


def places_by_position(
    source: ImageSource, radius: float, positions: str | os.PathLike[str] | None
) -> list[FoundPlace]:
    """Group images into places of a given radius, each named after the image at its centre.

    In order, each image that is farther than the radius from all previous centres becomes a centre.
    Then every image joins the place with the nearest centre.

    Args:
        source: the images.
        radius: radius of a place in metres.
        positions: a table (`read_image_table`) or track (`read_track`); None takes the positions of
            the source, else those in @UTM names, else those in the EXIF data of JPEGs.

    Raises:
        InputError: no image has a position, or the table or track is not valid.
    """
    found = source.located(positions)
    names = [name for name in source.names if name in found.of]
    if not names:
        raise InputError(
            f"{source.root}: found no position of {len(source.names)} images, expected --positions "
            "TABLE (name,lat,lon or name,east,north or name,x,y), such a table as --data, @UTM "
            "names or EXIF data; --place-frames takes images in order"
        )
    if len(names) < len(source.names):
        warn(
            f"{source.root}: left out {len(source.names) - len(names)} of {len(source.names)} "
            "images, which have no position"
        )
    points = np.array([found.of[name] for name in names], np.float64)
    if found.axes == AXES[1]:
        points = comparable(*points.T)
    centres, place, near = _divide(points, radius)
    images: list[dict[str, None]] = [{} for _ in centres]
    for name, number in zip(names, place.tolist(), strict=True):
        images[number][name] = None
    return [
        FoundPlace(names[centre], files, [other for other in others if other != number])
        for number, (centre, files, others) in enumerate(zip(centres, images, near, strict=True))
    ]


def places_by_order(source: ImageSource, frames: int) -> list[FoundPlace]:
    """Make places of `frames` consecutive images of a folder or video, named after the first.

    Consecutive places of one folder or video are too close to share a batch.
    """
    places: list[FoundPlace] = []
    for sequence in by_sequence(source.paths):
        first, last = len(places), len(places) + (len(sequence) - 1) // frames
        for number in range(first, last + 1):
            start = (number - first) * frames
            part = [source.names[image] for image in sequence[start : start + frames]]
            near = [each for each in (number - 1, number + 1) if first <= each <= last]
            places.append(FoundPlace(part[0], dict.fromkeys(part), near))
    return places


def _divide(
    points: Float64[np.ndarray, "images axis"], radius: float
) -> tuple[list[int], Int64[np.ndarray, " images"], list[list[int]]]:
    """Return the images at the centres, each image's place, and the places near each place."""
    from scipy.spatial import KDTree  # the import takes a fifth of a second

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
