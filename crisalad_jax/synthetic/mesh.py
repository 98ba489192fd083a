"""The geometry of a place in metres: x to the right across the street, y up, z along the street.

The camera of the default view stands at x = z = 0. A scene is a list of parts, painted from far to
near.
"""

import copy
import enum
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from crisalad_jax.synthetic.view import EYE

Colour = np.ndarray
"""Red, green and blue, 0 to 1."""
Vector = tuple[float, float, float]
Paint = Colour | Vector
"""A part's colour; for LEAF and BUSH its share of the season's second hue, its shade, and 0."""
Number = int | float | np.ndarray
Polygons = Float[np.ndarray, "polygon corner 3"]
Rect = tuple[Number, Number, Number, Number]
"""The left, bottom, right and top edges of rectangles, in metres."""
Rng = np.random.Generator
Lanes = tuple[float, float, float, float]
"""x of the left fronts, the left kerb, the right kerb and the right fronts of a street."""
Body = tuple[float, float, float, float, float]
"""A building's x0, x1, z0, z1 and height in metres, for its shadow."""

GROUND_LAYER = 1e6
"""Smallest layer of parts on the ground, which are painted before every shadow."""
UP: Vector = (0.0, 1.0, 0.0)
DOWN: Vector = (0.0, -1.0, 0.0)
TO_CAMERA: Vector = (0.0, 0.0, -1.0)
SLANTED: Vector = (0.0, 0.5, -0.85)
"""Normal of parts that are round or slope towards the camera."""


class Kind(enum.IntEnum):
    """Material of a part, which decides how season and light change it.

    SOIL is a field or ballast, in the part's colour, with snow in winter. BUSH is leaves that
    become bare twigs in winter. WINDOW is an opening to the sky, seen from inside.
    """

    SOLID, ROOF, LEDGE, PAVEMENT, ROAD, GRASS, LEAF, NEEDLE = range(8)
    GLASS, SHOP, LAMP, HEADLIGHT, TAILLIGHT, SOIL, BUSH, WINDOW = range(8, 16)


def palette(percents: str) -> tuple[Colour, ...]:
    """Read colours from text: red, green and blue in percent, a comma between colours."""
    return tuple(np.array(colour.split(), float) / 100 for colour in percents.split(","))


WALLS = palette(
    "55 29 23, 76 60 36, 84 78 64, 56 56 57, 70 60 48, 74 54 49, 58 66 72, 57 63 50, 86 85 82,"
    "40 27 24, 66 64 61, 42 45 49, 70 42 30"
)
ROOFS = palette("52 27 20, 33 33 36, 42 34 29, 30 42 38")
SIGNS = palette("70 16 14, 13 28 52, 12 40 24, 85 66 14, 20 18 20, 82 80 76")
GLASS = np.array((0.16, 0.20, 0.25))


def draw_kind(rng: Rng, **shares: float) -> str:
    """Draw one of the names with these probabilities, which sum to 1."""
    return str(rng.choice(tuple(shares), p=tuple(shares.values())))


def pick(rng: Rng, colours: tuple[Colour, ...], spread: float = 0.06) -> Colour:
    """Draw one of the colours, made lighter or darker by a fraction of up to `spread`."""
    return colours[rng.integers(len(colours))] * (1 + rng.uniform(-spread, spread))


def polygons(*corners: tuple[Number, Number, Number]) -> Polygons:
    """Make one polygon for each element of the corners' coordinates, broadcast to one shape."""
    numbers = [number for corner in corners for number in corner]
    table = np.empty((*np.broadcast(*numbers).shape, len(numbers)))
    for column, number in enumerate(numbers):
        table[..., column] = number
    return table.reshape(-1, len(corners), 3)


def rects(
    x0: Number, y0: Number, x1: Number, y1: Number, z: Number = 0.0, top_z: Number | None = None
) -> Polygons:
    """Make rectangles between two edges along x, upright unless `top_z` differs from `z`."""
    top_z = z if top_z is None else top_z
    return polygons((x0, y0, z), (x1, y0, z), (x1, y1, top_z), (x0, y1, top_z))


