"""The city on disk: its views, its two layouts, and the check whether it can be reused."""

import dataclasses
import math
import os
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from crisalad_jax.config.checks import check_seed, check_types
from crisalad_jax.experiments.synthetic.picture import render
from crisalad_jax.experiments.synthetic.scenes import build_place
from crisalad_jax.experiments.synthetic.view import (
    EYE,
    PITCH,
    SEASONS,
    TIMES,
    WEATHERS,
    Season,
    Time,
    View,
    check_size,
)
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json, wrap_os_errors, write_json
from crisalad_jax.utils.temporaries import in_use, made_folder, temporary_beside

CITY_NAMES = ("Alderby", "Brackwater")
"""Names of the training cities, which are invented."""
RENDERER = 1
"""Version of the renderer: increase it if pictures change, and cities on disk no longer match."""
PLACE_SPACING = 80.0
"""Metres between neighbouring places: more than three times the 25 m that make a positive."""
MONTHS: dict[Season, int] = {"spring": 4, "summer": 7, "autumn": 10, "winter": 1}
METRES_PER_DEGREE = 111_195.0
"""Metres in a degree of latitude, on a sphere of radius 6371 km."""
_COLUMNS = "place_id,year,month,northdeg,city_id,lat,lon,panoid"
"""Header of a city's table in GSV-Cities."""
UTM_ORIGIN = (500_000.0, 5_000_000.0)
"""East and north in zone 32T of the test city's south-west corner."""


@dataclasses.dataclass(frozen=True)
class SyntheticCityConfig:
    """Size and seed of a synthetic city."""

    train_places: int = 240
    """Number of training places, divided between the two training cities."""
    images_per_place: int = 4
    """Number of images of a training place; GSV-Cities keeps places with at least 4."""
    test_places: int = 150
    database_per_place: int = 1
    queries_per_place: int = 1
    image_size: tuple[int, int] = (126, 168)
    """Height and width in pixels."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the types and ranges."""
        check_types(self)
        for name, least in (
            ("train_places", len(CITY_NAMES)),
            ("images_per_place", 1),
            ("test_places", 1),
            ("database_per_place", 1),
            ("queries_per_place", 1),
        ):
            value = getattr(self, name)
            if value < least:
                raise InputError(
                    f"SyntheticCityConfig.{name}: found {value}, expected at least {least}"
                )
        check_seed("SyntheticCityConfig.seed", self.seed)
        check_size("SyntheticCityConfig.image_size", self.image_size)


