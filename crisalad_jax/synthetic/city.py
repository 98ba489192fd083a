"""The city: two cities to train on, and one to test on, in the layouts of real sets."""

import dataclasses
import math
import os
from collections.abc import Iterator

import numpy as np

from crisalad_jax.config.checks import check_seed, check_types, require_range
from crisalad_jax.synthetic.layouts import (
    METRES_PER_DEGREE,
    MONTHS,
    UTM_ORIGIN,
    Files,
    Progress,
    TrainImage,
    gsv_city,
    jpeg,
    panoid,
    utm_path,
    write_set,
)
from crisalad_jax.synthetic.mesh import Rng
from crisalad_jax.synthetic.picture import build_place, render
from crisalad_jax.synthetic.view import (
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

_CITY_NAMES = ("Alderby", "Brackwater")
"""Names of the training cities, which are invented."""
_SPACING = 80.0
"""Metres between neighbouring places: more than three times the 25 m that make a positive."""
_HOURS: tuple[Time, ...] = ("noon", "dusk", "night", "noon")
"""Hours of a training place's images, one in each season."""


@dataclasses.dataclass(frozen=True)
class SyntheticCityConfig:
    """Size and seed of a synthetic city."""

    train_places: int = 240
    """Number of training places with four images each, divided between the two training cities."""
    test_places: int = 150
    """Number of test places, each with one image in the database and one query."""
    image_size: tuple[int, int] = (126, 168)
    """Height and width in pixels."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the types and ranges."""
        check_types(self)
        require_range(self, len(_CITY_NAMES), math.inf, "train_places")
        require_range(self, 1, math.inf, "test_places")
        check_seed("SyntheticCityConfig.seed", self.seed)
        check_size("SyntheticCityConfig.image_size", self.image_size)

    @property
    def images(self) -> int:
        """Number of all images."""
        return self.train_places * len(SEASONS) + self.test_places * 2


def write_synthetic_city(
    root: str | os.PathLike[str], config: SyntheticCityConfig, *, progress: Progress = None
) -> None:
    """Render the city into `root`, whole or not at all.

    `root/train` has the GSV-Cities layout with two cities. `root/test` has that of
    VPR-datasets-downloader (`images/test/{database,queries}`). Places are 80 m apart and the images
    of one within 10 m, so that 25 m separate positives; no place is in both. `root/city.json` holds
    the configuration; a root that holds the same city already is not changed.

    Args:
        root: a folder that does not exist, or is empty, or holds this city.
        config: how many places, the size of their images, the seed.
        progress: called with 1 after every image.

    Raises:
        InputError: `root` is a file, holds something else, or cannot be written to.
    """
    write_set(root, "city.json", config, _files(config), progress)


def _files(config: SyntheticCityConfig) -> Files:
    for city, name in enumerate(_CITY_NAMES):
        yield from gsv_city(name, _train_images(config, city))
    for index in range(config.test_places):
        spot = _Spot(place_seed(config, 1, index), index, config.test_places)
        rng = spot.rng
        # The database is of days in spring and summer, queries of all hours in autumn and winter.
        database = _draw_view(rng, SEASONS[rng.integers(2)], "noon")
        season, time = SEASONS[2 + rng.integers(2)], TIMES[rng.choice(3, p=(0.4, 0.4, 0.2))]
        for side, view in (("database", database), ("queries", _draw_view(rng, season, time))):
            east, north, northdeg = spot.pose(view)
            date = f"{rng.integers(2012, 2022):04d}{MONTHS[view.season]:02d}"
            camera = f"{northdeg}", f"{PITCH:.0f}", "0", f"{EYE}", date
            note = f"{view.season}_{view.time}"
            east, north = UTM_ORIGIN[0] + east, UTM_ORIGIN[1] + north
            path = utm_path(side, east, north, panoid(rng), note, camera)
            yield path, jpeg(render(spot.seed, view, config.image_size))


def _train_images(config: SyntheticCityConfig, city: int) -> Iterator[TrainImage]:
    """Draw the images of a training city, which lies in an ocean.

    A place's images go through the seasons and hours, in an order of its own.
    """
    latitude, longitude = 10.0 + city, -40.0
    per_degree = METRES_PER_DEGREE * np.cos(np.deg2rad(latitude))
    indices = range(city, config.train_places, len(_CITY_NAMES))
    for place_id, index in enumerate(indices, start=1):
        spot = _Spot(place_seed(config, 0, index), index, config.train_places)
        seasons, hours = spot.rng.permutation(4), spot.rng.permutation(4)
        order = list(zip(seasons, hours, strict=True))
        for view in [_draw_view(spot.rng, SEASONS[s], _HOURS[h]) for s, h in order]:
            east, north, northdeg = spot.pose(view)
            lat = f"{latitude + north / METRES_PER_DEGREE:.7f}"
            lon = f"{longitude + east / per_degree:.7f}"
            picture = jpeg(render(spot.seed, view, config.image_size))
            yield TrainImage(place_id, picture, lat, lon, northdeg, view.season, spot.rng)


class _Spot:
    """One place in its city, on a square grid with a small offset, and what draws its views."""

    def __init__(self, seed: int, index: int, count: int) -> None:
        """Make place `index` of `count`."""
        self.seed = seed
        self.rng = np.random.default_rng((seed, 4))
        row, column = divmod(index, math.isqrt(count - 1) + 1)
        self._position = np.array((column, row)) * _SPACING + self.rng.uniform(-3, 3, 2)
        self._place = build_place(seed)

    def pose(self, view: View) -> tuple[float, float, int]:
        """Compute the metres east and north of a view's camera, and its degrees from north."""
        angle = np.deg2rad(self._place.bearing)
        sin, cos = np.sin(angle), np.cos(angle)
        aside, along = np.array((cos, -sin)), np.array((sin, cos))
        east, north = self._position + view.lateral * aside + view.forward * along
        northdeg = round(self._place.bearing + self._place.heading + view.heading) % 360
        return float(east), float(north), northdeg


def place_seed(config: SyntheticCityConfig, split: int, index: int) -> int:
    """Derive the seed of a place, different for every place of either split."""
    return int(np.random.SeedSequence((config.seed, split, index)).generate_state(1, np.uint64)[0])


def _draw_view(rng: Rng, season: Season, time: Time) -> View:
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