def bars(
    x: Number, half: Number, y0: Number, y1: Number, z: Number = 0.0, top: Number | None = None
) -> Polygons:
    """Make upright bars that extend `half` metres to either side of x, or `top` at the top."""
    top = half if top is None else top
    return polygons((x - half, y0, z), (x + half, y0, z), (x + top, y1, z), (x - top, y1, z))


def triangles(x0: Number, x1: Number, y: Number, tip_x: Number, tip_y: Number) -> Polygons:
    """Make upright triangles over level edges, at z = 0."""
    return polygons((x0, y, 0), (x1, y, 0), (tip_x, tip_y, 0))


def flat(x0: Number, z0: Number, x1: Number, z1: Number, y: float = 0.0) -> Polygons:
    """Make level rectangles, on the ground unless a height `y` is given."""
    return rects(x0, y, x1, y, z0, z1)


def sheets(
    x0: Number, z0: Number, x1: Number, z1: Number, low: Number, high: Number, lean: Number = 0.0
) -> Polygons:
    """Make upright sheets over lines on the ground; their tops are moved along x by `lean`."""
    return polygons((x0, low, z0), (x1, low, z1), (x1 + lean, high, z1), (x0 + lean, high, z0))


def discs(x: Number, y: Number, radius: Number, z: float = 0.0) -> Polygons:
    """Make discs that face the camera, as polygons of ten corners."""
    angles = np.arange(10) * (2 * np.pi / 10)
    return polygons(*((x + radius * np.cos(a), y + radius * np.sin(a), z) for a in angles))


class Scene(NamedTuple):
    """Parts as arrays: polygons are runs of points (in metres), parts are runs of polygons."""

    points: Float[np.ndarray, "point 3"]
    polygon_sizes: Int[np.ndarray, " polygon"]
    part_sizes: Int[np.ndarray, " part"]
    albedo: Float[np.ndarray, "part 3"]
    normal: Float[np.ndarray, "part 3"]
    kind: Int[np.ndarray, " part"]
    layer: Float[np.ndarray, " part"]
    """Painting order: larger is farther away."""


