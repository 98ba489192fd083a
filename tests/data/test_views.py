"""Positions in metres against what defines the projection, and against a public data set's."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad

from crisalad_jax.data.metres import transverse_mercator
from crisalad_jax.data.places import Places
from crisalad_jax.data.views import views_of
from crisalad_jax.utils.errors import InputError

AXIS, FLATTENING = 6378137.0, 1 / 298.257223563
SQUARE = FLATTENING * (2 - FLATTENING)


def one(latitude: float, longitude: float) -> tuple[float, float]:
    east, north = transverse_mercator(np.array([latitude]), np.array([longitude]))
    return float(east[0]), float(north[0])


def meridian_radius(latitude: float) -> float:
    return AXIS * (1 - SQUARE) / (1 - SQUARE * np.sin(latitude) ** 2) ** 1.5


def parallel_radius(latitude: float) -> float:
    return AXIS * np.cos(latitude) / np.sqrt(1 - SQUARE * np.sin(latitude) ** 2)


@pytest.mark.parametrize("latitude", [-80.0, -33.9, 0.0, 1e-6, 45.0, 84.0])
def test_on_the_central_meridian_north_is_the_length_of_the_meridian(latitude: float):
    length, _ = quad(meridian_radius, 0, np.deg2rad(latitude), epsabs=1e-6)
    east, north = one(latitude, 0.0)
    assert east == pytest.approx(500_000, abs=1e-9)
    assert north == pytest.approx(0.9996 * length, abs=1e-3)  # the series: a millimetre


@pytest.mark.parametrize("longitude", [-3.5, -1.0, 0.5, 3.0])
@pytest.mark.parametrize("latitude", [-60.0, -1.0, 37.8, 70.0])
def test_the_projection_is_conformal(latitude: float, longitude: float):
    """With the central meridian this fixes a projection: a step of 1 m turns and grows alike.

    Differences over 2e-4 degrees, about 20 m: positions in metres of 1e7 are off by 1e-9, scales by
    1e-9 over 20 and a curvature of (20 / 6e6)**2.
    """
    step, here = 1e-4, np.deg2rad(latitude)
    ahead, back = (one(latitude + s, longitude) for s in (step, -step))
    right, left = (one(latitude, longitude + s) for s in (step, -step))
    up = np.subtract(ahead, back) / (2 * np.deg2rad(step) * meridian_radius(here))
    across = np.subtract(right, left) / (2 * np.deg2rad(step) * parallel_radius(here))
    np.testing.assert_allclose(across, [up[1], -up[0]], atol=1e-8)


@pytest.mark.parametrize(
    ("latitude", "longitude", "east", "north"),
    [  # names of San Francisco eXtra Large's images, in zone 10; 5 decimals of a degree are 1.1 m
        (37.78752, -122.41454, 551550.00, 4182401.73),
        (37.70275, -122.48609, 545301.59, 4172959.59),
        (37.76318, -122.49589, 544401.60, 4179659.50),
    ],
)
def test_positions_are_those_of_a_public_data_set(latitude, longitude, east, north):
    assert one(latitude, longitude + 123) == (
        pytest.approx(east, abs=0.8),
        pytest.approx(north, abs=0.8),
    )


def named(*positions: tuple[str, str, str], cities: int = 1) -> Places:
    """One place with an image for each (northdeg, lat, lon); the last city has one of its own."""
    files = tuple(
        f"Images/C_1/C_1_0000001_2020_05_{north}_{lat}_{lon}_a_pano_0000001_2020_05_001_9_9_.jpg"
        for north, lat, lon in positions
    )
    count = len(files)
    return Places(
        root=Path("root"),
        cities=tuple(f"city{i}" for i in range(cities)),
        files=files,
        image_place=np.zeros(count, np.int32),
        place_city=np.zeros(1, np.int32),
        place_id=np.ones(1, np.int64),
        place_start=np.array([0, count]),
    )


def test_names_tell_positions_and_headings():
    """The names of cities and panoramas have underlines too; degrees are as the CSV has them."""
    views = views_of(named(("005", "37.78752", "-122.41454"), ("360", "37.70275", "-122.48609")))
    np.testing.assert_array_equal(views.heading, [5, 0])
    np.testing.assert_allclose(views.east, [551550.00, 545301.59], atol=0.8)
    np.testing.assert_allclose(views.north, [4182401.73, 4172959.59], atol=0.8)
    assert views.known.tolist() == [True]


def test_one_position_for_all_stands_for_none():
    assert not views_of(named(("005", "0.0", "0.0"), ("100", "0.0", "0"))).known[0]
    assert not views_of(named(("005", "1.5", "2.5"))).known[0]


def test_a_city_has_one_zone_even_across_its_edge_and_across_180_degrees():
    """100 m apart on the ground stay so, to the scale's 0.1 %: zones have other eastings."""
    degrees = 100 / 111_319.49  # along the equator
    for middle in (6.0, 180.0):
        west, east = middle - degrees / 2, middle + degrees / 2
        east = east - 360 if east > 180 else east
        views = views_of(named(("000", "0.0", f"{west:.9f}"), ("000", "0.0", f"{east:.9f}")))
        assert views.east[1] - views.east[0] == pytest.approx(100, rel=2e-3)


def test_a_city_as_wide_as_the_world_is_refused():
    places = named(("000", "0.0", "-60.0"), ("000", "0.0", "100.0"))
    with pytest.raises(InputError, match="found the images of city0 over 160 degrees of longitude"):
        views_of(places)


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("Images/C/3.jpg", "root/Images/C/3.jpg: found a name without direction and position"),
        ("C_0000001_2020_05_001_north_2.5_pano.jpg", "found a name without direction and position"),
        ("C_0000001_2020_05_001_91.0_2.5_pano.jpg", "found lat 91.0 and lon 2.5, expected a lat"),
        ("C_0000001_2020_05_001_1.0_200_pano.jpg", "found lat 1.0 and lon 200, expected a latit"),
        ("C_0000001_2020_05_001_nan_2.5_pano.jpg", "found lat nan and lon 2.5, expected a latit"),
    ],
)
def test_a_name_without_a_position_is_told(file: str, words: str):
    places = dataclasses.replace(named(("005", "1.0", "2.5")), files=(file,))
    with pytest.raises(InputError, match=words):
        views_of(places)
