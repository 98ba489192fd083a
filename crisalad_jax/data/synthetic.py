"""A procedural city: street canyons of planar polygons, drawn through a pinhole camera.

It is written in two real layouts: GSV-Cities (Ali-bey et al. 2022) to train on, and that of
VPR-datasets-downloader to evaluate on.
"""

import dataclasses
import enum
import functools
import itertools
import json
import math
import os
import pathlib
import shutil
import uuid
from collections.abc import Callable, Iterable
from typing import Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from crisalad_jax.errors import InputError
from crisalad_jax.files import write_json

Season = Literal["spring", "summer", "autumn", "winter"]
Time = Literal["noon", "dusk", "night"]
Weather = Literal["clear", "overcast", "haze", "rain"]

SEASONS: tuple[Season, ...] = ("spring", "summer", "autumn", "winter")
TIMES: tuple[Time, ...] = ("noon", "dusk", "night")
WEATHERS: tuple[Weather, ...] = ("clear", "overcast", "haze", "rain")

CITY_NAMES = ("Alderby", "Brackwater")
"""The training cities, which exist nowhere."""

RENDERER = 1
"""Raise when the same configuration gives other pictures: a city on disk is then another one."""

PLACE_SPACING = 80.0
"""Metres between neighbouring places: more than three times the 25 m that make a positive."""


@dataclasses.dataclass(frozen=True)
class View:
    """How one picture of a place is taken: the camera's pose, and everything that passes."""

    lateral: float = 0.0
    """Metres to the right of the place's centre, across the street."""
    forward: float = 0.0
    """Metres along the street: how far the camera has come nearer to its far end."""
    heading: float = 0.0
    """Degrees clockwise from the direction in which the place is usually seen."""
    season: Season = "summer"
    time: Time = "noon"
    weather: Weather = "clear"
    occluders: int | None = None
    """Seed of the cars, buses and people in the street; None leaves it empty."""
    exposure: float = 0.0
    """Stops."""
    noise: float = 0.0
    """Standard deviation of the sensor noise, in grey levels of 255."""
    seed: int = 0
    """Of the sun's place, clouds, rain, the windows that are lit, white balance and noise."""

    def __post_init__(self) -> None:
        """Check the names and the ranges."""
        for name, choices in (("season", SEASONS), ("time", TIMES), ("weather", WEATHERS)):
            value = getattr(self, name)
            if value not in choices:
                raise InputError(
                    f"View.{name}: found {value!r}, expected one of {', '.join(choices)}"
                )
        if not self.noise >= 0:
            raise InputError(f"View.noise: found {self.noise}, expected at least 0")


@dataclasses.dataclass(frozen=True)
class SyntheticCityConfig:
    """What `write_synthetic_city` writes."""

    train_places: int = 240
    """Shared out over the two training cities."""
    images_per_place: int = 4
    """Of a training place; GSV-Cities keeps places with at least 4."""
    test_places: int = 150
    database_per_place: int = 1
    queries_per_place: int = 1
    image_size: tuple[int, int] = (126, 168)
    """Height and width in pixels."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name, least in (
            ("train_places", len(CITY_NAMES)),
            ("images_per_place", 1),
            ("test_places", 1),
            ("database_per_place", 1),
            ("queries_per_place", 1),
            ("seed", 0),
        ):
            value = getattr(self, name)
            if value < least:
                raise InputError(
                    f"SyntheticCityConfig.{name}: found {value}, expected at least {least}"
                )
        _check_size("SyntheticCityConfig.image_size", self.image_size)


def _check_size(what: str, size: tuple[int, int]) -> None:
    if len(size) != 2 or min(size) < 16 or max(size) > 2048:
        raise InputError(f"{what}: found {size}, expected a height and a width from 16 to 2048")


# ------------------------------------------------------------------------------------------------
# Geometry, in metres: x to the right across the street, y up, z along it. The camera of the default
# view stands at x = z = 0. A scene is a list of parts, painted from the far ones to the near.


class _Kind(enum.IntEnum):
    """What a part is made of, which decides how season and light change it."""

    SOLID = 0
    ROOF = 1
    LEDGE = 2
    PAVEMENT = 3
    ROAD = 4
    GRASS = 5
    LEAF = 6
    NEEDLE = 7
    GLASS = 8
    SHOP = 9
    LAMP = 10
    HEADLIGHT = 11
    TAILLIGHT = 12


_EYE = 2.4
"""Metres from the ground to the camera."""
_GROUND_LAYER = 1e6
"""Parts from this layer on lie on the ground, under every shadow."""
_UP = (0.0, 1.0, 0.0)
_TO_CAMERA = (0.0, 0.0, -1.0)

Vector = tuple[float, float, float]
Colour = Vector


def _scaled(colour: Colour, gain: float) -> Colour:
    return (colour[0] * gain, colour[1] * gain, colour[2] * gain)


class _Scene(NamedTuple):
    """Parts as arrays: points in metres, polygons as runs of points, parts as runs of polygons."""

    points: Float[np.ndarray, "point 3"]
    polygon_sizes: Int[np.ndarray, " polygon"]
    part_sizes: Int[np.ndarray, " part"]
    albedo: Float[np.ndarray, "part 3"]
    normal: Float[np.ndarray, "part 3"]
    kind: Int[np.ndarray, " part"]
    layer: Float[np.ndarray, " part"]
    """Painting order: larger is farther away."""


class _Mesh:
    """Gathers parts; a part is any number of polygons of one colour, one normal and one layer."""

    def __init__(self) -> None:
        self.layer = 0.0
        self._points: list[np.ndarray] = []
        self._polygon_sizes: list[np.ndarray] = []
        self._parts: list[tuple[int, Colour, Vector, int, float]] = []

    def add(
        self,
        polygons: Float[np.ndarray, "polygon corner 3"],
        albedo: Colour,
        normal: Vector,
        kind: _Kind = _Kind.SOLID,
    ) -> None:
        count, corners, _ = polygons.shape
        if count:
            self._points.append(polygons.reshape(-1, 3))
            self._polygon_sizes.append(np.full(count, corners))
            self._parts.append((count, albedo, normal, int(kind), self.layer))

    def scene(self) -> _Scene:
        counts, albedo, normal, kind, layer = zip(*self._parts, strict=True)
        return _Scene(
            np.concatenate(self._points),
            np.concatenate(self._polygon_sizes),
            np.array(counts),
            np.array(albedo, np.float64),
            np.array(normal, np.float64),
            np.array(kind),
            np.array(layer, np.float64),
        )


def _join(first: _Scene, second: _Scene) -> _Scene:
    return _Scene(*(np.concatenate(pair) for pair in zip(first, second, strict=True)))


Number = int | float | np.ndarray


def _polygons(*corners: tuple[Number, Number, Number]) -> Float[np.ndarray, "n corner 3"]:
    """As many polygons as a coordinate's array has numbers; a single number serves for all."""
    numbers = [number for corner in corners for number in corner]
    count = next((len(n) for n in numbers if isinstance(n, np.ndarray)), 1)
    flat = np.empty((count, len(numbers)))
    for column, number in enumerate(numbers):
        flat[:, column] = number
    return flat.reshape(count, len(corners), 3)


def _rectangles(
    x0: Number, y0: Number, x1: Number, y1: Number, z: Number = 0.0
) -> Float[np.ndarray, "n 4 3"]:
    """Upright rectangles that face along the third axis."""
    return _polygons((x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z))


def _flat(x0: Number, z0: Number, x1: Number, z1: Number) -> Float[np.ndarray, "n 4 3"]:
    """Rectangles on the ground."""
    return _polygons((x0, 0.0, z0), (x1, 0.0, z0), (x1, 0.0, z1), (x0, 0.0, z1))


def _discs(x: Number, y: Number, radius: Number, z: float) -> Float[np.ndarray, "n 10 3"]:
    """Round polygons that face the camera."""
    angles = np.arange(10) * (2 * np.pi / 10)
    return _polygons(*((x + radius * np.cos(a), y + radius * np.sin(a), z) for a in angles))


class _Front:
    """A vertical plane to put parts on: u runs along it, v up, d out of it towards the street."""

    def __init__(
        self, mesh: _Mesh, origin: Vector, along: Vector, normal: Vector, *, sees_start: bool
    ) -> None:
        self.mesh = mesh
        self.normal = normal
        self.sees_start = sees_start
        """Whether the ends in sight are those towards small u, or those towards large u."""
        self.end_normal = _scaled(along, -1.0 if sees_start else 1.0)
        self._origin = np.array(origin)
        self._axes = np.array((along, _UP, normal))

    def add(
        self,
        uvd: Float[np.ndarray, "n corner 3"],
        albedo: Colour,
        kind: _Kind = _Kind.SOLID,
        normal: Vector | None = None,
    ) -> None:
        """Polygons in the plane's own metres, which look out of it unless `normal` differs."""
        self.mesh.add(uvd @ self._axes + self._origin, albedo, normal or self.normal, kind)

    def boxes(
        self,
        rects: tuple[Number, Number, Number, Number],
        out: float,
        albedo: Colour,
        kind: _Kind = _Kind.SOLID,
    ) -> None:
        """Boxes u0, v0, u1, v1 that stand out: the end in sight, top or underside, front."""
        u0, v0, u1, v1 = rects
        u = u0 if self.sees_start else u1
        end = _polygons((u, v0, 0.0), (u, v0, out), (u, v1, out), (u, v1, 0.0))
        self.add(end, albedo, normal=self.end_normal)
        above = float(np.min(v0)) > _EYE
        v = v0 if above else v1
        level = _polygons((u0, v, 0.0), (u1, v, 0.0), (u1, v, out), (u0, v, out))
        self.add(level, albedo, normal=(0.0, -1.0, 0.0) if above else _UP)
        self.add(_rectangles(u0, v0, u1, v1, out), albedo, kind)