class Mesh:
    """A scene under construction; a part is a set of polygons of one colour, normal and layer."""

    def __init__(self, eye: float = EYE) -> None:
        """Start without parts; cameras are about `eye` metres above the ground."""
        self.eye = eye
        self.layer = 0.0
        """Painting order of subsequent parts: larger is farther away, and painted first."""
        self.normal: Vector = TO_CAMERA
        """Direction that subsequent parts face by default."""
        self.sees_start = False
        """Whether the camera sees the ends of a front at small u, rather than those at large u."""
        self.end_normal: Vector = UP
        self._origin, self._axes = np.zeros(3), np.eye(3)
        self.bodies: list[Body] = []
        """The buildings, which cast shadows."""
        self.lamps: list[Vector] = []
        """Positions of the street lamps' lights."""
        self._parts: list[tuple[np.ndarray, Paint, Vector, int, float]] = []

    def at(self, x: float, z: float, layer: float | None = None) -> "Mesh":
        """Return a mesh with origin (x, z) that adds to this one, in `layer`; None is layer z."""
        here = copy.copy(self)
        here._origin = self.world(np.array((x, 0.0, z)))
        here.layer = float(z if layer is None else layer)
        return here

    def front(self, x: float, z: float, side: float, layer: float | None = None) -> "Mesh":
        """Return a mesh that adds to this one, in axes (u, v, d) of a plane such as a house front.

        u runs along the plane, v up, d out of it. The origin is (x, z). The plane is along the left
        or right side of the street if `side` is -1 or 1, and across the street if `side` is 0.
        """
        front = self.at(x, z, self.layer if layer is None else layer)
        along = np.array((0.0, 0.0, 1.0) if side else (1.0, 0.0, 0.0))
        front.normal = (-side, 0.0, 0.0) if side else TO_CAMERA
        front.sees_start = side != 0 or front._origin[0] > 0
        front.end_normal = tuple(-along if front.sees_start else along)
        front._axes = np.array((along, UP, front.normal))
        return front

    def world(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Convert points from this mesh's axes to the place's."""
        return points @ self._axes + self._origin

    def add(
        self,
        polygons: Polygons,
        albedo: Paint,
        kind: Kind = Kind.SOLID,
        normal: Vector | None = None,
        layer: float | None = None,
    ) -> None:
        """Add a part, unless it has no polygons; None takes this mesh's normal or layer."""
        if len(polygons):
            layer = self.layer if layer is None else layer
            part = self.world(polygons), albedo, normal or self.normal, int(kind), layer
            self._parts.append(part)

    def ground(self, polygons: Polygons, albedo: Paint, kind: Kind = Kind.SOLID) -> None:
        """Add a part of the ground, painted over earlier ones."""
        self.add(polygons, albedo, kind, UP, GROUND_LAYER + 1)

    def block(self, low: Vector, high: Vector, albedo: Paint) -> None:
        """Add an upright box: its top, its front, and its side towards the middle of the street."""
        (x0, y0, z0), (x1, y1, z1) = low, high
        is_left = self._origin[0] + (x0 + x1) / 2 < 0
        x, outwards = (x1, 1.0) if is_left else (x0, -1.0)
        self.add(flat(x0, z0, x1, z1, y1), albedo, Kind.ROOF, UP)
        self.add(sheets(x, z0, x, z1, y0, y1), albedo, normal=(outwards, 0.0, 0.0))
        self.add(rects(x0, y0, x1, y1, z0), albedo)

    def boxes(self, rect: Rect, out: float, albedo: Paint, kind: Kind = Kind.SOLID) -> None:
        """Add boxes that protrude from a front: the visible end, the top or underside, the face."""
        u0, v0, u1, v1 = rect
        end = u0 if self.sees_start else u1
        self.add(sheets(end, 0.0, end, out, v0, v1), albedo, normal=self.end_normal)
        above = float(np.min(v0)) > self.eye
        v = v0 if above else v1
        self.add(rects(u0, v, u1, v, 0.0, out), albedo, normal=DOWN if above else UP)
        self.add(rects(u0, v0, u1, v1, out), albedo, kind)

    def scene(self) -> Scene:
        """Return the scene of all parts; there must be at least one."""
        parts, *materials = zip(*self._parts, strict=True)
        points = np.concatenate([part.reshape(-1, 3) for part in parts])
        counts = np.array([len(part) for part in parts])
        corners = np.repeat([part.shape[1] for part in parts], counts)
        return Scene(points, corners, counts, *map(np.array, materials))


class Reach(NamedTuple):
    """Range of camera positions in a place."""

    height: tuple[float, float]
    """Minimum and maximum metres above the ground."""
    lateral: float
    """Maximum metres to either side."""
    forward: float
    """Maximum metres from a station along the place, in either direction."""
    step: float
    """Metres from one station to the next; stations are separate places that look similar."""


class Place(NamedTuple):
    """The scene of one place, the orientation of its street, and what else a picture needs."""

    scene: Scene
    heading: float
    """Direction of the default view in degrees clockwise from the street."""
    lanes: Lanes
    reach: Reach
    bearing: float = 0.0
    """Direction of the street in degrees clockwise from north."""
    hills: Float[np.ndarray, " bearing"] = np.zeros(96)
    """Tangent of the hills' elevation over the horizon, at equal steps clockwise from north."""
    bodies: Sequence[Body] = ()
    lamps: Float[np.ndarray, "lamp 3"] = np.zeros((0, 3))
    indoors: bool = False
    traffic: bool = True
    """Whether there may be vehicles; there may be people everywhere."""


def draw_hills(rng: np.random.Generator, most: float) -> Float[np.ndarray, " bearing"]:
    """Draw the hills of a place, as tangents of their elevation, at most `most`."""
    ridge = rng.uniform(0.0, 1.0, 24) ** 2 * rng.uniform(0.02, most)
    return np.interp(np.arange(96), np.arange(24) * 4.0, ridge, period=96)
