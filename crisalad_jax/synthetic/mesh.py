"""The geometry of a scene, in metres: x to the right across the street, y up, z along it.

The camera of the default view stands at x = z = 0. A scene is a list of parts, painted from the far
ones to the near.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from crisalad_jax.synthetic.materials import Colour, Kind, scaled
from crisalad_jax.synthetic.view import EYE

GROUND_LAYER = 1e6
"""Smallest layer of parts on the ground, which are painted below every shadow."""
UP = (0.0, 1.0, 0.0)
TO_CAMERA = (0.0, 0.0, -1.0)

Vector = tuple[float, float, float]
Number = int | float | np.ndarray


class Scene(NamedTuple):
    """Parts as arrays: points in metres, polygons as runs of points, parts as runs of polygons."""

    points: Float[np.ndarray, "point 3"]
    polygon_sizes: Int[np.ndarray, " polygon"]
    part_sizes: Int[np.ndarray, " part"]
    albedo: Float[np.ndarray, "part 3"]
    normal: Float[np.ndarray, "part 3"]
    kind: Int[np.ndarray, " part"]
    layer: Float[np.ndarray, " part"]
    """Painting order: larger is farther away."""


def join_scenes(first: Scene, second: Scene) -> Scene:
    """Join the parts of the first scene and those of the second."""
    return Scene(*(np.concatenate(pair) for pair in zip(first, second, strict=True)))


class Mesh:
    """A scene being built of parts: polygons of one colour, one normal and one layer."""

    def __init__(self, eye: float = EYE) -> None:
        """Start without parts; cameras are some `eye` metres above the ground."""
        self.eye = eye
        self.layer = 0.0
        """Painting order of the parts to come: larger is farther away."""
        self._points: list[np.ndarray] = []
        self._polygon_sizes: list[np.ndarray] = []
        self._parts: list[tuple[int, Colour, Vector, int, float]] = []

    def add(
        self,
        polygons: Float[np.ndarray, "polygon corner 3"],
        albedo: Colour,
        normal: Vector,
        kind: Kind = Kind.SOLID,
    ) -> None:
        """Add a part in the present layer; without polygons it is left out."""
        count, corners, _ = polygons.shape
        if count:
            self._points.append(polygons.reshape(-1, 3))
            self._polygon_sizes.append(np.full(count, corners))
            self._parts.append((count, albedo, normal, int(kind), self.layer))

    def scene(self) -> Scene:
        """Make a scene of all parts, of which there has to be at least one."""
        counts, albedo, normal, kind, layer = zip(*self._parts, strict=True)
        return Scene(
            np.concatenate(self._points),
            np.concatenate(self._polygon_sizes),
            np.array(counts),
            np.array(albedo, np.float64),
            np.array(normal, np.float64),
            np.array(kind),
            np.array(layer, np.float64),
        )


def polygons(*corners: tuple[Number, Number, Number]) -> Float[np.ndarray, "n corner 3"]:
    """Make as many polygons as a coordinate's array has numbers; single numbers are repeated."""
    numbers = [number for corner in corners for number in corner]
    count = next((len(n) for n in numbers if isinstance(n, np.ndarray)), 1)
    table = np.empty((count, len(numbers)))
    for column, number in enumerate(numbers):
        table[:, column] = number
    return table.reshape(count, len(corners), 3)


def rectangles(
    x0: Number, y0: Number, x1: Number, y1: Number, z: Number = 0.0
) -> Float[np.ndarray, "n 4 3"]:
    """Make upright rectangles that face along the third axis."""
    return polygons((x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z))


def flat(x0: Number, z0: Number, x1: Number, z1: Number) -> Float[np.ndarray, "n 4 3"]:
    """Make rectangles on the ground."""
    return polygons((x0, 0.0, z0), (x1, 0.0, z0), (x1, 0.0, z1), (x0, 0.0, z1))


def discs(x: Number, y: Number, radius: Number, z: float) -> Float[np.ndarray, "n 10 3"]:
    """Make round polygons that face the camera."""
    angles = np.arange(10) * (2 * np.pi / 10)
    return polygons(*((x + radius * np.cos(a), y + radius * np.sin(a), z) for a in angles))


class Front:
    """A vertical plane for parts: u runs along it, v up, d out of it towards the street."""

    def __init__(
        self, mesh: Mesh, origin: Vector, along: Vector, normal: Vector, *, sees_start: bool
    ) -> None:
        """Place the plane in the world: `origin` in metres, unit `along` and `normal`."""
        self.mesh = mesh
        self.normal = normal
        self.sees_start = sees_start
        """Whether the camera sees the ends towards small u, or those towards large u."""
        self.end_normal = scaled(along, -1.0 if sees_start else 1.0)
        self._origin = np.array(origin)
        self._axes = np.array((along, UP, normal))

    def add(
        self,
        uvd: Float[np.ndarray, "n corner 3"],
        albedo: Colour,
        kind: Kind = Kind.SOLID,
        normal: Vector | None = None,
    ) -> None:
        """Add polygons in the plane's own metres; they face out of it unless `normal` differs."""
        self.mesh.add(uvd @ self._axes + self._origin, albedo, normal or self.normal, kind)

    def boxes(
        self,
        rects: tuple[Number, Number, Number, Number],
        out: float,
        albedo: Colour,
        kind: Kind = Kind.SOLID,
    ) -> None:
        """Add protruding boxes u0, v0, u1, v1: the visible end, the top or underside, the front."""
        u0, v0, u1, v1 = rects
        u = u0 if self.sees_start else u1
        end = polygons((u, v0, 0.0), (u, v0, out), (u, v1, out), (u, v1, 0.0))
        self.add(end, albedo, normal=self.end_normal)
        above = float(np.min(v0)) > self.mesh.eye
        v = v0 if above else v1
        level = polygons((u0, v, 0.0), (u1, v, 0.0), (u1, v, out), (u0, v, out))
        self.add(level, albedo, normal=(0.0, -1.0, 0.0) if above else UP)
        self.add(rectangles(u0, v0, u1, v1, out), albedo, kind)


def street_front(mesh: Mesh, x: float, z: float) -> Front:
    """Make a plane along the street that faces its middle."""
    normal = (1.0 if x < 0 else -1.0, 0.0, 0.0)
    return Front(mesh, (x, 0.0, z), (0.0, 0.0, 1.0), normal, sees_start=True)


def block(mesh: Mesh, low: Vector, high: Vector, albedo: Colour) -> None:
    """Add an upright box: its top, its side towards the middle of the street, its near face."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    left = x0 + x1 < 0
    x = x1 if left else x0
    top = polygons((x0, y1, z0), (x1, y1, z0), (x1, y1, z1), (x0, y1, z1))
    side = polygons((x, y0, z0), (x, y0, z1), (x, y1, z1), (x, y1, z0))
    mesh.add(top, albedo, UP, Kind.ROOF)
    mesh.add(side, albedo, (1.0 if left else -1.0, 0.0, 0.0))
    mesh.add(rectangles(x0, y0, x1, y1, z0), albedo, TO_CAMERA)