def _street_front(mesh: _Mesh, x: float, z: float) -> _Front:
    """A plane along the street that looks to its middle."""
    normal = (1.0 if x < 0 else -1.0, 0.0, 0.0)
    return _Front(mesh, (x, 0.0, z), (0.0, 0.0, 1.0), normal, sees_start=True)


def _block(mesh: _Mesh, low: Vector, high: Vector, albedo: Colour) -> None:
    """An upright box: its top, the side that looks to the middle of the street, its near face."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    left = x0 + x1 < 0
    x = x1 if left else x0
    top = _polygons((x0, y1, z0), (x1, y1, z0), (x1, y1, z1), (x0, y1, z1))
    side = _polygons((x, y0, z0), (x, y0, z1), (x, y1, z1), (x, y1, z0))
    mesh.add(top, albedo, _UP, _Kind.ROOF)
    mesh.add(side, albedo, (1.0 if left else -1.0, 0.0, 0.0))
    mesh.add(_rectangles(x0, y0, x1, y1, z0), albedo, _TO_CAMERA)


# ------------------------------------------------------------------------------------------------
# What stands in a place.

_WALLS: tuple[Colour, ...] = (
    (0.55, 0.29, 0.23),
    (0.76, 0.60, 0.36),
    (0.84, 0.78, 0.64),
    (0.56, 0.56, 0.57),
    (0.70, 0.60, 0.48),
    (0.74, 0.54, 0.49),
    (0.58, 0.66, 0.72),
    (0.57, 0.63, 0.50),
    (0.86, 0.85, 0.82),
    (0.40, 0.27, 0.24),
    (0.66, 0.64, 0.61),
    (0.42, 0.45, 0.49),
    (0.70, 0.42, 0.30),
)
_TRIMS: tuple[Colour, ...] = (
    (0.88, 0.87, 0.84),
    (0.30, 0.27, 0.25),
    (0.70, 0.66, 0.58),
    (0.24, 0.33, 0.30),
)
_ROOFS: tuple[Colour, ...] = (
    (0.52, 0.27, 0.20),
    (0.33, 0.33, 0.36),
    (0.42, 0.34, 0.29),
    (0.30, 0.42, 0.38),
)
_SIGNS: tuple[Colour, ...] = (
    (0.70, 0.16, 0.14),
    (0.13, 0.28, 0.52),
    (0.12, 0.40, 0.24),
    (0.85, 0.66, 0.14),
    (0.20, 0.18, 0.20),
    (0.82, 0.80, 0.76),
)
_GLASS: Colour = (0.16, 0.20, 0.25)


def _pick(rng: np.random.Generator, colours: tuple[Colour, ...], spread: float = 0.06) -> Colour:
    red, green, blue = colours[rng.integers(len(colours))]
    gain = 1 + rng.uniform(-spread, spread)
    return (red * gain, green * gain, blue * gain)


class _Habit(NamedTuple):
    """What the buildings of one street have in common."""

    walls: tuple[Colour, ...]
    floors: int
    storey: float
    """Metres from floor to floor."""
    spacing: float
    """Metres between the axes of windows."""


class _Body(NamedTuple):
    """The ground a building stands on and its height, in metres: what throws a shadow."""

    x0: float
    x1: float
    z0: float
    z1: float
    height: float


_DEPTH = 11.0
"""Metres from a building's front to its back."""


def _building(rng: np.random.Generator, front: _Front, width: float, habit: _Habit) -> float:
    """Add a building from u = 0 to `width`; return its height in metres."""
    wall, trim = _pick(rng, habit.walls), _pick(rng, _TRIMS)
    floors = max(1, habit.floors + int(rng.integers(-2, 3)))
    ground = rng.uniform(3.2, 4.8)
    storey = habit.storey + rng.uniform(-0.3, 0.4)
    height = ground + storey * floors + rng.uniform(0.2, 1.0)

    end = 0.0 if front.sees_start else width
    side = _polygons((end, 0, 0), (end, 0, -_DEPTH), (end, height, -_DEPTH), (end, height, 0))
    front.add(side, _scaled(wall, 0.85), normal=front.end_normal)
    _roof(rng, front, width, height, wall)
    front.add(_rectangles(0, 0, width, height), wall)
    base = _scaled(wall, 0.72) if rng.random() < 0.5 else _pick(rng, _WALLS)
    front.add(_rectangles(0, 0, width, ground - 0.3), base)
    if rng.random() < 0.3:
        u = np.linspace(0.35, width - 0.35, int(rng.integers(2, 5)))
        front.add(_rectangles(u - 0.3, ground, u + 0.3, height), _scaled(wall, 1.16))
    if rng.random() < 0.4:
        v = ground + storey * np.arange(floors)
        front.add(_rectangles(0, v - 0.15, width, v + 0.12), _scaled(wall, 1.18), _Kind.LEDGE)

    _windows(rng, front, width, ground + storey * np.arange(floors), storey, habit.spacing, trim)
    use = rng.choice(("shop", "arcade", "door"), p=(0.42, 0.16, 0.42))
    if use == "shop":
        _shops(rng, front, width, ground - 1.1)
    elif use == "arcade":
        u, cell = _axes(width, rng.uniform(3.0, 5.0))
        _arches(front, u, cell * 0.34, 0.0, ground - 1.3, (0.13, 0.12, 0.12), _Kind.SOLID)
    else:
        _door(rng, front, width, ground - 1.0, trim)
    if rng.random() < 0.55:
        front.boxes((0.0, height - 0.45, width, height), 0.5, trim, _Kind.LEDGE)
    if rng.random() < 0.3:
        u, top = rng.uniform(0.15, 0.85) * width, ground + rng.uniform(1.0, 3.5)
        sign = (u - 0.1, ground - 0.2, u + 0.1, top)
        front.boxes(sign, rng.uniform(0.9, 1.5), _pick(rng, _SIGNS))
    return height


def _axes(width: float, spacing: float) -> tuple[np.ndarray, float]:
    """The middles of the equal cells, about `spacing` wide, that fill a width; and their width."""
    count = max(1, round(width / spacing))
    return (np.arange(count) + 0.5) * width / count, width / count


def _arches(
    front: _Front, u: Number, half: Number, v0: Number, v1: Number, albedo: Colour, kind: _Kind
) -> None:
    """Openings with a rounded head, `half` metres to either side of u."""
    front.add(_rectangles(u - half, v0, u + half, v1), albedo, kind)
    head, tip = v1 + 0.8 * half, 0.5 * half
    arch = _polygons((u - half, v1, 0), (u + half, v1, 0), (u + tip, head, 0), (u - tip, head, 0))
    front.add(arch, albedo, kind)


def _roof(
    rng: np.random.Generator, front: _Front, width: float, height: float, wall: Colour
) -> None:
    """Pitched, gabled to the street, mansard with dormers, or flat with what stands on it."""
    tiles = _pick(rng, _ROOFS)
    shape = rng.choice(("pitched", "gable", "mansard", "flat"), p=(0.3, 0.17, 0.15, 0.38))
    x, _, z = front.normal
    uphill = (x * 0.6, 0.8, z * 0.6)
    if shape == "pitched":
        back, ridge = -_DEPTH / 2, height + rng.uniform(1.8, 4.0)
        end = 0.0 if front.sees_start else width
        gable = _polygons((end, height, 0), (end, height, -_DEPTH), (end, ridge, back))
        front.add(gable, _scaled(wall, 0.85), normal=front.end_normal)
        slope = _polygons(
            (0, height, 0.3), (width, height, 0.3), (width, ridge, back), (0, ridge, back)
        )
        front.add(slope, tiles, _Kind.ROOF, uphill)
        u = rng.uniform(0.1, 0.8) * width
        chimney = _rectangles(u, (height + ridge) / 2, u + 0.9, ridge + 1.2, back * 0.7)
        front.add(chimney, _scaled(wall, 0.8))
    elif shape == "gable":
        rise, steps = width * rng.uniform(0.3, 0.55), int(rng.integers(1, 5))
        if steps == 1:
            front.add(
                _polygons((0, height, 0), (width, height, 0), (width / 2, height + rise, 0)), wall
            )
        else:
            v = height + rise * np.arange(steps) / steps
            inset = width / 2 * np.arange(steps) / steps
            front.add(_rectangles(inset, v, width - inset, v + rise / steps), wall)
        u = width / 2
        eye = _rectangles(u - 0.5, height + 0.2, u + 0.5, height + rise * 0.45)
        front.add(eye, _GLASS, _Kind.GLASS)
    elif shape == "mansard":
        top = height + rng.uniform(2.4, 3.4)
        slope = _polygons((0, height, 0), (width, height, 0), (width, top, -1), (0, top, -1))
        front.add(slope, tiles, _Kind.ROOF, uphill)
        u, _ = _axes(width, rng.uniform(2.6, 4.5))
        dormers = _rectangles(u - 0.75, height + 0.4, u + 0.75, top - 0.3, -0.1)
        front.add(dormers, _scaled(wall, 1.1))
        panes = _rectangles(u - 0.45, height + 0.6, u + 0.45, top - 0.6, -0.1)
        front.add(panes, _GLASS, _Kind.GLASS)
    else:
        parapet = _rectangles(0, height, width, height + rng.uniform(0.3, 0.9))
        front.add(parapet, _scaled(wall, 0.9), _Kind.LEDGE)
        if rng.random() < 0.5:
            u, size = rng.uniform(0.1, 0.6) * width, rng.uniform(1.5, 4.0)
            tank = _rectangles(u, height, u + size, height + size * rng.uniform(0.6, 1.3), -3.0)
            front.add(tank, _scaled(wall, 0.7))
        if rng.random() < 0.4:
            u, top = rng.uniform(0.1, 0.9) * width, height + rng.uniform(2.5, 6.0)
            mast = np.array((u, u - 0.9)), np.array((height, top - 0.9))
            tips = np.array((u + 0.14, u + 1.0)), np.array((top, top - 0.76))
            front.add(_rectangles(*mast, *tips, -2.0), (0.25, 0.25, 0.27))


