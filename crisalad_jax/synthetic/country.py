"""One place in the country: a road, railway or path through fields, woods and hills."""

import numpy as np

from crisalad_jax.synthetic.buildings import DEPTH, Habit, building
from crisalad_jax.synthetic.materials import (
    SIGNS,
    WALLS,
    Colour,
    Kind,
    pick,
    scaled,
)
from crisalad_jax.synthetic.mesh import (
    GROUND_LAYER,
    TO_CAMERA,
    UP,
    Front,
    Mesh,
    block,
    flat,
    polygons,
    rectangles,
)
from crisalad_jax.synthetic.place import Body, Place, Reach
from crisalad_jax.synthetic.things import tree, wires

_FIELDS: tuple[Colour, ...] = (
    (0.55, 0.50, 0.28),
    (0.42, 0.34, 0.24),
    (0.36, 0.46, 0.22),
    (0.62, 0.56, 0.36),
    (0.30, 0.36, 0.20),
    (0.66, 0.62, 0.24),
)
_STONES: tuple[Colour, ...] = ((0.5, 0.49, 0.46), (0.42, 0.40, 0.37), (0.6, 0.57, 0.5))
_FAR = 140.0
"""Metres to which what lies along the way is drawn."""


class _Way:
    """The course of the way: x of its middle, a parabola through the camera's foot."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._bend = rng.normal(0.0, 0.0022)
        self._drift = rng.normal(0.0, 0.05)

    def at(self, z: np.ndarray | float) -> np.ndarray | float:
        return self._drift * z + self._bend * np.square(z)

    def strip(self, low: float, high: float, start: float = -4.0) -> np.ndarray:
        """Make a band between two distances from the middle, as quadrilaterals on the ground."""
        z = np.concatenate((np.arange(start, 40, 3.0), np.arange(40, _FAR + 1, 12.5)))
        x0, x1 = self.at(z[:-1]), self.at(z[1:])
        return polygons(
            (x0 + low, 0.0, z[:-1]),
            (x0 + high, 0.0, z[:-1]),
            (x1 + high, 0.0, z[1:]),
            (x1 + low, 0.0, z[1:]),
        )


def country(rng: np.random.Generator) -> Place:
    """Build a place in the country."""
    mesh = Mesh()
    way = _Way(rng)
    kind = str(rng.choice(("road", "railway", "path", "meadow"), p=(0.4, 0.3, 0.2, 0.1)))
    half = _ground(mesh, rng, way, kind)
    for side in (-1.0, 1.0):
        _border(mesh, rng, way, side, half)
        _woods(mesh, rng, way, side, half)
    bodies = _houses(mesh, rng, way, half)
    if rng.random() < 0.4:
        wires(mesh, rng, float(rng.choice((-1, 1))) * (half + rng.uniform(1.0, 4.0)), 90.0)
    ridge = rng.uniform(0.0, 1.0, 24) ** 2 * rng.uniform(0.02, 0.5)
    hills = np.interp(np.arange(96), np.arange(24) * 4.0, ridge, period=96)
    if rng.random() < 0.6:  # a rougher outline
        hills = hills * (1 + 0.25 * rng.standard_normal(96))
    reach = Reach(height=(1.2, 3.2), lateral=1.2, forward=2.5, step=10.0)
    bearing, heading = float(rng.uniform(0, 360)), float(rng.uniform(-12, 12))
    lanes = (-half - 1.0, -half, half, half + 1.0)
    return Place(
        mesh.scene(),
        np.zeros((0, 3)),
        tuple(bodies),
        bearing,
        heading,
        lanes,
        hills,
        reach,
        traffic=kind == "road",
    )


def _ground(mesh: Mesh, rng: np.random.Generator, way: _Way, kind: str) -> float:
    """Add meadows, fields, and the way; return half of its width in metres."""
    mesh.layer = GROUND_LAYER + 9
    # In bands, because a part has one depth, whose haze it gets.
    for near, far in ((300, 2500), (120, 300), (50, 120), (15, 50), (-20, 15)):
        mesh.add(flat(-900, near, 900, far), (0.44, 0.46, 0.40), UP, Kind.GRASS)
    mesh.layer = GROUND_LAYER + 8
    for side in (-1.0, 1.0):
        z = rng.uniform(-10, 10)
        while z < 400 and rng.random() < 0.8:
            deep, near = rng.uniform(10, 40) * (1 + z / 60), rng.uniform(5, 20)
            far = near + rng.uniform(20, 150)
            x0, x1 = sorted((side * near, side * far))
            slant = rng.normal(0, 0.2) * deep
            field = polygons(
                (x0, 0.0, z), (x1, 0.0, z), (x1 + slant, 0.0, z + deep), (x0, 0.0, z + deep)
            )
            mesh.add(field, pick(rng, _FIELDS, 0.2), UP, Kind.SOIL)
            z += deep
    count = 60
    z = rng.uniform(1, 60, count)
    x, size = rng.uniform(-25, 25, count), rng.uniform(0.2, 1.6, count)
    tufts = flat(x, z, x + size, z + size)
    mesh.layer = GROUND_LAYER + 7
    mesh.add(tufts[::2], pick(rng, _FIELDS), UP, Kind.SOIL)
    mesh.add(tufts[1::2], pick(rng, _FIELDS), UP, Kind.SOIL)
    mesh.layer = GROUND_LAYER + 6
    if kind == "meadow":
        return 1.5
    if kind == "path":
        half = rng.uniform(0.7, 1.8)
        mesh.add(way.strip(-half, half), pick(rng, _FIELDS), UP, Kind.SOIL)
        if rng.random() < 0.5:
            mesh.layer = GROUND_LAYER + 5
            mesh.add(way.strip(-0.3 * half, 0.3 * half), pick(rng, _FIELDS), UP, Kind.GRASS)
        return half
    if kind == "road":
        half = rng.uniform(2.2, 5.0)
        asphalt = pick(rng, ((0.30, 0.30, 0.31), (0.42, 0.41, 0.39), (0.5, 0.47, 0.42)))
        mesh.add(way.strip(-half - 0.6, half + 0.6), pick(rng, _STONES), UP, Kind.SOIL)
        mesh.layer = GROUND_LAYER + 5
        mesh.add(way.strip(-half, half), asphalt, UP, Kind.ROAD)
        mesh.layer = GROUND_LAYER + 4
        white = (0.80, 0.80, 0.76)
        if rng.random() < 0.6:
            for at in (-half + 0.2, half - 0.3):
                mesh.add(way.strip(at, at + 0.12), white, UP, Kind.ROAD)
        if rng.random() < 0.7:
            z = np.arange(rng.uniform(0, 6), 90, rng.uniform(4, 9))
            x0, x1 = way.at(z), way.at(z + 2.5)
            dash = polygons(
                (x0 - 0.07, 0.0, z),
                (x0 + 0.07, 0.0, z),
                (x1 + 0.07, 0.0, z + 2.5),
                (x1 - 0.07, 0.0, z + 2.5),
            )
            mesh.add(dash, white, UP, Kind.ROAD)
        return half
    tracks = (0.0,) if rng.random() < 0.6 else (-2.2, 2.2)
    half = abs(tracks[-1]) + 2.0
    mesh.add(way.strip(-half, half), pick(rng, _STONES), UP, Kind.SOIL)
    for track in tracks:
        mesh.layer = GROUND_LAYER + 5
        z = np.arange(0.5, 45, 0.65)
        x = way.at(z) + track
        mesh.add(flat(x - 1.25, z, x + 1.25, z + 0.26), (0.34, 0.30, 0.27), UP, Kind.SOIL)
        mesh.layer = GROUND_LAYER + 4
        for rail in (-0.75, 0.68):
            mesh.add(way.strip(track + rail, track + rail + 0.08), (0.5, 0.46, 0.44), UP)
    if rng.random() < 0.6:
        _masts(mesh, rng, way, half)
    return half


def _masts(mesh: Mesh, rng: np.random.Generator, way: _Way, half: float) -> None:
    """Add the masts and wires of an electric railway."""
    side, gap = float(rng.choice((-1, 1))), rng.uniform(28.0, 50.0)
    steel = (0.36, 0.37, 0.36)
    for z in np.arange(rng.uniform(4.0, gap), _FAR, gap)[::-1]:
        mesh.layer = float(z)
        x = float(way.at(z)) + side * half
        reach = x - side * (half + 0.4)
        mesh.add(rectangles(x - 0.12, 0, x + 0.12, 6.8, z), steel, TO_CAMERA)
        mesh.add(rectangles(min(x, reach), 6.2, max(x, reach), 6.3, z), steel, TO_CAMERA)
    z = np.arange(1.0, _FAR, 12.0)
    x0, x1 = way.at(z), way.at(z + 12.0)
    mesh.layer = 1.0
    for y in (5.4, 6.4):
        wire = polygons((x0, y, z), (x1, y, z + 12), (x1, y + 0.03, z + 12), (x0, y + 0.03, z))
        mesh.add(wire, (0.15, 0.15, 0.16), TO_CAMERA)


def _border(mesh: Mesh, rng: np.random.Generator, way: _Way, side: float, half: float) -> None:
    """Add a hedge, a wall, a fence, a crash barrier or a cutting along one side of the way."""
    kind = rng.choice(
        ("none", "hedge", "wall", "fence", "barrier", "bank"), p=(0.3, 0.16, 0.1, 0.2, 0.08, 0.16)
    )
    if kind == "none":
        return
    off = half + rng.uniform(0.4, 3.0)
    step = 4.0
    stone, low = pick(rng, _STONES), rng.uniform(0.6, 1.4)
    hue, slope = float(rng.random()), rng.uniform(0.5, 1.4)
    height = low
    for z in np.arange(72.0, -step, -step):
        if rng.random() < 0.06:
            continue
        mesh.layer = float(z)
        x0, x1 = (float(way.at(each)) + side * off for each in (z, z + step))
        if kind in ("hedge", "wall"):
            height = low * (rng.uniform(0.7, 1.5) if kind == "hedge" else 1.0)
            face = polygons(
                (x0, 0.0, z), (x1, 0.0, z + step), (x1, height, z + step), (x0, height, z)
            )
            colour = (hue, rng.uniform(0.5, 1.0), 0.0) if kind == "hedge" else stone
            mesh.add(face, colour, (-side, 0.0, 0.0), Kind.BUSH if kind == "hedge" else Kind.SOLID)
            back = side * 0.6
            top = polygons(
                (x0, height, z),
                (x1, height, z + step),
                (x1 + back, height, z + step),
                (x0 + back, height, z),
            )
            mesh.add(top, colour, UP, Kind.BUSH if kind == "hedge" else Kind.LEDGE)
        elif kind == "bank":
            height = max(0.5, min(9.0, height + rng.normal(0, 0.6)))
            wide = side * height * slope
            face = polygons(
                (x0, 0.0, z),
                (x1, 0.0, z + step),
                (x1 + wide, height, z + step),
                (x0 + wide, height, z),
            )
            rock = rng.random() < 0.4
            mesh.add(
                face,
                scaled(stone, rng.uniform(0.8, 1.2)) if rock else (0.4, 0.45, 0.3),
                (-side * 0.6, 0.8, 0.0),
                Kind.SOLID if rock else Kind.GRASS,
            )
        else:
            rails = np.array((0.45, 0.9)) if kind == "fence" else np.array((0.5,))
            wide = 0.08 if kind == "fence" else 0.3
            face = polygons(
                (x0, rails, z),
                (x1, rails, z + step),
                (x1, rails + wide, z + step),
                (x0, rails + wide, z),
            )
            mesh.add(
                face, (0.5, 0.45, 0.38) if kind == "fence" else (0.6, 0.62, 0.64), (-side, 0.0, 0.0)
            )
            mesh.add(rectangles(x0 - 0.06, 0, x0 + 0.06, 1.0, z), (0.42, 0.38, 0.33), TO_CAMERA)


def _woods(mesh: Mesh, rng: np.random.Generator, way: _Way, side: float, half: float) -> None:
    """Add woods as outlines at several distances, and single trees before them."""
    for z in sorted(rng.uniform(18, 300, int(rng.integers(1, 6))), reverse=True):
        if rng.random() < 0.3:
            continue
        wide = rng.uniform(20, 120) * (0.5 + z / 150)
        near = float(way.at(z)) * side + half + rng.uniform(3, 25)
        n = int(np.clip(wide, 12, 40))
        x = side * (near + np.linspace(0, wide, n))
        tall = (
            rng.uniform(5, 15)
            * (1 + 0.25 * rng.standard_normal(n))
            * np.minimum(1, np.linspace(0.3, 6, n))
        )
        tall = np.clip(tall, 1.0, None)
        spikes = rng.random() < 0.4
        mesh.layer = float(z)
        hue = float(rng.random())
        for shade, part in ((1.0, 1.0), (0.75, 0.6)):
            top = tall * part
            if spikes:
                top[1::2] *= 0.7
            band = polygons(
                (x[:-1], 0.0, z), (x[1:], 0.0, z), (x[1:], top[1:], z), (x[:-1], top[:-1], z)
            )
            if spikes:
                mesh.add(band, scaled((0.14, 0.26, 0.17), shade), (0.0, 0.5, -0.85), Kind.NEEDLE)
            else:
                mesh.add(band, (hue, shade * 0.9, 0.0), (0.0, 0.5, -0.85), Kind.BUSH)
    row = rng.random() < 0.3
    count = int(rng.integers(0, 7))
    depths = (
        np.arange(count) * rng.uniform(5, 10) + rng.uniform(5, 9)
        if row
        else rng.uniform(6, 70, count)
    )
    for z in sorted(depths, reverse=True):
        off = half + (2.5 if row else rng.uniform(1.5, 18.0))
        tree(mesh, rng, float(way.at(z)) + side * off, float(z))


def _houses(mesh: Mesh, rng: np.random.Generator, way: _Way, half: float) -> list[Body]:
    """Add a few houses or barns, a sign, a rock."""
    bodies = []
    walls = tuple(WALLS[i] for i in rng.choice(len(WALLS), 3, replace=False))
    habit = Habit(walls, 1, rng.uniform(2.6, 3.2), rng.uniform(2.0, 3.5))
    for z in sorted(rng.uniform(16, 110, int(rng.integers(0, 4))), reverse=True):
        side, wide = float(rng.choice((-1, 1))), rng.uniform(7, 14)
        x = float(way.at(z)) + side * (half + rng.uniform(3, 30))
        x = x - wide if side < 0 else x
        mesh.layer = float(z)
        front = Front(mesh, (x, 0.0, z), (1.0, 0.0, 0.0), TO_CAMERA, sees_start=x > 0)
        height = building(rng, front, wide, habit)
        bodies.append(Body(x, x + wide, z, z + DEPTH, height))
    for z in rng.uniform(5, 40, int(rng.integers(0, 3))):
        mesh.layer = float(z)
        x = float(way.at(z)) + float(rng.choice((-1, 1))) * (half + rng.uniform(0.5, 1.5))
        if rng.random() < 0.6:
            mesh.add(rectangles(x - 0.04, 0, x + 0.04, 2.6, z), (0.45, 0.45, 0.45), TO_CAMERA)
            sign = rectangles(x - 0.35, 1.7, x + 0.35, 2.0 + rng.uniform(0.2, 0.7), z)
            mesh.add(sign, pick(rng, SIGNS), TO_CAMERA)
        else:
            size = rng.uniform(0.4, 1.5)
            block(mesh, (x - size, 0, z), (x + size, size, z + size), pick(rng, _STONES))
    return bodies
