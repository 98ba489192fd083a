"""Synthetic cities: two for training and one for testing, in the layouts of real data sets."""

import dataclasses
import math
import os
from collections.abc import Iterator
from typing import Annotated

import numpy as np

from crisalad_jax.config.checks import PositiveInt, Seed, check_types, limited
from crisalad_jax.synthetic.layouts import (
    Files,
    Shot,
    derive_seed,
    gsv_city,
    jpeg,
    utm_images,
    write_set,
)
from crisalad_jax.synthetic.mesh import Place, Rng
from crisalad_jax.synthetic.picture import build_place, render
from crisalad_jax.synthetic.view import (
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

    train_places: Annotated[int, limited(len(_CITY_NAMES))] = 240
    """Number of training places with four images each, divided between the two training cities."""
    test_places: PositiveInt = 150
    """Number of test places, each with one image in the database and one query."""
    image_size: tuple[int, int] = (126, 168)
    """Height and width in pixels."""
    seed: Seed = 0

    def __post_init__(self) -> None:
        """Check the types and ranges."""
        check_types(self)
        check_size("SyntheticCityConfig.image_size", self.image_size)

    @property
    def images(self) -> int:
        """Total number of images."""
        return self.train_places * len(SEASONS) + self.test_places * 2


def write_synthetic_city(
    root: str | os.PathLike[str], config: SyntheticCityConfig, *, quiet: bool = False
) -> bool:
    """Render the city into `root`, completely or not at all.

    `root/train` has the GSV-Cities layout with two cities. `root/test` has that of
    VPR-datasets-downloader (`images/test/{database,queries}`). Places are 80 m apart and a place's
    images within 10 m, so a radius of 25 m separates positives; training and test places differ.
    The configuration is in `root/set.json`; a root that already holds this city is not changed.

    Args:
        root: a folder that does not exist, or is empty, or holds this city.
        config: size and seed of the city.
        quiet: whether to hide the progress bar.

    Returns:
        Whether the city was written; False if it existed already.

    Raises:
        InputError: `root` is a file, holds something else, or cannot be written to.
    """
    return write_set(root, config, _files(config), quiet=quiet)


def _files(config: SyntheticCityConfig) -> Files:
    for city, name in enumerate(_CITY_NAMES):
        indices = range(city, config.train_places, len(_CITY_NAMES))
        yield from gsv_city(name, 10.0 + city, _shots(config, 0, indices))
    yield from utm_images(_shots(config, 1, range(config.test_places)), camera=True)


def _shots(config: SyntheticCityConfig, split: int, indices: range) -> Iterator[Shot]:
    """Take the pictures of some places, which lie on a square grid with small offsets."""
    columns = math.isqrt((config.train_places, config.test_places)[split] - 1) + 1
    for number, index in enumerate(indices, start=1):
        seed = derive_seed(config.seed, split, index)
        place, rng = build_place(seed), np.random.default_rng((seed, 4))
        row, column = divmod(index, columns)
        position = np.array((column, row)) * _SPACING + rng.uniform(-3, 3, 2)
        for view in _test_views(rng) if split else _train_views(rng):
            picture = jpeg(render(seed, view, config.image_size))
            yield Shot(number, view, picture, rng, *_pose(place, position, view))


def _train_views(rng: Rng) -> list[View]:
    """Draw a view for each season, with seasons and hours in random order."""
    order = zip(rng.permutation(4), rng.permutation(4), strict=True)
    return [_draw_view(rng, SEASONS[season], _HOURS[hour]) for season, hour in order]


def _test_views(rng: Rng) -> list[View]:
    """Draw a daytime database image in spring or summer, and a query in autumn or winter."""
    database = _draw_view(rng, SEASONS[rng.integers(2)], "noon")
    season, time = SEASONS[2 + rng.integers(2)], TIMES[rng.choice(3, p=(0.4, 0.4, 0.2))]
    return [database, _draw_view(rng, season, time)]


def _pose(place: Place, position: np.ndarray, view: View) -> tuple[float, float, int]:
    """Compute the metres east and north of a view's camera, and its degrees from north."""
    angle = np.deg2rad(place.bearing)
    sin, cos = np.sin(angle), np.cos(angle)
    aside, along = np.array((cos, -sin)), np.array((sin, cos))
    east, north = position + view.lateral * aside + view.forward * along
    return float(east), float(north), round(place.bearing + place.heading + view.heading) % 360


def _draw_view(rng: Rng, season: Season, time: Time) -> View:
    return View(
        lateral=rng.uniform(-1.2, 1.2),
        forward=rng.uniform(-2.5, 2.5),
        heading=rng.uniform(-6, 6),
        season=season,
        time=time,
        weather=WEATHERS[rng.choice(4, p=(0.5, 0.25, 0.12, 0.13))],
        occluders=int(rng.integers(2**31)),
        exposure=rng.uniform(-0.3, 0.35),
        noise=rng.uniform(1, 4) + 2 * (time == "night"),
        seed=int(rng.integers(2**31)),
    )