def write_synthetic_city(
    root: str | os.PathLike[str],
    config: SyntheticCityConfig,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Render the city into `root`, whole or not at all.

    `root/train` has the GSV-Cities layout with two cities. `root/test` has that of
    VPR-datasets-downloader (`images/test/{database,queries}`). Places are 80 m apart and the images
    of one within 10 m, so that 25 m separate positives; no place is in both. `root/city.json` holds
    the configuration; a root that holds the same city already is not changed.

    Args:
        root: a folder that does not exist, or is empty, or holds this city.
        config: how many places and images, their size, the seed.
        progress: called after every image with the number done and the number of all.

    Raises:
        InputError: `root` is a file, holds something else, or cannot be written to.
    """
    root = pathlib.Path(root)
    identity = {"renderer": RENDERER, **dataclasses.asdict(config)}
    identity["image_size"] = list(config.image_size)
    if root.exists() and holds(root, identity, "city.json", "a synthetic city"):
        return
    total = config.train_places * config.images_per_place
    total += config.test_places * (config.database_per_place + config.queries_per_place)
    temporary = temporary_beside(root)
    with made_folder(root.parent), in_use(temporary):
        for number, _ in enumerate(_write(temporary, root, config, identity), start=1):
            if progress is not None:
                progress(number, total)


def _write(
    temporary: pathlib.Path, root: pathlib.Path, config: SyntheticCityConfig, identity: dict
) -> Iterator[None]:
    """Write the city into `temporary`, then rename that to `root`; yield after every image.

    It yields, instead of calling back, so that the caller's own errors are not reported as its own.

    Raises:
        InputError: the city cannot be written there.
    """
    with wrap_os_errors(root):
        temporary.mkdir()
        for city in range(len(CITY_NAMES)):
            yield from _write_train(temporary / "train", config, city)
        yield from _write_test(temporary / "test" / "images" / "test", config)
        write_json(temporary / "city.json", identity)
        os.replace(temporary, root)


def holds(root: pathlib.Path, identity: dict, file: str, what: str) -> bool:
    """Return whether `root` already holds this city or world; False if it is an empty folder.

    Raises:
        InputError: `root` is no folder, or holds anything else.
    """
    if not root.is_dir():
        raise InputError(f"{root}: found a file, expected a folder or a new name")
    if not any(root.iterdir()):
        return False
    try:
        existing = read_json(root / file, what)
    except InputError:
        existing = None
    if existing == identity:
        return True
    found = "a folder with other content"
    if existing:
        name = next(
            name for name in identity | existing if existing.get(name) != identity.get(name)
        )
        values = (each.get(name, "default") for each in (existing, identity))
        found = f"{what} of another configuration ({name}: {', not '.join(map(str, values))})"
    raise InputError(f"{root}: found {found}, expected a new or empty folder")


def _write_train(folder: pathlib.Path, config: SyntheticCityConfig, city: int) -> Iterator[None]:
    """Write one city in the GSV-Cities layout, at latitudes and longitudes in an ocean.

    Yields after every image.
    """
    name, centre = CITY_NAMES[city], (10.0 + city, -40.0)
    images = folder / "Images" / name
    images.mkdir(parents=True)
    rows: list[str] = []
    indices = range(city, config.train_places, len(CITY_NAMES))
    for place_id, index in enumerate(indices, start=1):
        spot = _spot(config, 0, index, config.train_places)
        for view in _train_views(spot.rng, config.images_per_place):
            east, north = spot.stand(view)
            lat = f"{centre[0] + north / METRES_PER_DEGREE:.7f}"
            per_degree = METRES_PER_DEGREE * np.cos(np.deg2rad(centre[0]))
            lon = f"{centre[1] + east / per_degree:.7f}"
            year, month = int(spot.rng.integers(2012, 2022)), MONTHS[view.season]
            northdeg, key = spot.northdeg(view), panoid(spot.rng)
            row, file = gsv_image(name, place_id, (year, month), northdeg, (lat, lon), key)
            rows.append(row)
            write_jpeg(images / file, render(spot.seed, view, config.image_size))
            yield
    write_gsv_table(folder, name, rows)


def _write_test(folder: pathlib.Path, config: SyntheticCityConfig) -> Iterator[None]:
    """Write a database by day in spring and summer, queries at all hours in autumn and winter.

    Yields after every image.
    """
    for side in ("database", "queries"):
        (folder / side).mkdir(parents=True)
    for index in range(config.test_places):
        spot = _spot(config, 1, index, config.test_places)
        views = [("database", _database_view(spot.rng)) for _ in range(config.database_per_place)]
        views += [("queries", _query_view(spot.rng)) for _ in range(config.queries_per_place)]
        for side, view in views:
            east, north = spot.stand(view)
            year, month = int(spot.rng.integers(2012, 2022)), MONTHS[view.season]
            fields = (
                f"{UTM_ORIGIN[0] + east:.2f}",
                f"{UTM_ORIGIN[1] + north:.2f}",
                "32",
                "T",
                "",
                "",
                panoid(spot.rng),
                "",
                f"{spot.northdeg(view)}",
                f"{PITCH:.0f}",
                "0",
                f"{EYE}",
                f"{year:04d}{month:02d}",
                f"{view.season}_{view.time}",
            )
            path = folder / side / f"@{'@'.join(fields)}@.jpg"
            write_jpeg(path, render(spot.seed, view, config.image_size))
            yield


def gsv_image(
    city: str,
    place: int,
    date: tuple[int, int],
    northdeg: int,
    position: tuple[str, str],
    key: str,
) -> tuple[str, str]:
    """Return a training image's row of the table of GSV-Cities, and its file's name.

    Args:
        city: the city's name.
        place: the place's number in the city.
        date: year and month.
        northdeg: degrees clockwise from north.
        position: latitude and longitude, as they are written.
        key: name of the panorama.
    """
    (year, month), (lat, lon) = date, position
    row = f"{place},{year},{month},{northdeg},{city},{lat},{lon},{key}"
    name = f"{city}_{place:07d}_{year:04d}_{month:02d}_{northdeg:03d}_{lat}_{lon}_{key}.jpg"
    return row, name


def write_gsv_table(folder: pathlib.Path, city: str, rows: Sequence[str]) -> None:
    """Write a city's table of rows that `gsv_image` returned."""
    table = folder / "Dataframes" / f"{city}.csv"
    table.parent.mkdir(exist_ok=True)
    table.write_text("\n".join([_COLUMNS, *rows]) + "\n", encoding="utf-8")


def write_jpeg(path: pathlib.Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write a picture as a JPEG of quality 92."""
    _, data = cv2.imencode(".jpg", image[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, 92))
    path.write_bytes(data.tobytes())


def panoid(rng: np.random.Generator) -> str:
    """Draw the name of a panorama."""
    return rng.bytes(8).hex()


class _Spot(NamedTuple):
    """One place in its city: its seed, its position, and the random generator of its views."""

    seed: int
    east: float
    north: float
    bearing: float
    rng: np.random.Generator

    def stand(self, view: View) -> tuple[float, float]:
        """Compute the metres east and north at which the camera of a view stands."""
        angle = np.deg2rad(self.bearing)
        sin, cos = np.sin(angle), np.cos(angle)
        east = self.east + view.lateral * cos + view.forward * sin
        return float(east), float(self.north - view.lateral * sin + view.forward * cos)

    def northdeg(self, view: View) -> int:
        """Compute a view's direction in degrees clockwise from north."""
        return round(self.bearing + build_place(self.seed).heading + view.heading) % 360


def _spot(config: SyntheticCityConfig, split: int, index: int, count: int) -> _Spot:
    """Make place `index` of `count`, which stand on a square grid with small offsets."""
    seed = place_seed(config, split, index)
    rng = np.random.default_rng((seed, 4))
    row, column = divmod(index, math.isqrt(count - 1) + 1)
    east, north = np.array((column, row)) * PLACE_SPACING + rng.uniform(-3, 3, 2)
    return _Spot(seed, float(east), float(north), build_place(seed).bearing, rng)


def place_seed(config: SyntheticCityConfig, split: int, index: int) -> int:
    """Derive the seed of a place, different for every place of either split."""
    return int(np.random.SeedSequence((config.seed, split, index)).generate_state(1, np.uint64)[0])


def _draw_view(rng: np.random.Generator, season: Season, time: Time) -> View:
    return View(
        lateral=float(rng.uniform(-1.2, 1.2)),
        forward=float(rng.uniform(-2.5, 2.5)),
        heading=float(rng.uniform(-6, 6)),
        season=season,
        time=time,
        weather=WEATHERS[rng.choice(4, p=(0.5, 0.25, 0.12, 0.13))],
        occluders=int(rng.integers(2**31)),
        exposure=float(rng.uniform(-0.3, 0.35)),
        noise=float(rng.uniform(1, 4) + 2 * (time == "night")),
        seed=int(rng.integers(2**31)),
    )


def _train_views(rng: np.random.Generator, count: int) -> list[View]:
    """Draw views that cycle through the seasons and hours, in an order of the place's own."""
    seasons, times = rng.permutation(4), rng.permutation(4)
    hours: tuple[Time, ...] = ("noon", "dusk", "night", "noon")
    return [_draw_view(rng, SEASONS[seasons[i % 4]], hours[times[i % 4]]) for i in range(count)]


def _database_view(rng: np.random.Generator) -> View:
    return _draw_view(rng, SEASONS[rng.integers(2)], "noon")


def _query_view(rng: np.random.Generator) -> View:
    return _draw_view(rng, SEASONS[2 + rng.integers(2)], TIMES[rng.choice(3, p=(0.4, 0.4, 0.2))])
