"""How a picture is taken: the camera's pose, its surroundings, and what it sees."""

import dataclasses
from collections.abc import Sequence
from typing import Annotated, Literal, get_args

import numpy as np
from jaxtyping import Float

from crisalad_jax.config.checks import check_types, limited, require

Season = Literal["spring", "summer", "autumn", "winter"]
Time = Literal["noon", "dusk", "night"]
Weather = Literal["clear", "overcast", "haze", "rain"]
Scenery = Literal["street", "corridor", "country", "room", "shapes"]
"""Kind of place: a city street, a corridor or hall, a road or railway through the country, a
furnished room, or meaningless boxes, poles and sheets in the open."""

SEASONS: tuple[Season, ...] = get_args(Season)
TIMES: tuple[Time, ...] = get_args(Time)
WEATHERS: tuple[Weather, ...] = get_args(Weather)
SCENERIES: tuple[Scenery, ...] = get_args(Scenery)

EYE = 2.4
"""Metres from the ground to the camera of the default view."""
PITCH = 8.0
"""Degrees by which the camera of the default view is tilted up."""
NEAR = 0.4
"""Metres from the camera to the near plane; nothing nearer is drawn."""
Repaint = Annotated[float, limited(0, 3)]


@dataclasses.dataclass(frozen=True)
class View:
    """How one picture of a place is taken: the camera's pose, its surroundings, its sensor."""

    lateral: float = 0.0
    """Metres to the right of the place's centre, across the street."""
    forward: float = 0.0
    """Metres along the street, towards its far end."""
    heading: float = 0.0
    """Degrees clockwise from the place's default direction, `Place.heading`."""
    height: float = EYE
    """Metres from the ground to the camera."""
    pitch: float = PITCH
    """Degrees by which the camera is tilted up."""
    field: Annotated[float, limited(10, 150)] = 80.0
    """Horizontal field of view in degrees."""
    repaint: Repaint = 0.0
    """Standard deviation of a random change in the log colour of each part, as by other paint."""
    season: Season = "summer"
    time: Time = "noon"
    weather: Weather = "clear"
    occluders: int | None = None
    """Seed of the cars, buses and people in the street; None leaves it empty."""
    crowd: Annotated[int, limited(0)] = 0
    """Number of additional people; ignored if `occluders` is None."""
    exposure: float = 0.0
    """Exposure in stops, relative to the default."""
    noise: Annotated[float, limited(0, 255)] = 0.0
    """Standard deviation of the sensor noise, in grey levels, which are 0 to 255."""
    seed: int = 0
    """Seed of the sun's position, clouds, rain, lit windows, white balance and noise."""

    def __post_init__(self) -> None:
        """Check the fields."""
        check_types(self)


def check_size(what: str, size: Sequence[int]) -> None:
    """Check the height and width of a picture in pixels.

    Raises:
        InputError: a side is not from 16 to 2048; the message names the argument `what`.
    """
    for side in size:
        require(16 <= side <= 2048, f"{what}: found {side}, expected 16 to 2048")


class Camera:
    """A pinhole camera in a place; its axes are right, up and ahead."""

    def __init__(self, heading: float, view: View, size: tuple[int, int]) -> None:
        """Place the camera, given the default view's heading in degrees and the size in pixels."""
        self.centre = np.array(size[::-1]) / 2
        self.tan_half_width = np.tan(np.deg2rad(view.field) / 2)
        self.focal = self.centre[0] / self.tan_half_width
        self.pitch, self.yaw = np.deg2rad(view.pitch), np.deg2rad(heading + view.heading)
        self._position = np.array((view.lateral, view.height, view.forward))
        sin, cos = np.sin(self.yaw), np.cos(self.yaw)
        turn = np.array(((cos, 0, -sin), (0, 1, 0), (sin, 0, cos)))
        sin, cos = np.sin(self.pitch), np.cos(self.pitch)
        tilt = np.array(((1, 0, 0), (0, cos, -sin), (0, sin, cos)))
        self._rotation = tilt @ turn

    def see(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Convert points from the place's axes to the camera's (right, up, ahead), in metres."""
        return (points - self._position) @ self._rotation.T

    def project(self, seen: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Project points in camera axes, beyond the near plane, to pixels (x, y)."""
        return self.centre + self.focal * seen[:, :2] * (1, -1) / seen[:, 2:]

    def outlines(self, seen: np.ndarray, sizes: np.ndarray) -> list[np.ndarray | None]:
        """Project polygons to outlines in quarters of a pixel, or to None if out of sight."""
        ends = np.cumsum(sizes)
        starts = ends - sizes
        x, y, depth = seen.T
        wide, tall = (side * depth for side in self.centre / self.focal)
        # A polygon is out of sight if all corners lie beyond one plane of the camera's pyramid.
        inside = np.stack((depth - NEAR, wide - x, wide + x, tall - y, tall + y), -1)
        usable = (np.maximum.reduceat(inside, starts) >= 0).all(1)
        whole = np.minimum.reduceat(depth, starts) >= NEAR
        corners = _fixed_point(self.project(np.c_[seen[:, :2], depth.clip(NEAR)]))
        outlines: list[np.ndarray | None] = [None] * len(sizes)
        for i in np.flatnonzero(usable).tolist():
            run = slice(starts[i], ends[i])
            if whole[i]:
                outlines[i] = corners[run]
            elif len(clipped := clip_near(seen[run])) > 2:
                outlines[i] = _fixed_point(self.project(clipped))
        return outlines


def clip_near(polygon: Float[np.ndarray, "corner 3"]) -> Float[np.ndarray, "kept 3"]:
    """Clip a polygon, in camera axes, at the near plane (Sutherland-Hodgman)."""
    corners = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if a[2] >= NEAR:
            corners.append(a)
        if (a[2] >= NEAR) != (b[2] >= NEAR):
            corners.append(a + (b - a) * ((NEAR - a[2]) / (b[2] - a[2])))
    return np.array(corners).reshape(-1, 3)


def _fixed_point(pixels: np.ndarray) -> np.ndarray:
    """Round pixels to quarters, as OpenCV's `shift=2` takes them, clipped against overflow."""
    return np.clip(np.round(pixels * 4), -120000, 120000).astype(np.int32)
