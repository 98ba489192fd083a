"""Read the positions and headings of a training set's images from their names or table."""

import re
from typing import NamedTuple

import numpy as np

from crisalad_jax.data.metres import continuous, to_metres
from crisalad_jax.data.places import Places
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Bool, Float64

_NAME = re.compile(r".*?_\d{7,}_\d{4,}_\d{2,}_(\d{3,})_([^_]+)_([^_]+)_")
"""`data.places` writes a row's northdeg, latitude and longitude into its image's name."""


_WIDEST = 60.0
"""Degrees of longitude of a city's images; a plane of more stretches distances by over 15 %."""


class Views(NamedTuple):
    """Position and heading of every image; metres are of one UTM zone for each city."""

    east: Float64[np.ndarray, " images"]
    north: Float64[np.ndarray, " images"]
    """UTM north in metres; negative south of the equator, where maps add 10,000 km."""
    heading: Float64[np.ndarray, " images"]
    """Heading in degrees clockwise from north, 0 to 360; NaN where unknown."""
    known: Bool[np.ndarray, " cities"]
    """Whether a city's positions are real; False where all its images have the same position."""


def views_of(places: Places) -> Views:
    """Read positions and headings; a city's UTM zone is that of its median longitude.

    Raises:
        InputError: in the layout of GSV-Cities, a file is not named in its way, or bears no
            latitude or longitude; or a city is wider than a plane can be.
    """
    if places.names is None:
        fields = np.array([_fields(places, file) for file in places.files])
        heading, latitude, longitude = fields.T
    elif places.views is not None:
        latitude, longitude, heading = places.views.T
    else:
        latitude, longitude, heading = np.zeros((3, len(places.files)))
    city = places.place_city[places.image_place]
    east, north = np.empty(len(city)), np.empty(len(city))
    known = np.zeros(len(places.cities), bool)
    for number in np.unique(city):
        of = city == number
        here = continuous(longitude[of])
        if (wide := np.ptp(here)) > _WIDEST:
            raise InputError(
                f"{places.root}: found the images of {places.cities[number]} over {wide:.0f} "
                f"degrees of longitude, expected at most {_WIDEST:g}, as cells are of one plane: "
                "a set of several cities has a table each, or no columns lat,lon"
            )
        known[number] = np.ptp(latitude[of]) > 0 or np.ptp(here) > 0
        east[of], north[of] = to_metres(latitude[of], here)
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