def _windows(
    rng: np.random.Generator,
    front: _Front,
    width: float,
    levels: Float[np.ndarray, " floor"],
    storey: float,
    spacing: float,
    trim: Colour,
) -> None:
    """The windows above the ground floor, with their frames, shutters, sills and balconies."""
    axis, cell = _axes(width, spacing * rng.uniform(0.8, 1.25))
    columns = len(axis)
    halves = np.full(columns, cell * rng.uniform(0.17, 0.33))
    tall = storey * rng.uniform(0.45, 0.72)
    low = levels + (storey - tall) * rng.uniform(0.4, 0.7)
    high = low + tall
    style = rng.choice(("grid", "bands", "shafts"), p=(0.76, 0.14, 0.10))
    # The rhythm of the columns is what outlives season and light.
    rhythm = rng.integers(6)
    kept = np.ones(columns, bool)
    if rhythm == 1 and columns > 2:
        kept[columns // 2] = False
    elif rhythm == 2:
        halves[1::2] *= 0.55
    elif rhythm == 3 and columns > 3:
        kept[2::3] = False
    elif rhythm == 4 and columns > 2:
        halves[columns // 2] = cell * 0.42
    axis, halves = axis[kept], halves[kept]
    if style == "bands":
        axis, halves = np.array([width / 2]), np.array([width * rng.uniform(0.4, 0.48)])
    elif style == "shafts":
        low, high = low[:1], high[-1:]
    elif len(levels) > 2 and rng.random() < 0.35:
        high[-1] = low[-1] + tall * 0.6
    u, half = np.tile(axis, len(low)), np.tile(halves, len(low))
    v0, v1 = np.repeat(low, len(axis)), np.repeat(high, len(axis))
    left, right = u - half, u + half

    if rng.random() < 0.6:
        front.add(_rectangles(left - 0.22, v0 - 0.22, right + 0.22, v1 + 0.22), trim)
    if style == "shafts":
        front.add(_rectangles(left, v0, right, v1), _GLASS, _Kind.GLASS)
        u, v = np.tile(axis, len(levels) - 1), np.repeat(levels[1:], len(axis))
        half = np.tile(halves, len(levels) - 1)
        front.add(_rectangles(u - half, v, u + half, v + 0.3), trim)
        return
    if style == "bands":
        front.add(_rectangles(left, v0, right, v1), _GLASS, _Kind.GLASS)
        return
    if rng.random() < 0.2:
        shutter = _pick(rng, _TRIMS)
        front.add(_rectangles(left - half * 0.75, v0, left, v1), shutter)
        front.add(_rectangles(right, v0, right + half * 0.75, v1), shutter)
    if rng.random() < 0.22:
        _arches(front, u, half, v0, v1, _GLASS, _Kind.GLASS)
    else:
        front.add(_rectangles(left, v0, right, v1), _GLASS, _Kind.GLASS)
    if rng.random() < 0.45:
        front.add(_rectangles(u - 0.06, v0, u + 0.06, v1), trim)
    if rng.random() < 0.5:
        front.add(_rectangles(left - 0.15, v0 - 0.22, right + 0.15, v0), trim, _Kind.LEDGE)
    if rng.random() < 0.32:
        on = np.tile(rng.random(len(axis)) < rng.choice((0.4, 1.0)), len(low))
        if on.any():
            rects = (left[on] - 0.25, v0[on] - 0.45, right[on] + 0.25, v0[on] + 0.6)
            front.boxes(rects, 0.9, trim)


def _shops(rng: np.random.Generator, front: _Front, width: float, lintel: float) -> None:
    """Shop windows, each with its door and its sign, some with an awning."""
    middle, span = _axes(width, rng.uniform(4.0, 8.0))
    start = middle - span / 2
    end = start + span * rng.uniform(0.5, 0.8)
    front.add(_rectangles(start + 0.4, 0.5, end, lintel), _scaled(_GLASS, 1.2), _Kind.SHOP)
    front.add(_rectangles(end + 0.35, 0, end + 1.3, lintel), _scaled(_GLASS, 1.2), _Kind.SHOP)
    for u0, u1 in zip(start, end, strict=True):
        board = _rectangles(u0 + 0.3, lintel + 0.1, u0 + span - 0.3, lintel + 0.8)
        front.add(board, _pick(rng, _SIGNS))
        if rng.random() < 0.4:
            high, low, out = lintel + 0.2, lintel - 0.5, rng.uniform(1.0, 1.6)
            awning = _polygons((u0, high, 0), (u1, high, 0), (u1, low, out), (u0, low, out))
            front.add(awning, _pick(rng, _SIGNS), _Kind.LEDGE)


def _door(
    rng: np.random.Generator, front: _Front, width: float, lintel: float, trim: Colour
) -> None:
    """A house door among windows."""
    u, _ = _axes(width, rng.uniform(2.4, 4.0))
    at = int(rng.integers(len(u)))
    others = np.delete(u, at)
    front.add(_rectangles(others - 0.6, 1.1, others + 0.6, lintel), _GLASS, _Kind.GLASS)
    front.add(_rectangles(u[at] - 0.95, 0, u[at] + 0.95, 2.9), trim)
    front.add(_rectangles(u[at] - 0.65, 0, u[at] + 0.65, 2.6), _pick(rng, _SIGNS))


def _tree(mesh: _Mesh, rng: np.random.Generator, x: float, z: float) -> None:
    """A broad-leaved tree, bare in winter, or a conifer that stays green."""
    mesh.layer = z
    height = rng.uniform(4.5, 8.5)
    bark = (0.26, 0.21, 0.17)
    mesh.add(_rectangles(x - 0.16, 0, x + 0.16, height * 0.6, z), bark, _TO_CAMERA)
    if rng.random() < 0.2:
        for low, reach in ((0.2, 1.9), (0.44, 1.4), (0.68, 0.9)):
            y = height * low
            tier = _polygons((x - reach, y, z), (x + reach, y, z), (x, y + height * 0.42, z))
            mesh.add(tier, (0.13, 0.26, 0.17), (0.0, 0.5, -0.85), _Kind.NEEDLE)
        return
    n = 9
    angle = np.linspace(-1.1, 1.1, n) + rng.uniform(-0.12, 0.12, n)
    fork = height * rng.uniform(0.34, 0.6, n)
    length = height * rng.uniform(0.28, 0.46, n)
    tip_x, tip_y = x + np.sin(angle) * length, fork + np.cos(angle) * length
    mesh.add(_polygons((x, fork, z), (x + 0.12, fork, z), (tip_x, tip_y, z)), bark, _TO_CAMERA)
    middle_x, middle_y = (x + tip_x) / 2, (fork + tip_y) / 2
    twig_x, twig_y = middle_x + np.sin(angle * 0.3) * 0.9, middle_y + 1.0
    twigs = _polygons((middle_x, middle_y, z), (middle_x + 0.08, middle_y, z), (twig_x, twig_y, z))
    mesh.add(twigs, bark, _TO_CAMERA)
    hue = float(rng.random())
    for shade, lift, count in ((0.62, -0.25, 6), (0.85, 0.1, 6), (1.08, 0.45, 5)):
        across = height * 0.21 * (rng.normal(0, 0.62, count) - lift * 0.5)
        up = height * (0.72 + 0.21 * (rng.normal(0, 0.62, count) + lift))
        discs = _discs(x + across, up, height * 0.21 * rng.uniform(0.5, 0.85, count), z)
        # One part each: within a part, where polygons overlap, an even number leaves a hole.
        for disc in discs:
            mesh.add(disc[None], (hue, shade, 0.0), (0.0, 0.6, -0.8), _Kind.LEAF)


def _lamp(mesh: _Mesh, x: float, z: float, height: float) -> Vector:
    """A street lamp whose arm reaches over the street; returns where its light is."""
    mesh.layer = z
    tip = x + 1.3 if x < 0 else x - 1.3
    post = _rectangles(x - 0.09, 0, x + 0.09, height, z)
    arm = _rectangles(min(x, tip), height - 0.12, max(x, tip), height, z)
    mesh.add(np.concatenate((post, arm)), (0.20, 0.22, 0.22), _TO_CAMERA)
    head = _rectangles(tip - 0.35, height - 0.32, tip + 0.35, height - 0.08, z)
    mesh.add(head, (0.75, 0.74, 0.68), _TO_CAMERA, _Kind.LAMP)
    return (tip, height - 0.2, z)


class _Place(NamedTuple):
    scene: _Scene
    lamps: Float[np.ndarray, "lamp 3"]
    bodies: tuple[_Body, ...]
    bearing: float
    """Degrees clockwise from north of the street."""
    heading: float
    """Degrees clockwise from the street in which the default view looks."""
    lanes: tuple[float, float, float, float]
    """x of the left fronts, the left kerb, the right kerb and the right fronts."""
    hills: Float[np.ndarray, " bearing"]
    """Height of the hills over the horizon, as a tangent, at equal steps around the compass."""


@functools.lru_cache(maxsize=32)
def _place(seed: int) -> _Place:
    rng = np.random.default_rng((seed, 0))
    mesh = _Mesh()
    walls = tuple(_WALLS[i] for i in rng.choice(len(_WALLS), 5, replace=False))
    floors, storey = int(rng.integers(2, 6)), rng.uniform(2.9, 3.7)
    habit = _Habit(walls, floors, storey, rng.uniform(2.0, 3.8))
    left, right = -rng.uniform(6.5, 12.0), rng.uniform(6.5, 12.0)
    length = rng.uniform(28.0, 62.0)
    kerbs = (left + rng.uniform(2.0, 3.5), right - rng.uniform(2.0, 3.5))

    _ground(mesh, rng, kerbs, length)
    _skyline(mesh, rng, length)
    bodies = _far_row(mesh, rng, length, habit)
    park = rng.choice(3, p=(0.7, 0.15, 0.15))
    for number, x in ((1, left), (2, right)):
        if park == number:
            _park(mesh, rng, x, length)
        else:
            bodies += _row(mesh, rng, x, length, habit)
    lamps: list[Vector] = []
    for x in (kerbs[0] - 0.6, kerbs[1] + 0.6):
        if rng.random() < 0.55:
            for z in np.arange(rng.uniform(7.0, 16.0), length - 2, rng.uniform(7.0, 14.0)):
                if rng.random() < 0.8:
                    _tree(mesh, rng, x + rng.uniform(-0.3, 0.3), z + rng.uniform(-1, 1))
        if rng.random() < 0.6 or (x > 0 and not lamps):
            height = rng.uniform(5.0, 8.0)
            stations = np.arange(rng.uniform(6.0, 16.0), length + 4, rng.uniform(14.0, 24.0))
            lamps += [_lamp(mesh, x, float(z), height) for z in stations]
    if rng.random() < 0.4:
        _wires(mesh, rng, float(rng.choice(kerbs)), length)
    if rng.random() < 0.25:
        _monument(mesh, rng, sum(kerbs) / 2, rng.uniform(0.45, 0.9) * length)

    ridge = rng.uniform(0.0, 1.0, 24) ** 2 * rng.uniform(0.02, 0.2)
    hills = np.interp(np.arange(96), np.arange(24) * 4.0, ridge, period=96)
    bearing, heading = float(rng.uniform(0, 360)), float(rng.uniform(-20, 20))
    lanes = (left, *kerbs, right)
    return _Place(mesh.scene(), np.array(lamps), tuple(bodies), bearing, heading, lanes, hills)


def _ground(
    mesh: _Mesh, rng: np.random.Generator, kerbs: tuple[float, float], length: float
) -> None:
    """Pavements, the street, the street that crosses at its far end, and the lines on them."""
    paving = _pick(rng, ((0.56, 0.54, 0.51), (0.62, 0.58, 0.52), (0.50, 0.50, 0.50)))
    asphalt = _pick(rng, ((0.30, 0.30, 0.31), (0.36, 0.35, 0.34), (0.42, 0.38, 0.35)))
    left, right = kerbs
    mesh.layer = _GROUND_LAYER + 9
    mesh.add(_flat(-900, -20, 900, 2500), (0.44, 0.46, 0.40), _UP, _Kind.GRASS)
    mesh.layer = _GROUND_LAYER + 8
    mesh.add(_flat(-200, -20, 200, length + 25), paving, _UP, _Kind.PAVEMENT)
    mesh.layer = _GROUND_LAYER + 7
    street, crossing = _flat(left, -20, right, length + 1), _flat(-120, length + 1, 120, length + 8)
    mesh.add(np.concatenate((street, crossing)), asphalt, _UP, _Kind.ROAD)
    mesh.layer = _GROUND_LAYER + 6
    edge = np.array(kerbs)
    kerb = _flat(edge - 0.12, -5, edge + 0.12, length + 1)
    mesh.add(kerb, _scaled(paving, 1.25), _UP, _Kind.PAVEMENT)
    white, middle = (0.78, 0.78, 0.74), (left + right) / 2
    if rng.random() < 0.7:
        dash = rng.uniform(1.5, 3.5)
        z = np.arange(1, length, dash * 2)
        mesh.add(_flat(middle - 0.08, z, middle + 0.08, z + dash), white, _UP, _Kind.ROAD)
    if rng.random() < 0.45:
        z, x = rng.uniform(6.0, length - 6), np.arange(left + 0.4, right - 0.6, 1.0)
        mesh.add(_flat(x, z, x + 0.5, z + 3), white, _UP, _Kind.ROAD)
    if rng.random() < 0.35:
        x = np.array((left + 2.2, right - 2.2))
        mesh.add(_flat(x - 0.06, -5, x + 0.06, length), white, _UP, _Kind.ROAD)
    if rng.random() < 0.2:
        x = middle + np.array((-2.2, -0.8, 0.8, 2.2))
        mesh.add(_flat(x - 0.07, -5, x + 0.07, length), (0.20, 0.20, 0.21), _UP)


def _skyline(mesh: _Mesh, rng: np.random.Generator, length: float) -> None:
    """Distant towers, and at times a steeple above the roofs: landmarks that barely move."""
    for _ in range(int(rng.integers(0, 6))):
        z = length + rng.uniform(90, 320)
        x = rng.uniform(-0.9, 0.9) * z
        width, height = rng.uniform(14, 34), z * rng.uniform(0.18, 0.5)
        mesh.layer = 3000 + z
        colour = _pick(rng, _WALLS[6:])
        mesh.add(_rectangles(x, 0, x + width, height, z), colour, _TO_CAMERA)
        if rng.random() < 0.5:
            setback = _rectangles(x + width * 0.25, height, x + width * 0.75, height * 1.12, z)
            mesh.add(setback, colour, _TO_CAMERA)
        columns, rows = int(rng.integers(3, 7)), int(rng.integers(6, 14))
        u = np.tile(x + (np.arange(columns) + 0.2) * width / columns, rows)
        v = np.repeat((np.arange(rows) + 0.3) * height / rows, columns)
        panes = _rectangles(u, v, u + 0.6 * width / columns, v + 0.5 * height / rows, z)
        mesh.add(panes, _scaled(_GLASS, 1.6), _TO_CAMERA, _Kind.GLASS)
    if rng.random() < 0.4:
        z = length + rng.uniform(30, 90)
        x = rng.uniform(-0.5, 0.5) * z
        half, height = rng.uniform(2.5, 4), z * rng.uniform(0.28, 0.45)
        mesh.layer = 2000 + z
        mesh.add(_rectangles(x - half, 0, x + half, height, z), _pick(rng, _WALLS[:6]), _TO_CAMERA)
        eaves, tip = half + 0.4, height * rng.uniform(1.2, 1.7)
        spire = _polygons((x - eaves, height, z), (x + eaves, height, z), (x, tip, z))
        mesh.add(spire, _pick(rng, _ROOFS), (0.0, 0.6, -0.8), _Kind.ROOF)
        bell = _rectangles(x - half * 0.3, height * 0.82, x + half * 0.3, height * 0.93, z)
        mesh.add(bell, (0.12, 0.12, 0.13), _TO_CAMERA)


def _far_row(mesh: _Mesh, rng: np.random.Generator, length: float, habit: _Habit) -> list[_Body]:
    """The row that closes the street, each front at its own distance; at times a gap in it."""
    reach = 14 + length * 0.7
    stands: list[tuple[float, float, float]] = []
    x = -reach
    while x < reach:
        width = rng.uniform(8.0, 18.0)
        if rng.random() < 0.86:
            stands.append((length + 11 + rng.choice((0.0, 0.0, 3.0, 7.0)), x, width))
        x += width
    bodies = []
    for z, x, width in sorted(stands, reverse=True):
        mesh.layer = 1000 + z
        front = _Front(mesh, (x, 0.0, z), (1.0, 0.0, 0.0), _TO_CAMERA, sees_start=x > 0)
        height = _building(rng, front, width, habit)
        bodies.append(_Body(x, x + width, z, z + _DEPTH, height))
    return bodies


def _row(
    mesh: _Mesh, rng: np.random.Generator, x: float, length: float, habit: _Habit
) -> list[_Body]:
    """One side of the street, from beside the camera to the crossing, with gaps and setbacks."""
    side = -1.0 if x < 0 else 1.0
    bodies = []
    z = rng.uniform(-9.0, -2.0)
    while z < length - 5:
        width = min(rng.uniform(7.0, 17.0), length - z)
        if z > 4 and rng.random() < 0.12:
            z += width * 0.6
            continue
        face = x + side * rng.choice((0.0, 0.0, 0.0, 0.8, 2.5))
        mesh.layer = z + width
        height = _building(rng, _street_front(mesh, face, z), width, habit)
        x0, x1 = sorted((face, face + side * _DEPTH))
        bodies.append(_Body(x0, x1, z, z + width, height))
        z += width
    return bodies


def _park(mesh: _Mesh, rng: np.random.Generator, x: float, length: float) -> None:
    """Lawn and trees behind a wall, where the street has no houses."""
    side = -1.0 if x < 0 else 1.0
    mesh.layer = _GROUND_LAYER + 5
    mesh.add(_flat(x, -5, x + side * 90, length), (0.40, 0.48, 0.30), _UP, _Kind.GRASS)
    for z in np.arange(rng.uniform(10, 16), length, rng.uniform(5.0, 9.0)):
        _tree(mesh, rng, x + side * rng.uniform(2.0, 16.0), float(z))
    colour, height = _pick(rng, _WALLS), rng.uniform(0.7, 1.6)
    # In pieces: what stands in front of one piece stands behind the next.
    for z in np.arange(-3.0, length, 3.0):
        mesh.layer = float(z)
        front = _street_front(mesh, x, float(z))
        front.add(_rectangles(0, 0, 3, height), colour)
        front.add(_rectangles(0, height, 3, height + 0.12), colour, _Kind.LEDGE)


def _wires(mesh: _Mesh, rng: np.random.Generator, x: float, length: float) -> None:
    """A line of poles with sagging wires."""
    height, gap = rng.uniform(7.0, 9.0), rng.uniform(14.0, 20.0)
    t = np.linspace(0, 1, 7)
    sag = height - 0.6 - 3.2 * t * (1 - t)
    y0, y1 = sag[:-1], sag[1:]
    for z in np.arange(rng.uniform(4.0, 12.0), length, gap):
        mesh.layer = float(z)
        pole = _rectangles(x - 0.13, 0, x + 0.13, height, z)
        bar = _rectangles(x - 0.9, height - 0.8, x + 0.9, height - 0.65, z)
        mesh.add(np.concatenate((pole, bar)), (0.30, 0.25, 0.21), _TO_CAMERA)
        z0, z1 = z + t[:-1] * gap, z + t[1:] * gap
        for end in (x - 0.8, x + 0.8):
            wire = _polygons(
                (end, y0, z0), (end, y1, z1), (end, y1 + 0.04, z1), (end, y0 + 0.04, z0)
            )
            mesh.add(wire, (0.12, 0.12, 0.13), _TO_CAMERA)


def _monument(mesh: _Mesh, rng: np.random.Generator, x: float, z: float) -> None:
    """A column with a ball, or an obelisk, on a plinth in the street."""
    mesh.layer = z
    stone = _pick(rng, _WALLS[2:9])
    _block(mesh, (x - 1.5, 0.0, z), (x + 1.5, 0.9, z + 3.0), stone)
    height, half = rng.uniform(3.0, 9.0), rng.uniform(0.35, 0.9)
    if rng.random() < 0.5:
        _block(
            mesh, (x - half, 0.9, z + 1), (x + half, height, z + 1 + 2 * half), _scaled(stone, 0.9)
        )
        mesh.add(_discs(x, height + 0.7, 0.8, z + 1), (0.35, 0.40, 0.36), (0.0, 0.5, -0.85))
    else:
        obelisk = _polygons(
            (x - half, 0.9, z), (x + half, 0.9, z), (x + 0.15, height, z), (x - 0.15, height, z)
        )
        mesh.add(obelisk, _scaled(stone, 0.9), _TO_CAMERA)


# ------------------------------------------------------------------------------------------------
# What passes.

_PAINT: tuple[Colour, ...] = (
    (0.75, 0.75, 0.76),
    (0.16, 0.17, 0.19),
    (0.55, 0.12, 0.11),
    (0.15, 0.25, 0.45),
    (0.84, 0.83, 0.80),
    (0.40, 0.42, 0.44),
    (0.24, 0.36, 0.28),
)
_TYRE: Colour = (0.05, 0.05, 0.05)
_TINTED: Colour = (0.10, 0.12, 0.14)


def _vehicle(
    mesh: _Mesh, rng: np.random.Generator, x: float, z: float, *, bus: bool, away: bool
) -> None:
    """A car or a bus in its lane, seen from behind where it drives away."""
    paint = _pick(rng, _SIGNS if bus else _PAINT)
    half, length, height = (1.25, 10.5, 3.0) if bus else (0.9, 4.3, 0.95)
    mesh.layer = z + 0.01
    shadow = _flat(x - half - 0.2, z - 0.2, x + half + 0.2, z + length)
    mesh.add(shadow, (0.1, 0.1, 0.1), _UP)
    near = np.array((x - half, x + half - 0.3))
    mesh.add(_rectangles(near, 0, near + 0.3, 0.5, z + 0.1), _TYRE, _TO_CAMERA)
    _block(mesh, (x - half, 0.3, z), (x + half, height, z + length), paint)
    flank = _Front(
        mesh,
        (x + half if x < 0 else x - half, 0.0, z),
        (0.0, 0.0, 1.0),
        (1.0 if x < 0 else -1.0, 0.0, 0.0),
        sees_start=True,
    )
    if bus:
        u = 0.5 + 2.0 * np.arange(5)
        flank.add(_rectangles(u, 1.4, u + 1.7, 2.5), _TINTED, _Kind.SHOP)
        mesh.add(_rectangles(x - 1.05, 1.3, x + 1.05, 2.6, z), _TINTED, _TO_CAMERA, _Kind.SHOP)
    else:
        _block(mesh, (x - 0.74, 0.95, z + 0.7), (x + 0.74, 1.5, z + 3.2), paint)
        mesh.add(_rectangles(x - 0.65, 1.0, x + 0.65, 1.42, z + 0.7), _TINTED, _TO_CAMERA)
        u = np.array((0.5, 3.1))
        flank.add(_rectangles(u, 0, u + 0.6, 0.6), _TYRE)
    lights = _rectangles(near + 0.02, 0.6, near + 0.28, 0.85, z)
    if away:
        mesh.add(lights, (0.55, 0.08, 0.06), _TO_CAMERA, _Kind.TAILLIGHT)
    else:
        mesh.add(lights, (0.90, 0.90, 0.82), _TO_CAMERA, _Kind.HEADLIGHT)


def _person(mesh: _Mesh, rng: np.random.Generator, x: float, z: float) -> None:
    mesh.layer = z
    tall, stride = rng.uniform(0.9, 1.08), rng.uniform(0.05, 0.3)
    hip, foot = np.array((-0.1, 0.1)) + x, np.array((-stride, stride)) + x
    legs = _polygons(
        (hip + 0.08, 0.85 * tall, z),
        (hip - 0.08, 0.85 * tall, z),
        (foot - 0.08, 0.0, z),
        (foot + 0.08, 0.0, z),
    )
    mesh.add(legs, _pick(rng, _PAINT[1:4]), _TO_CAMERA)
    coat = _rectangles(x - 0.26, 0.8 * tall, x + 0.26, 1.48 * tall, z)
    mesh.add(coat, _pick(rng, _SIGNS, 0.3), _TO_CAMERA)
    mesh.add(_discs(x, 1.63 * tall, 0.13, z), (0.62, 0.47, 0.38), _TO_CAMERA)


@functools.lru_cache(maxsize=8)
def _passers(seed: int, lanes: tuple[float, float, float, float]) -> _Scene:
    """Cars along the kerbs, traffic in the lanes, people on the pavements."""
    rng = np.random.default_rng((seed, 1))
    mesh = _Mesh()
    left, left_kerb, right_kerb, right = lanes
    for x, away in ((left_kerb + 1.1, False), (right_kerb - 1.1, True)):
        if rng.random() < 0.6:
            z = rng.uniform(4.0, 12.0)
            while z < 40:
                if rng.random() < 0.55:
                    _vehicle(mesh, rng, x, z, bus=False, away=away)
                z += rng.uniform(5.5, 8.0)
    for _ in range(int(rng.integers(0, 4))):
        bus, away = bool(rng.random() < 0.3), bool(rng.random() < 0.5)
        offset = rng.uniform(1.2, 1.8)
        x = (left_kerb + right_kerb) / 2 + (offset if away else -offset)
        _vehicle(mesh, rng, x, rng.uniform(9.0 if bus else 6.0, 34.0), bus=bus, away=away)
    for _ in range(int(rng.integers(1, 6))):
        low, high = ((left, left_kerb), (right_kerb, right))[int(rng.integers(2))]
        _person(mesh, rng, rng.uniform(low + 0.4, high - 0.4), rng.uniform(4.5, 26.0))
    return mesh.scene()


# ------------------------------------------------------------------------------------------------
# Light and camera.


class _Light(NamedTuple):
    ambient: Colour
    sun: Colour
    elevation: float
    """Degrees of the sun over the horizon."""
    zenith: Colour
    horizon: Colour
    lit: float
    """How much lamps and windows shine, 0 to 1."""


_LIGHTS: dict[Time, _Light] = {
    "noon": _Light(
        ambient=(0.58, 0.62, 0.68),
        sun=(0.66, 0.61, 0.52),
        elevation=48.0,
        zenith=(0.28, 0.48, 0.80),
        horizon=(0.76, 0.85, 0.93),
        lit=0.0,
    ),
    "dusk": _Light(
        ambient=(0.45, 0.40, 0.46),
        sun=(0.52, 0.33, 0.18),
        elevation=11.0,
        zenith=(0.24, 0.27, 0.47),
        horizon=(0.93, 0.64, 0.45),
        lit=0.5,
    ),
    "night": _Light(
        ambient=(0.25, 0.26, 0.36),
        sun=(0.0, 0.0, 0.0),
        elevation=40.0,
        zenith=(0.03, 0.04, 0.10),
        horizon=(0.13, 0.13, 0.20),
        lit=1.0,
    ),
}


class _Air(NamedTuple):
    """What weather does to light."""

    sun: float
    """Share of the sun that comes through."""
    ambient: float
    veil: float
    """How far the sky's colours go to grey, 0 to 1."""
    grey: float
    """Brightness of that grey over that of the clear horizon."""
    visibility: float
    """Metres over which haze takes all but 1/e of the contrast."""


_AIRS: dict[Weather, _Air] = {
    "clear": _Air(sun=1.0, ambient=1.0, veil=0.0, grey=1.0, visibility=900.0),
    "overcast": _Air(sun=0.12, ambient=1.2, veil=0.8, grey=0.95, visibility=500.0),
    "haze": _Air(sun=0.35, ambient=1.15, veil=0.75, grey=0.95, visibility=75.0),
    "rain": _Air(sun=0.05, ambient=1.05, veil=0.9, grey=0.8, visibility=190.0),
}
_SUN_HEIGHT: dict[Season, float] = {"spring": 0.85, "summer": 1.2, "autumn": 0.85, "winter": 0.5}
_LEAVES: dict[Season, tuple[Colour, Colour]] = {
    "spring": ((0.44, 0.56, 0.22), (0.74, 0.60, 0.62)),
    "summer": ((0.20, 0.37, 0.13), (0.30, 0.43, 0.16)),
    "autumn": ((0.70, 0.46, 0.12), (0.60, 0.23, 0.10)),
    "winter": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
}
_SNOW: dict[int, float] = {
    _Kind.ROOF: 0.92,
    _Kind.LEDGE: 0.75,
    _Kind.PAVEMENT: 0.85,
    _Kind.ROAD: 0.5,
    _Kind.GRASS: 0.95,
    _Kind.NEEDLE: 0.4,
}
_GRASS: dict[Season, Colour] = {
    "spring": (0.40, 0.54, 0.24),
    "summer": (0.38, 0.46, 0.22),
    "autumn": (0.50, 0.44, 0.25),
    "winter": (0.40, 0.46, 0.34),
}
_SNOW_COLOUR = np.array((0.90, 0.92, 0.96))
_GLOW: dict[int, tuple[float, Colour]] = {
    _Kind.GLASS: (0.34, (1.0, 0.78, 0.42)),
    _Kind.SHOP: (0.8, (0.92, 0.82, 0.60)),
    _Kind.LAMP: (1.0, (1.0, 0.88, 0.62)),
    _Kind.HEADLIGHT: (1.0, (1.0, 0.97, 0.86)),
    _Kind.TAILLIGHT: (1.0, (0.95, 0.12, 0.08)),
}
"""The share of polygons that shine after dark, and their colour."""

_PITCH = np.deg2rad(8.0)
_TAN_HALF_WIDTH = np.tan(np.deg2rad(80.0) / 2)
_NEAR = 0.4
_SUPERSAMPLING = 2


def _mixed(first: Colour, second: Colour, share: float) -> Colour:
    """The first colour with a share, 0 to 1, of the second."""
    red, green, blue = (a + (b - a) * share for a, b in zip(first, second, strict=True))
    return (red, green, blue)


def _light(view: View) -> _Light:
    """The light of the hour under the weather and the season's sun."""
    light, air = _LIGHTS[view.time], _AIRS[view.weather]
    level = sum(light.horizon) / 3 * air.grey
    grey = (level, level, level)
    return light._replace(
        ambient=_scaled(light.ambient, air.ambient),
        sun=_scaled(light.sun, air.sun),
        elevation=light.elevation * _SUN_HEIGHT[view.season],
        zenith=_mixed(light.zenith, grey, air.veil),
        horizon=_mixed(light.horizon, grey, air.veil),
    )


def _clip_near(polygon: np.ndarray) -> np.ndarray:
    """Cut camera coordinates (k, 3) at the near plane (Sutherland-Hodgman)."""
    kept = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if a[2] >= _NEAR:
            kept.append(a)
        if (a[2] >= _NEAR) != (b[2] >= _NEAR):
            kept.append(a + (b - a) * ((_NEAR - a[2]) / (b[2] - a[2])))
    return np.array(kept).reshape(-1, 3)


class _Camera:
    """A pinhole 2.4 m above the street, 80 degrees wide, tilted up by 8 degrees."""

    def __init__(self, place: _Place, view: View, size: tuple[int, int]) -> None:
        height, width = size
        self.focal = width / 2 / _TAN_HALF_WIDTH
        self.centre = np.array((width / 2, height / 2))
        self.yaw = np.deg2rad(place.heading + view.heading)
        self.position = np.array((view.lateral, _EYE, view.forward))
        sin, cos = np.sin(self.yaw), np.cos(self.yaw)
        turn = np.array(((cos, 0, -sin), (0, 1, 0), (sin, 0, cos)))
        sin, cos = np.sin(_PITCH), np.cos(_PITCH)
        tilt = np.array(((1, 0, 0), (0, cos, -sin), (0, sin, cos)))
        self.rotation = tilt @ turn

    def see(self, points: np.ndarray) -> np.ndarray:
        """World metres (n, 3) to camera metres (n, 3): right, up, ahead."""
        return (points - self.position) @ self.rotation.T

    def project(self, seen: np.ndarray) -> np.ndarray:
        """Camera metres (n, 3) in front of the near plane to pixels (n, 2)."""
        return self.centre + self.focal * seen[:, :2] * (1, -1) / seen[:, 2:]


def _colours(
    scene: _Scene, seen_depth: np.ndarray, view: View, light: _Light, sun: np.ndarray
) -> np.ndarray:
    """The colour (part, 3) in 0..1 of every part: material, season, light and haze."""
    albedo = scene.albedo.copy()
    leaf = scene.kind == _Kind.LEAF
    if leaf.any():
        first, second = (np.array(c) for c in _LEAVES[view.season])
        hue, shade = scene.albedo[leaf, 0:1], scene.albedo[leaf, 1:2]
        albedo[leaf] = (first * (1 - hue) + second * hue) * shade
    albedo[scene.kind == _Kind.GRASS] = _GRASS[view.season]
    if view.season == "winter":
        cover = np.zeros(max(_Kind) + 1)
        cover[list(_SNOW)] = list(_SNOW.values())
        share = cover[scene.kind][:, None]
        albedo = albedo * (1 - share) + _SNOW_COLOUR * share
    if view.weather == "rain":
        albedo[(scene.kind == _Kind.ROAD) | (scene.kind == _Kind.PAVEMENT)] *= 0.72
    facing = np.clip(scene.normal @ sun, 0, None)[:, None]
    skyward = 0.85 + 0.15 * scene.normal[:, 1:2]
    colour = albedo * (np.array(light.ambient) * skyward + np.array(light.sun) * facing)
    glass = scene.kind == _Kind.GLASS
    colour[glass] += 0.16 * np.array(light.zenith)
    haze = 1 - np.exp(-np.clip(seen_depth, 0, 2000) / _AIRS[view.weather].visibility)[:, None]
    return colour * (1 - haze) + np.array(light.horizon) * haze


def _sky(
    place: _Place, view: View, light: _Light, camera: _Camera, size: tuple[int, int]
) -> UInt8[np.ndarray, "h w 3"]:
    """The sky with its clouds, and the hills, which are too far to move with the camera."""
    height, width = size
    rng = np.random.default_rng((view.seed, 2))
    horizon_row = height / 2 + camera.focal * np.tan(_PITCH)
    coarse = (height // 4, width // 4)
    rows = (np.arange(coarse[0]) + 0.5) * height / coarse[0]
    climb = np.clip(1 - rows / horizon_row, 0, 1)[:, None, None] ** 0.8
    sky = np.array(light.horizon) * (1 - climb) + np.array(light.zenith) * climb
    sky = np.repeat(sky, coarse[1], axis=1)
    if view.weather == "clear":
        puffs = rng.random((7, 4)).astype(np.float32)
        puffs = cv2.resize(puffs, coarse[::-1], interpolation=cv2.INTER_CUBIC)
        cover = np.clip((puffs - rng.uniform(0.45, 0.9)) * 2.5, 0, 0.85)[..., None]
        sky += (np.array(light.horizon) * 1.06 - sky) * cover
    canvas = np.clip(sky * 255, 0, 255).astype(np.uint8)
    canvas = cv2.resize(canvas, (width, height), interpolation=cv2.INTER_LINEAR)

    across = np.linspace(-1, 1, 33)
    compass = camera.yaw + np.arctan(across * _TAN_HALF_WIDTH) + np.deg2rad(place.bearing)
    bearings = np.arange(len(place.hills)) * (360 / len(place.hills))
    tangent = np.interp(np.rad2deg(compass) % 360, bearings, place.hills, period=360)
    ridge = np.stack((width / 2 * (1 + across), horizon_row - camera.focal * tangent), -1)
    outline = np.concatenate((ridge, [(width, horizon_row + 2), (0, horizon_row + 2)]))
    hill = np.array(_SNOW_COLOUR * 0.75 if view.season == "winter" else _GRASS[view.season])
    haze = 0.85 if view.weather in ("haze", "rain") else 0.45
    colour = hill * light.ambient * (1 - haze) + np.array(light.horizon) * haze
    cv2.fillPoly(canvas, [np.round(outline).astype(np.int32)], _bytes(colour))
    return canvas


def _bytes(colour: np.ndarray) -> list:
    """Colours (..., 3) of 0..1 as nested lists of 0..255, which OpenCV takes."""
    return np.clip(colour * 255, 0, 255).astype(int).tolist()


def _shade_ground(
    canvas: np.ndarray, place: _Place, camera: _Camera, light: _Light, sun: np.ndarray
) -> None:
    """Darken the ground where buildings stand between it and the sun."""
    strength = float(np.mean(light.sun))
    if strength < 0.05:
        return
    drift = -sun[[0, 2]] / max(sun[1], 0.15)
    mask = np.zeros(canvas.shape[:2], np.uint8)
    for x0, x1, z0, z1, height in place.bodies:
        foot = np.array(((x0, z0), (x1, z0), (x1, z1), (x0, z1)))
        both = np.concatenate((foot, foot + drift * height)).astype(np.float32)
        hull = cv2.convexHull(both)[:, 0]
        seen = camera.see(np.insert(hull.astype(np.float64), 1, 0.0, axis=1))
        if seen[:, 2].min() < _NEAR:
            seen = _clip_near(seen)
        if len(seen) > 2:
            corners = np.clip(np.round(camera.project(seen)), -30000, 30000).astype(np.int32)
            cv2.fillConvexPoly(mask, corners, 255)
    ambient = float(np.mean(light.ambient))
    shaded = cv2.convertScaleAbs(canvas, alpha=ambient / (ambient + strength * max(sun[1], 0.2)))
    cv2.copyTo(shaded, mask, canvas)


def _fixed_point(pixels: np.ndarray) -> np.ndarray:
    """Pixels to quarters of a pixel, as OpenCV's `shift=2` wants them, kept from overflowing."""
    return np.clip(np.round(pixels * 4), -120000, 120000).astype(np.int32)


def _outlines(scene: _Scene, seen: np.ndarray, camera: _Camera) -> list[np.ndarray | None]:
    """For every polygon its corners on the screen in quarters of a pixel; None if out of sight."""
    ends = np.cumsum(scene.polygon_sizes)
    starts = ends - scene.polygon_sizes
    x, y, depth = seen.T
    sideways, upright = camera.centre / camera.focal
    # Out of sight: every corner lies beyond the near plane or one side of the camera's pyramid.
    inside = np.stack(
        (
            depth - _NEAR,
            sideways * depth - x,
            sideways * depth + x,
            upright * depth - y,
            upright * depth + y,
        ),
        -1,
    )
    usable = (np.maximum.reduceat(inside, starts) >= 0).all(1)
    whole = np.minimum.reduceat(depth, starts) >= _NEAR
    corners = _fixed_point(camera.project(np.c_[seen[:, :2], depth.clip(_NEAR)]))
    outlines: list[np.ndarray | None] = [None] * len(starts)
    for i in np.flatnonzero(usable).tolist():
        run = slice(starts[i], ends[i])
        if whole[i]:
            outlines[i] = corners[run]
        else:
            clipped = _clip_near(seen[run])
            outlines[i] = _fixed_point(camera.project(clipped)) if len(clipped) > 2 else None
    return outlines


class _Canvas(NamedTuple):
    """What is painted on, both uint8 (h, w, 3): the picture, and the light that its lamps give."""

    picture: np.ndarray
    glow: np.ndarray


def _paint(
    canvas: _Canvas,
    scene: _Scene,
    parts: Iterable[int],
    outlines: list[np.ndarray | None],
    colours: Float[np.ndarray, "part 3"],
    shines: Bool[np.ndarray, " polygon"],
    lit: float,
) -> None:
    """Fill the parts' polygons in the order of `parts`; those that shine in their lamp's colour."""
    ends = np.cumsum(scene.part_sizes)
    starts = (ends - scene.part_sizes).tolist()
    ends = ends.tolist()
    paints = _bytes(colours)
    for part in parts:
        dark: list[np.ndarray] = []
        bright: list[np.ndarray] = []
        for i in range(starts[part], ends[part]):
            outline = outlines[i]
            if outline is not None:
                (bright if shines[i] else dark).append(outline)
        if dark:
            cv2.fillPoly(canvas.picture, dark, paints[part], cv2.LINE_8, 2)
            if lit:
                cv2.fillPoly(canvas.glow, dark, (0, 0, 0), cv2.LINE_8, 2)
        if bright:
            lamp = np.array(_GLOW[int(scene.kind[part])][1])
            cv2.fillPoly(canvas.picture, bright, _bytes(lamp * (0.5 + 0.4 * lit)), cv2.LINE_8, 2)
            cv2.fillPoly(canvas.glow, bright, _bytes(lamp), cv2.LINE_8, 2)


def _shining(scene: _Scene, draw: Float[np.ndarray, " polygon"], lit: float) -> np.ndarray:
    """Which polygons shine: of a window's kind a share, drawn; of lamps all; by day none."""
    share = np.zeros(max(_Kind) + 1)
    if lit:
        for kind, (part_share, _) in _GLOW.items():
            share[kind] = part_share * (0.35 + 0.65 * lit)
    return draw < np.repeat(share[scene.kind], scene.part_sizes)


def render(
    place_seed: int, view: View, image_size: tuple[int, int] = (126, 168)
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw one picture of a place, RGB. The same arguments give the same pixels.

    Args:
        place_seed: which place; at least 0.
        view: where the camera stands, and the season, light, weather and traffic it meets.
        image_size: height and width in pixels.

    Raises:
        InputError: a negative seed, or a size out of range.
    """
    _check_size("image_size", image_size)
    if place_seed < 0:
        raise InputError(f"place_seed: found {place_seed}, expected at least 0")
    place = _place(place_seed)
    size = (image_size[0] * _SUPERSAMPLING, image_size[1] * _SUPERSAMPLING)
    camera = _Camera(place, view, size)
    light = _light(view)
    rng = np.random.default_rng((view.seed, 3))
    sun = _sun(light, view.time, place.bearing, rng)
    scene = place.scene
    draw = rng.random(len(scene.polygon_sizes))
    if view.occluders is not None:
        passers = _passers(view.occluders, place.lanes)
        scene = _join(scene, passers)
        # Drawn low, so that every vehicle has its lights on.
        draw = np.concatenate((draw, np.zeros(len(passers.polygon_sizes))))

    seen = camera.see(scene.points)
    outlines = _outlines(scene, seen, camera)
    point_starts = np.concatenate(([0], np.cumsum(scene.polygon_sizes)))
    part_starts = point_starts[np.concatenate(([0], np.cumsum(scene.part_sizes)))]
    depth = np.add.reduceat(seen[:, 2], part_starts[:-1]) / np.diff(part_starts)
    colours = _colours(scene, depth, view, light, sun)
    shines = _shining(scene, draw, light.lit)

    order = np.argsort(-scene.layer, kind="stable")
    if view.season == "winter":
        order = order[scene.kind[order] != _Kind.LEAF]
    grounds = int((scene.layer[order] >= _GROUND_LAYER).sum())
    canvas = _Canvas(_sky(place, view, light, camera, size), np.zeros((*size, 3), np.uint8))
    _paint(canvas, scene, order[:grounds].tolist(), outlines, colours, shines, light.lit)
    _shade_ground(canvas.picture, place, camera, light, sun)
    _paint(canvas, scene, order[grounds:].tolist(), outlines, colours, shines, light.lit)
    return _develop(canvas, place, view, light, camera, rng)


def _sun(light: _Light, time: Time, bearing: float, rng: np.random.Generator) -> np.ndarray:
    """The direction (3,) to the sun: about south at noon and west at dusk, seen from the street."""
    compass = {"noon": 180.0, "dusk": 270.0, "night": 180.0}[time] + rng.uniform(-50, 50)
    azimuth, elevation = np.deg2rad(compass - bearing), np.deg2rad(light.elevation)
    level = np.cos(elevation)
    return np.array((np.sin(azimuth) * level, np.sin(elevation), np.cos(azimuth) * level))


def _develop(
    canvas: _Canvas,
    place: _Place,
    view: View,
    light: _Light,
    camera: _Camera,
    rng: np.random.Generator,
) -> UInt8[np.ndarray, "h w 3"]:
    """From the canvas to the camera's picture: lamplight, rain, white balance, exposure, noise."""
    height, width = (side // _SUPERSAMPLING for side in canvas.picture.shape[:2])
    picture = cv2.resize(canvas.picture, (width, height), interpolation=cv2.INTER_AREA)
    picture = picture.astype(np.float32)
    if light.lit:
        picture = _lamplight(picture, canvas.glow, place, light, camera)
    if view.weather == "rain":
        picture = _rain(picture, rng)
    warmth, tint = rng.uniform(-0.13, 0.13), rng.uniform(-0.04, 0.04)
    picture *= (2.0 ** (view.exposure + np.array((warmth, tint, -warmth)))).astype(np.float32)
    if view.noise:
        picture += np.float32(view.noise) * rng.standard_normal(picture.shape, np.float32)
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)


def _lamplight(
    picture: np.ndarray, glow: np.ndarray, place: _Place, light: _Light, camera: _Camera
) -> np.ndarray:
    """Pools of light around street lamps, and a halo around everything that shines."""
    height, width = picture.shape[:2]
    small = (max(1, width // 4), max(1, height // 4))
    scale = small[0] / (2 * camera.centre[0])
    pools = np.zeros((small[1], small[0]), np.float32)
    seen = camera.see(place.lamps)
    seen = seen[seen[:, 2] > 1.0]
    for (x, y), distance in zip(camera.project(seen) * scale, seen[:, 2], strict=True):
        radius = min(scale * camera.focal * 6.0 / distance, 2.0 * small[0])
        centre = np.clip(np.round((x, y + radius * 0.6)), -999, 999).astype(int).tolist()
        disc = np.zeros_like(pools)
        cv2.circle(disc, centre, max(1, int(radius)), 1.0, -1)
        pools = np.maximum(pools, disc)
    pools = cv2.GaussianBlur(pools, (0, 0), small[0] / 20)
    pools = cv2.resize(pools, (width, height), interpolation=cv2.INTER_LINEAR)[..., None]
    picture = picture * (1 + light.lit**2 * pools * np.array((2.2, 1.7, 0.9), np.float32))
    halo = cv2.resize(glow, small, interpolation=cv2.INTER_AREA).astype(np.float32)
    halo = cv2.GaussianBlur(halo, (0, 0), small[0] / 28)
    return picture + 0.4 * light.lit * cv2.resize(halo, (width, height))


def _rain(picture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    height, width = picture.shape[:2]
    streaks = np.zeros((height, width), np.float32)
    for x, y, length in rng.uniform((0, -8, 4), (width, height, 11), (height * width // 240, 3)):
        end = (int(x - length * 0.18), int(y + length))
        cv2.line(streaks, (int(x), int(y)), end, 1.0, 1)
    return picture + cv2.GaussianBlur(streaks, (3, 3), 0)[..., None] * (0.08 * picture.mean() + 6)


# ------------------------------------------------------------------------------------------------
# The city on disk.

_MONTHS: dict[Season, int] = {"spring": 4, "summer": 7, "autumn": 10, "winter": 1}
_METRES_PER_DEGREE = 111_195.0
"""Of latitude, on a sphere of 6371 km."""
_UTM_ORIGIN = (500_000.0, 5_000_000.0)
"""East and north in zone 32T of the test city's south-west corner."""


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
    """Views that take turns through the seasons and the hours, in an order of the place's own."""
    seasons, times = rng.permutation(4), rng.permutation(4)
    hours: tuple[Time, ...] = ("noon", "dusk", "night", "noon")
    return [_draw_view(rng, SEASONS[seasons[i % 4]], hours[times[i % 4]]) for i in range(count)]


def _database_view(rng: np.random.Generator) -> View:
    return _draw_view(rng, SEASONS[rng.integers(2)], "noon")


def _query_view(rng: np.random.Generator) -> View:
    return _draw_view(rng, SEASONS[2 + rng.integers(2)], TIMES[1 + rng.integers(2)])


def _place_seed(config: SyntheticCityConfig, split: int, index: int) -> int:
    """The seed of a place: another for every place of either split."""
    return int(np.random.SeedSequence((config.seed, split, index)).generate_state(1, np.uint64)[0])


class _Spot(NamedTuple):
    """One place in its city: what to render, where it lies, and the chance of its views."""

    seed: int
    east: float
    north: float
    bearing: float
    rng: np.random.Generator

    def stand(self, view: View) -> tuple[float, float]:
        """Metres east and north at which the camera of this view stands."""
        angle = np.deg2rad(self.bearing)
        sin, cos = np.sin(angle), np.cos(angle)
        east = self.east + view.lateral * cos + view.forward * sin
        return float(east), float(self.north - view.lateral * sin + view.forward * cos)

    def northdeg(self, view: View) -> int:
        """Degrees clockwise from north in which this view looks."""
        return round(self.bearing + _place(self.seed).heading + view.heading) % 360


def _spot(config: SyntheticCityConfig, split: int, index: int, count: int) -> _Spot:
    """Place `index` of `count`, which stand on a square grid, each a little off its point."""
    seed = _place_seed(config, split, index)
    rng = np.random.default_rng((seed, 4))
    row, column = divmod(index, math.isqrt(count - 1) + 1)
    east, north = np.array((column, row)) * PLACE_SPACING + rng.uniform(-3, 3, 2)
    return _Spot(seed, float(east), float(north), _place(seed).bearing, rng)


def _write_jpeg(path: pathlib.Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    _, data = cv2.imencode(".jpg", image[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, 92))
    path.write_bytes(data.tobytes())


def _panoid(rng: np.random.Generator) -> str:
    return rng.bytes(8).hex()


def _write_train(
    folder: pathlib.Path, config: SyntheticCityConfig, city: int, done: Callable[[], None]
) -> None:
    """One city in the GSV-Cities layout; its degrees are those of a sphere, out on an ocean."""
    name, centre = CITY_NAMES[city], (10.0 + city, -40.0)
    images = folder / "Images" / name
    images.mkdir(parents=True)
    lines = ["place_id,year,month,northdeg,city_id,lat,lon,panoid"]
    indices = range(city, config.train_places, len(CITY_NAMES))
    for place_id, index in enumerate(indices, start=1):
        spot = _spot(config, 0, index, config.train_places)
        for view in _train_views(spot.rng, config.images_per_place):
            east, north = spot.stand(view)
            lat = f"{centre[0] + north / _METRES_PER_DEGREE:.7f}"
            per_degree = _METRES_PER_DEGREE * np.cos(np.deg2rad(centre[0]))
            lon = f"{centre[1] + east / per_degree:.7f}"
            year, month = int(spot.rng.integers(2012, 2022)), _MONTHS[view.season]
            northdeg, panoid = spot.northdeg(view), _panoid(spot.rng)
            lines.append(f"{place_id},{year},{month},{northdeg},{name},{lat},{lon},{panoid}")
            stem = (
                f"{name}_{place_id:07d}_{year:04d}_{month:02d}_{northdeg:03d}_{lat}_{lon}_{panoid}"
            )
            _write_jpeg(images / f"{stem}.jpg", render(spot.seed, view, config.image_size))
            done()
    table = folder / "Dataframes" / f"{name}.csv"
    table.parent.mkdir(exist_ok=True)
    table.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_test(
    folder: pathlib.Path, config: SyntheticCityConfig, done: Callable[[], None]
) -> None:
    """Database by day in spring and summer, queries by dusk and night in autumn and winter."""
    for side in ("database", "queries"):
        (folder / side).mkdir(parents=True)
    for index in range(config.test_places):
        spot = _spot(config, 1, index, config.test_places)
        views = [("database", _database_view(spot.rng)) for _ in range(config.database_per_place)]
        views += [("queries", _query_view(spot.rng)) for _ in range(config.queries_per_place)]
        for side, view in views:
            east, north = spot.stand(view)
            year, month = int(spot.rng.integers(2012, 2022)), _MONTHS[view.season]
            fields = (
                f"{_UTM_ORIGIN[0] + east:.2f}",
                f"{_UTM_ORIGIN[1] + north:.2f}",
                "32",
                "T",
                "",
                "",
                _panoid(spot.rng),
                "",
                f"{spot.northdeg(view)}",
                f"{np.rad2deg(_PITCH):.0f}",
                "0",
                f"{_EYE}",
                f"{year:04d}{month:02d}",
                f"{view.season}_{view.time}",
            )
            path = folder / side / f"@{'@'.join(fields)}@.jpg"
            _write_jpeg(path, render(spot.seed, view, config.image_size))
            done()


def write_synthetic_city(
    root: str | os.PathLike[str],
    config: SyntheticCityConfig,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Render the city into `root`: all of it or, where anything fails, nothing.

    `root/train` has the GSV-Cities layout with two cities, `root/test` that of
    VPR-datasets-downloader (`images/test/{database,queries}`): places 80 m apart, the images of one
    within 10 m of each other, so 25 m tell positives. No place is in both. `root/city.json` keeps
    the configuration; a root that already holds the city of the same one is left as it is.

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
    if root.exists() and _holds(root, identity):
        return
    total = config.train_places * config.images_per_place
    total += config.test_places * (config.database_per_place + config.queries_per_place)
    count = itertools.count(1)

    def done() -> None:
        number = next(count)
        if progress is not None:
            progress(number, total)

    temporary = root.with_name(f".{root.name}.{uuid.uuid4().hex[:8]}")
    try:
        temporary.mkdir(parents=True)
        for city in range(len(CITY_NAMES)):
            _write_train(temporary / "train", config, city, done)
        _write_test(temporary / "test" / "images" / "test", config, done)
        write_json(temporary / "city.json", identity)
        os.replace(temporary, root)
    except OSError as error:
        raise InputError(f"{root}: cannot write the city here: {error.strerror}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _holds(root: pathlib.Path, identity: dict) -> bool:
    """Whether `root` holds the city of this identity already; False if it is an empty folder.

    Raises:
        InputError: it is no folder, or holds anything else.
    """
    if not root.is_dir():
        raise InputError(f"{root}: found a file, expected a folder or a new name")
    if not any(root.iterdir()):
        return False
    try:
        found = json.loads((root / "city.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        found = None
    if found == identity:
        return True
    what = "a synthetic city of another configuration" if found else "a folder with other content"
    raise InputError(f"{root}: found {what}, expected a new or empty folder")
