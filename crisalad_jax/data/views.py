"""Read the positions and headings of a training set's images from their names."""

import re
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from crisalad_jax.data.places import Places
from crisalad_jax.utils.errors import InputError

_NAME = re.compile(r".*?_\d{7,}_\d{4,}_\d{2,}_(\d{3,})_([^_]+)_([^_]+)_")
"""`data.places` writes a row's northdeg, latitude and longitude into its image's name."""

_EQUATOR, _FLATTENING = 6_378_137.0, 1 / 298.257223563
"""Ellipsoid of WGS84, in metres."""
_SCALE, _FALSE_EAST = 0.9996, 500_000.0


class Views(NamedTuple):
    """Position and heading of every image; metres are of one UTM zone for each city."""

    east: Float64[np.ndarray, " images"]
    north: Float64[np.ndarray, " images"]
    """UTM north in metres; negative south of the equator, where maps add 10,000 km."""
    heading: Float64[np.ndarray, " images"]
    """Heading in degrees clockwise from north, 0 to 360."""
    known: Bool[np.ndarray, " cities"]
    """Whether a city's positions are real; False where all its images have the same position."""


def views_of(places: Places) -> Views:
    """Read positions and headings; a city's UTM zone is that of its median longitude.

    Raises:
        InputError: a file is not named in the way of GSV-Cities, or bears no latitude or longitude.
    """
    fields = np.array([_fields(places, file) for file in places.files])
    heading, latitude, longitude = fields.T
    city = places.place_city[places.image_place]
    east, north = np.empty(len(city)), np.empty(len(city))
    known = np.zeros(len(places.cities), bool)
    for number in np.unique(city):
        of = city == number
        # Make longitudes continuous where a city lies on both sides of 180 degrees.
        first = longitude[of][0]
        here = first + (longitude[of] - first + 180) % 360 - 180
        known[number] = np.ptp(latitude[of]) > 0 or np.ptp(here) > 0
        central = 6 * np.floor(np.median(here) / 6) + 3
        east[of], north[of] = transverse_mercator(latitude[of], here - central)
    return Views(east, north, heading % 360, known)


def _fields(places: Places, file: str) -> tuple[float, float, float]:
    match = _NAME.match(file.rpartition("/")[2])
    try:
        if match is None:
            raise ValueError
        heading, latitude, longitude = map(float, match.groups())
    except ValueError:
        raise InputError(
            f"{places.root / file}: found a name without direction and position, expected "
            "city_place_year_month_northdeg_lat_lon_panoid"
        ) from None
    if not (abs(latitude) < 90 and abs(longitude) <= 180):
        raise InputError(
            f"{places.root / file}: found lat {match[2]} and lon {match[3]}, expected a latitude "
            "between the poles and a longitude of at most 180 degrees"
        )
    return heading, latitude, longitude


def transverse_mercator(
    latitude: Float64[np.ndarray, " point"], longitude: Float64[np.ndarray, " point"]
) -> tuple[Float64[np.ndarray, " point"], Float64[np.ndarray, " point"]]:
    """Compute UTM's east and north in metres; north is negative in the south.

    The formula is Krueger's series (1912) of third order in the third flattening, as in Karney,
    Transverse Mercator with an accuracy of a few nanometers (J. Geodesy 2011). It is exact to a
    millimetre in a zone and its neighbours.

    Args:
        latitude: degrees on WGS84.
        longitude: degrees from the zone's central meridian.
    """
    n = _FLATTENING / (2 - _FLATTENING)
    eccentricity = np.sqrt(_FLATTENING * (2 - _FLATTENING))
    radius = _EQUATOR / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    series = (
        n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16,
        13 * n**2 / 48 - 3 * n**3 / 5,
        61 * n**3 / 240,
    )
    sine, turn = np.sin(np.deg2rad(latitude)), np.deg2rad(longitude)
    conformal = np.sinh(np.arctanh(sine) - eccentricity * np.arctanh(eccentricity * sine))
    along = np.arctan2(conformal, np.cos(turn))
    across = np.arcsinh(np.sin(turn) / np.hypot(conformal, np.cos(turn)))
    east, north = across.copy(), along.copy()
    for order, weight in enumerate(series, start=1):
        north += weight * np.sin(2 * order * along) * np.cosh(2 * order * across)
        east += weight * np.cos(2 * order * along) * np.sinh(2 * order * across)
    return _FALSE_EAST + _SCALE * radius * east, _SCALE * radius * north
