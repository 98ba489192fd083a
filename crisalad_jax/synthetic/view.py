"""The view of a picture: the camera's pose, the season, hour and weather, and the traffic."""

import dataclasses
from typing import Literal, get_args

from crisalad_jax.utils.errors import InputError

Season = Literal["spring", "summer", "autumn", "winter"]
Time = Literal["noon", "dusk", "night"]
Weather = Literal["clear", "overcast", "haze", "rain"]
Scenery = Literal["street", "corridor", "country"]
"""What a place is: a city's street, a corridor or hall, a road or railway through the country."""

SEASONS: tuple[Season, ...] = ("spring", "summer", "autumn", "winter")
TIMES: tuple[Time, ...] = ("noon", "dusk", "night")
WEATHERS: tuple[Weather, ...] = ("clear", "overcast", "haze", "rain")
SCENERIES: tuple[Scenery, ...] = get_args(Scenery)

EYE = 2.4
"""Metres from the ground to the camera of the default view."""
PITCH = 8.0
"""Degrees by which it looks up."""
FIELD = 80.0
"""Degrees from its left border to the right."""


@dataclasses.dataclass(frozen=True)
class View:
    """How one picture of a place is taken: the camera's pose, its surroundings, its sensor."""

    lateral: float = 0.0
    """Metres to the right of the place's centre, across the street."""
    forward: float = 0.0
    """Metres along the street, towards its far end."""
    heading: float = 0.0
    """Degrees clockwise from the direction in which the place is usually seen."""
    height: float = EYE
    """Metres from the ground to the camera."""
    pitch: float = PITCH
    """Degrees by which it looks up."""
    field: float = FIELD
    """Degrees from its left border to the right."""
    repaint: float = 0.0
    """Standard deviation of a change of every part's log colour: other paint, other light."""
    season: Season = "summer"
    time: Time = "noon"
    weather: Weather = "clear"
    occluders: int | None = None
    """Seed of the cars, buses and people in the street; None leaves it empty."""
    exposure: float = 0.0
    """Exposure in stops."""
    noise: float = 0.0
    """Standard deviation of the sensor noise, in grey levels of 255."""
    seed: int = 0
    """Seed of the sun's position, clouds, rain, lit windows, white balance and noise."""

    def __post_init__(self) -> None:
        """Check the names and the ranges."""
        for name, choices in (("season", SEASONS), ("time", TIMES), ("weather", WEATHERS)):
            value = getattr(self, name)
            if value not in choices:
                raise InputError(
                    f"View.{name}: found {value!r}, expected one of {', '.join(choices)}"
                )
        if not 0 <= self.noise <= 255:
            raise InputError(f"View.noise: found {self.noise}, expected 0 to 255 grey levels")
        check_repaint("View.repaint", self.repaint)
        if not 10 <= self.field <= 150:
            raise InputError(f"View.field: found {self.field}, expected 10 to 150 degrees")


def check_repaint(what: str, deviation: float) -> None:
    """Check a deviation of log colours, of which 3 leaves little of a picture.

    Raises:
        InputError: it is out of range; the message names the argument `what`.
    """
    if not 0 <= deviation <= 3:
        raise InputError(f"{what}: found {deviation}, expected 0 to 3")


def check_size(what: str, size: tuple[int, int]) -> None:
    """Check the height and width of a picture in pixels.

    Raises:
        InputError: they are not two, or out of range; the message names the argument `what`.
    """
    if len(size) != 2 or min(size) < 16 or max(size) > 2048:
        raise InputError(f"{what}: found {size}, expected a height and a width from 16 to 2048")
