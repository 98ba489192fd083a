"""Zones of UTM, points on the ellipsoid and what is drawn of them, against pyproj."""

import numpy as np
import pyproj
import pytest

from crisalad_jax.data.metres import Zone, comparable, flattened, on_ellipsoid

GEOD = pyproj.Geod(ellps="WGS84")
ZONES = [Zone(1, False), Zone(31, True), Zone(32, False), Zone(60, True)]


def places(zone: Zone, *, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Latitudes and longitudes in a zone and its neighbours."""
    draw = np.random.default_rng(seed)
    latitude = draw.uniform(-80, 0, 200) if zone.south else draw.uniform(0, 84, 200)
    return latitude, (6 * zone.number - 183 + draw.uniform(-9, 9, 200) + 180) % 360 - 180


@pytest.mark.parametrize("zone", ZONES, ids=str)
def test_a_zone_is_that_of_pyproj(zone):
    code = (32700 if zone.south else 32600) + zone.number
    into = pyproj.Transformer.from_crs("EPSG:4326", f"EPSG:{code}", always_xy=True)
    latitude, longitude = places(zone)
    east, north = into.transform(longitude, latitude)
    # The series is of third order: 0.1 mm.
    np.testing.assert_allclose(zone.to_metres(latitude, longitude), [east, north], atol=1e-4)
    back = zone.to_degrees(np.array(east), np.array(north))
    metres = GEOD.inv(longitude, latitude, back[1], back[0])[2]
    assert np.max(metres) < 1e-4
    assert np.abs(back[1]).max() <= 180


def test_points_are_those_of_pyproj():
    earth = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    latitude, longitude = np.array([[-90.0, 0], [0, 180], [48.85, 2.35], [90, 7], [-33.9, 151.2]]).T
    expected = np.stack(earth.transform(longitude, latitude, np.zeros(5)), axis=1)
    # Rounding of numbers of 6e6.
    np.testing.assert_allclose(on_ellipsoid(latitude, longitude), expected, atol=1e-8)


def test_the_whole_world_is_comparable():
    """Short distances anywhere, across 180 degrees and at the poles, are those of a geodesic."""
    draw = np.random.default_rng(1)
    latitude = np.concatenate([draw.uniform(-90, 90, 200), [0.0, 65.0, 90.0]])
    longitude = np.concatenate([draw.uniform(-180, 180, 200), [179.9999, -180.0, 12.0]])
    far, angle = draw.uniform(1, 1000, 203), draw.uniform(0, 360, 203)
    there = GEOD.fwd(longitude, latitude, angle, far)
    points = comparable(np.append(latitude, there[1]), np.append(longitude, there[0]))
    assert points.shape == (406, 3)
    # A chord of 1 km is 1e-6 m shorter.
    np.testing.assert_allclose(np.linalg.norm(points[:203] - points[203:], axis=1), far, atol=2e-6)


def test_one_zone_stays_in_its_plane():
    zone = Zone(32, False)
    latitude, longitude = np.array([[48.1, 6.0], [48.2, 11.9], [-1.0, 9.0]]).T
    east, north = zone.to_metres(latitude, longitude)
    assert comparable(latitude, longitude).tolist() == np.stack([east, north], axis=1).tolist()
    assert comparable(latitude, longitude - np.array([0.1, 0, 0])).shape == (3, 3)


def test_points_are_drawn_where_they_are():
    """A degree of latitude and, at the equator, of longitude is 111.3 km on the drawn sphere."""
    points = on_ellipsoid(np.array([0.0, 10, -10, 0]), np.array([170.0, 175, -175, 180]))
    drawn = flattened(points) / np.deg2rad(6_378_137)
    # Rounding of 1e7 m, which are 90 degrees.
    np.testing.assert_allclose(drawn, [[170, 0], [175, 10], [185, -10], [180, 0]], atol=1e-9)
    # At 60 degrees a degree of longitude is half as long.
    drawn = flattened(on_ellipsoid(np.full(3, 60.0), np.array([10.0, 11, 12])))
    expected = [[5, 60], [5.5, 60], [6, 60]]
    np.testing.assert_allclose(drawn / np.deg2rad(6_378_137), expected, atol=1e-9)  # as above
    plane = np.array([[1.0, 2.0]])
    assert flattened(plane) is plane
