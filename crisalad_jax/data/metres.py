"""Convert between degrees, metres of a UTM zone, and points on the ellipsoid.

The projection is Krueger's series (1912) of third order in the third flattening, as in Karney,
Transverse Mercator with an accuracy of a few nanometers (J. Geodesy 2011), eqs. 35 and 36. It is
accurate to a millimetre in a zone and its neighbours.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from crisalad_jax.utils.shapes import Float64

_EQUATOR, _FLATTENING = 6_378_137.0, 1 / 298.257223563
"""Ellipsoid of WGS84, in metres."""
_SQUARE = _FLATTENING * (2 - _FLATTENING)
"""Its first eccentricity, squared."""
_THIRD = _FLATTENING / (2 - _FLATTENING)
_RADIUS = 0.9996 * (_EQUATOR / (1 + _THIRD) * (1 + _THIRD**2 / 4 + _THIRD**4 / 64))
"""Mean length in metres of one radian of a meridian, times UTM's scale."""
_FORWARD = (
    _THIRD / 2 - 2 * _THIRD**2 / 3 + 5 * _THIRD**3 / 16,
    13 * _THIRD**2 / 48 - 3 * _THIRD**3 / 5,
    61 * _THIRD**3 / 240,
)
"""Series from the sphere to the plane (eq. 35)."""
_INVERSE = (
    -(_THIRD / 2 - 2 * _THIRD**2 / 3 + 37 * _THIRD**3 / 96),
    -(_THIRD**2 / 48 + _THIRD**3 / 15),
    -17 * _THIRD**3 / 480,
)
"""Series from the plane to the sphere (eq. 36)."""
_FALSE_EAST, _FALSE_NORTH = 500_000.0, 10_000_000.0

_Points = Float64[np.ndarray, " point"]


class Zone(NamedTuple):
    """A UTM zone in one hemisphere; its positions are metres in one plane."""

    number: int
    south: bool

    def __str__(self) -> str:
        """Describe the zone for a message, such as 32 north."""
        return f"{self.number} {'south' if self.south else 'north'}"

    @property
    def central(self) -> float:
        """Longitude of the central meridian in degrees."""
        return 6.0 * self.number - 183

    def to_degrees(self, east: _Points, north: _Points) -> tuple[_Points, _Points]:
        """Convert east and north in metres to latitude and longitude (-180 to 180) in degrees."""
        latitude, turn = _inverse(east, north - _FALSE_NORTH * self.south)
        return latitude, (self.central + turn + 180) % 360 - 180

    def to_metres(self, latitude: _Points, longitude: _Points) -> tuple[_Points, _Points]:
        """Convert degrees to east and north in metres of this zone, also for points outside it."""
        turn = (longitude - self.central + 180) % 360 - 180
        east, north = transverse_mercator(latitude, turn)
        return east, north + _FALSE_NORTH * self.south


def continuous(longitude: _Points) -> _Points:
    """Shift longitudes in degrees by multiples of 360 to within 180 of the first one."""
    return longitude[0] + (longitude - longitude[0] + 180) % 360 - 180


def to_metres(latitude: _Points, longitude: _Points) -> tuple[_Points, _Points]:
    """Convert degrees (longitudes `continuous`) to metres in the median longitude's UTM zone."""
    central = 6 * np.floor(np.median(longitude) / 6) + 3
    return transverse_mercator(latitude, longitude - central)


def transverse_mercator(latitude: _Points, longitude: _Points) -> tuple[_Points, _Points]:
    """Compute UTM's east and north in metres; north is negative south of the equator.

    Args:
        latitude: degrees on WGS84.
        longitude: degrees from the zone's central meridian.
    """
    eccentricity = np.sqrt(_SQUARE)
    sine, turn = np.sin(np.deg2rad(latitude)), np.deg2rad(longitude)
    conformal = np.sinh(np.arctanh(sine) - eccentricity * np.arctanh(eccentricity * sine))
    along = np.arctan2(conformal, np.cos(turn))
    across = np.arcsinh(np.sin(turn) / np.hypot(conformal, np.cos(turn)))
    north, east = _corrected(along, across, _FORWARD)
    return _FALSE_EAST + _RADIUS * east, _RADIUS * north


def _corrected(along: _Points, across: _Points, series: Sequence[float]) -> tuple[_Points, _Points]:
    """Add a series to a point on the sphere, or on the ellipsoid."""
    first, second = along.copy(), across.copy()
    for order, weight in enumerate(series, start=1):
        first += weight * np.sin(2 * order * along) * np.cosh(2 * order * across)
        second += weight * np.cos(2 * order * along) * np.sinh(2 * order * across)
    return first, second


def _inverse(east: _Points, north: _Points) -> tuple[_Points, _Points]:
    """Compute latitude, and longitude from the central meridian, in degrees."""
    angle, away = _corrected(north / _RADIUS, (east - _FALSE_EAST) / _RADIUS, _INVERSE)
    conformal = np.arcsinh(np.sin(angle) / np.hypot(np.sinh(away), np.cos(angle)))
    eccentricity = np.sqrt(_SQUARE)
    sine = np.tanh(conformal)
    for _ in range(8):  # each step leaves at most a 150th of the error
        sine = np.tanh(conformal + eccentricity * np.arctanh(eccentricity * sine))
    return np.rad2deg(np.arcsin(sine)), np.rad2deg(np.arctan2(np.sinh(away), np.cos(angle)))


def comparable(latitude: _Points, longitude: _Points) -> Float64[np.ndarray, "point axis"]:
    """Convert degrees to points in metres whose distances approximate those on the ground.

    The points are UTM east and north if all are in one zone, else three coordinates `on_ellipsoid`.
    """
    longitude = continuous(longitude)
    if len(np.unique(np.floor(longitude / 6))) == 1:
        return np.stack(to_metres(latitude, longitude), axis=1)
    return on_ellipsoid(latitude, longitude)


def on_ellipsoid(latitude: _Points, longitude: _Points) -> Float64[np.ndarray, "point 3"]:
    """Convert degrees to Cartesian coordinates in metres from the Earth's centre.

    Distances between points are chords: too short by 1 micrometre at 1 km, by 1 km at 1000 km.
    """
    phi, turn = np.deg2rad(latitude), np.deg2rad(longitude)
    radius = _EQUATOR / np.sqrt(1 - _SQUARE * np.sin(phi) ** 2)
    flat = radius * np.cos(phi)
    return np.stack(
        [flat * np.cos(turn), flat * np.sin(turn), (1 - _SQUARE) * radius * np.sin(phi)], axis=1
    )


def flattened(points: Float64[np.ndarray, "point axis"]) -> Float64[np.ndarray, "point 2"]:
    """Return points for a map plot: east and north unchanged, ellipsoid points equirectangular."""
    if points.shape[1] == 2:
        return points
    x, y, z = points.T
    latitude = np.arctan2(z, (1 - _SQUARE) * np.hypot(x, y))
    longitude = np.deg2rad(continuous(np.rad2deg(np.arctan2(y, x))))
    return _EQUATOR * np.stack([np.cos(np.median(latitude)) * longitude, latitude], axis=1)
