"""Read the layout of GSV-Cities (Ali-bey et al. 2022).

`Dataframes/{city}.csv` has one row per image, and the image is
`Images/{city_id}/{city_id}_{place_id:07d}_{year:04d}_{month:02d}_{northdeg:03d}_{lat}_{lon}_{panoid}.jpg`.
"""

import collections
import functools
import operator
import pathlib
from collections.abc import Callable, Sequence

from crisalad_jax.data.images import OnBadImage
from crisalad_jax.data.named_places import FoundPlace, View
from crisalad_jax.data.tables import Disk, normal_name, read_table
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn

COLUMNS = ("place_id", "year", "month", "northdeg", "city_id", "lat", "lon", "panoid")
IDS_PER_CITY = 10**5

_Listing = Callable[[str], tuple[str, dict[str, str]]]
"""Folder in Images/ as a table names it -> its name on disk, and the names in it."""


def read_gsv_cities(
    root: pathlib.Path, cities: Sequence[str] | None, on_bad_image: OnBadImage
) -> tuple[tuple[str, ...], list[FoundPlace]]:
    """Return the cities, and their places ascending by id.

    Images may end in .jpg or .JPG, and may lie in a folder named by the city id or by the CSV file.

    Raises:
        InputError: a city that is unknown or named twice, a bad row, or a row without its image.
    """
    folder = root / "Dataframes"
    tables = {path.stem: path for path in sorted(folder.glob("*.csv"))}
    chosen = tuple(tables if cities is None else cities)
    if not chosen or len(set(chosen)) < len(chosen) or not tables.keys() >= set(chosen):
        raise InputError(
            f"cities (--cities): found {', '.join(chosen) or 'none'}, expected some of those in "
            f"{folder}, each once: {', '.join(tables) or 'found no CSV file'}"
        )
    disk = Disk()

    @functools.cache
    def listing(folder: str) -> tuple[str, dict[str, str]]:
        path = disk.find(root / "Images", folder)
        return ("", {}) if path is None else (path.name, disk.names(path))

    return chosen, [
        FoundPlace(number * IDS_PER_CITY + place, f"{place} of {city}", images, city=number)
        for number, city in enumerate(chosen)
        for place, images in sorted(_read_city(tables[city], listing, on_bad_image).items())
    ]


def _read_city(
    path: pathlib.Path, listing: _Listing, on_bad_image: OnBadImage
) -> dict[int, dict[str, View]]:
    """Return each place's images; a row that repeats an earlier one counts once."""
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
        place %= IDS_PER_CITY
        stem = (
            f"{city_id}_{place:07d}_{year:04d}_{month:02d}_{north:03d}"
            f"_{latitude}_{longitude}_{panorama}"
        )
        image = _find_image(listing, (city_id, path.stem), stem)
        if image is not None:
            places[place][image] = view
        elif on_bad_image == "skip":
            missing += 1
        else:
            raise InputError(
                f"{path}: line {line}: found no file Images/{city_id}/{stem}.jpg (nor .JPG, nor "
                f"under Images/{path.stem}/), expected the images of all rows; --cities reads the "
                "cities that it names alone"
            )
    if missing:
        warn(f"{path}: left out {missing} rows, whose images are missing")
    return places


def _find_image(listing: _Listing, folders: Sequence[str], stem: str) -> str | None:
    """Return the path of an image relative to the root; None where there is none."""
    for folder in folders:
        there, files = listing(folder)
        for name in (f"{stem}.jpg", f"{stem}.JPG"):
            if (file := files.get(name) or files.get(normal_name(name))) is not None:
                return f"Images/{there}/{file}"
    return None
