"""Build one place in the country: a road, railway or path through fields, woods and hills."""

from typing import Any

import numpy as np

from crisalad_jax.synthetic.buildings import Habit, building
from crisalad_jax.synthetic.mesh import (
    GROUND_LAYER,
    SIGNS,
    SLANTED,
    UP,
    WALLS,
    Kind,
    Mesh,
    Place,
    Reach,
    Rng,
    bars,
    draw_hills,
    draw_kind,
    flat,
    palette,
    pick,
    polygons,
    sheets,
)
from crisalad_jax.synthetic.things import tree, wires

_FIELDS = palette("55 50 28, 42 34 24, 36 46 22, 62 56 36, 30 36 20, 66 62 24")
_STONES = palette("50 49 46, 42 40 37, 60 57 50")
_ASPHALT = palette("30 30 31, 42 41 39, 50 47 42")
_FAR = 140.0
"""Metres up to which objects along the way are drawn."""


class _Way:
    """The course of the way: x of its middle, a parabola through the point below the camera."""

    def __init__(self, rng: Rng) -> None:
        self._bend = rng.normal(0.0, 0.0022)
        self._drift = rng.normal(0.0, 0.05)

    def at(self, z: Any) -> Any:
        """Return x at one distance or at each of an array."""
        return self._drift * z + self._bend * np.square(z)

    def band(self, z0: np.ndarray, z1: np.ndarray, low: float, high: float) -> np.ndarray:
        """Make quadrilaterals on the ground, between two distances from the middle."""
        x0, x1 = self.at(z0), self.at(z1)
        near, far = ((x0 + low, 0, z0), (x0 + high, 0, z0)), ((x1 + high, 0, z1), (x1 + low, 0, z1))
        return polygons(*near, *far)

    def strip(self, low: float, high: float) -> np.ndarray:
        """Make a band along the entire way."""
        z = np.concatenate((np.arange(-4.0, 40, 3.0), np.arange(40, _FAR + 1, 12.5)))
        return self.band(z[:-1], z[1:], low, high)


def country(rng: Rng) -> Place:
    """Build a random place in the country, on a road, a railway, a path or a meadow."""
    mesh = Mesh()
    way = _Way(rng)
    kind = draw_kind(rng, road=0.4, railway=0.3, path=0.2, meadow=0.1)
    _fields(mesh, rng)
    half = _lay(mesh, rng, way, kind)
    for side in (-1.0, 1.0):
        _border(mesh, rng, way, side, half)
        _woods(mesh, rng, way, side, half)
    _houses(mesh, rng, way, half)
    _roadside(mesh, rng, way, half)
    if rng.random() < 0.4:
        wires(mesh, rng, float(rng.choice((-1, 1))) * (half + rng.uniform(1.0, 4.0)), 90.0)
    hills = draw_hills(rng, 0.5)
    if rng.random() < 0.6:  # a rougher outline
        hills = hills * (1 + 0.25 * rng.standard_normal(96))
    bearing, heading = float(rng.uniform(0, 360)), float(rng.uniform(-12, 12))
    lanes = (-half - 1.0, -half, half, half + 1.0)
    reach = Reach(height=(1.2, 3.2), lateral=1.2, forward=2.5, step=10.0)
    scene, road = mesh.scene(), kind == "road"
    return Place(scene, heading, lanes, reach, bearing, hills, mesh.bodies, traffic=road)


def _fields(mesh: Mesh, rng: Rng) -> None:
    """Add a meadow, fields and tufts."""
    # In bands, because a part has a single depth, which decides its haze.
    for near, far in ((300, 2500), (120, 300), (50, 120), (15, 50), (-20, 15)):
        mesh.ground(flat(-900, near, 900, far), (0.44, 0.46, 0.40), Kind.GRASS)
    for side in (-1.0, 1.0):
        z = rng.uniform(-10, 10)
        while z < 400 and rng.random() < 0.8:
            deep, near = rng.uniform(10, 40) * (1 + z / 60), rng.uniform(5, 20)
            far = near + rng.uniform(20, 150)
            x0, x1 = sorted((side * near, side * far))
            slant = rng.normal(0, 0.2) * deep
            z1 = z + deep
            field = polygons((x0, 0, z), (x1, 0, z), (x1 + slant, 0, z1), (x0, 0, z1))
            mesh.ground(field, pick(rng, _FIELDS, 0.2), Kind.SOIL)
            z = z1
    z = rng.uniform(1, 60, 60)
    x, size = rng.uniform(-25, 25, 60), rng.uniform(0.2, 1.6, 60)
    tufts = flat(x, z, x + size, z + size)
    for half in (tufts[::2], tufts[1::2]):
        mesh.ground(half, pick(rng, _FIELDS), Kind.SOIL)


def _lay(mesh: Mesh, rng: Rng, way: _Way, kind: str) -> float:
    """Add the way; return half of its width in metres."""
    if kind == "railway":
        return _railway(mesh, rng, way)
    if kind == "road":
        return _road(mesh, rng, way)
    if kind == "meadow":
        return 1.5
    half = rng.uniform(0.7, 1.8)
    mesh.ground(way.strip(-half, half), pick(rng, _FIELDS), Kind.SOIL)
    if rng.random() < 0.5:
        mesh.ground(way.strip(-0.3 * half, 0.3 * half), pick(rng, _FIELDS), Kind.GRASS)
    return half


def _road(mesh: Mesh, rng: Rng, way: _Way) -> float:
    half = rng.uniform(2.2, 5.0)
    asphalt, white = pick(rng, _ASPHALT), (0.80, 0.80, 0.76)
    mesh.ground(way.strip(-half - 0.6, half + 0.6), pick(rng, _STONES), Kind.SOIL)
    mesh.ground(way.strip(-half, half), asphalt, Kind.ROAD)
    if rng.random() < 0.6:
        for at in (-half + 0.2, half - 0.3):
            mesh.ground(way.strip(at, at + 0.12), white, Kind.ROAD)
    if rng.random() < 0.7:
        z = np.arange(rng.uniform(0, 6), 90, rng.uniform(4, 9))
        mesh.ground(way.band(z, z + 2.5, -0.07, 0.07), white, Kind.ROAD)
    return half


def _railway(mesh: Mesh, rng: Rng, way: _Way) -> float:
    """Add one track or two, at times with masts and wires."""
    tracks = (0.0,) if rng.random() < 0.6 else (-2.2, 2.2)
    half = abs(tracks[-1]) + 2.0
    mesh.ground(way.strip(-half, half), pick(rng, _STONES), Kind.SOIL)
    z = np.arange(0.5, 45, 0.65)
    for track in tracks:
        x = way.at(z) + track
        mesh.ground(flat(x - 1.25, z, x + 1.25, z + 0.26), (0.34, 0.30, 0.27), Kind.SOIL)
        for rail in (-0.75, 0.68):
            strip = way.strip(track + rail, track + rail + 0.08)  # over the sleepers of both tracks
            mesh.add(strip, (0.5, 0.46, 0.44), normal=UP, layer=GROUND_LAYER)
    if rng.random() < 0.6:
        _masts(mesh, rng, way, half)
    return half


def _masts(mesh: Mesh, rng: Rng, way: _Way, half: float) -> None:
    """Add the masts and wires of an electric railway."""
    side, gap = float(rng.choice((-1, 1))), rng.uniform(28.0, 50.0)
    steel = (0.36, 0.37, 0.36)
    for z in np.arange(rng.uniform(4.0, gap), _FAR, gap)[::-1]:
        mast = mesh.at(way.at(z) + side * half, z)
        mast.add(bars(0, 0.12, 0, 6.8), steel)
        arm = half / 2 + 0.2
        mast.add(bars(-side * arm, arm, 6.2, 6.3), steel)
    z = np.arange(1.0, _FAR, 12.0)
    for y in (5.4, 6.4):
        wire = sheets(way.at(z), z, way.at(z + 12.0), z + 12, y, y + 0.03)
        mesh.add(wire, (0.15, 0.15, 0.16), layer=1.0)


def _border(mesh: Mesh, rng: Rng, way: _Way, side: float, half: float) -> None:
    """Add a hedge, a wall, a fence, a crash barrier or a cutting along one side of the way."""
    kind = draw_kind(rng, none=0.3, hedge=0.16, wall=0.1, fence=0.2, barrier=0.08, bank=0.16)
    if kind == "none":
        return
    off, step = half + rng.uniform(0.4, 3.0), 4.0
    stone, low = pick(rng, _STONES), rng.uniform(0.6, 1.4)
    hue, slope = float(rng.random()), rng.uniform(0.5, 1.4)
    height, inwards = low, (-side, 0.0, 0.0)
    for z in np.arange(72.0, -step, -step):
        if rng.random() < 0.06:
            continue
        mesh.layer = float(z)
        x0, x1 = way.at(np.array((z, z + step))) + side * off
        line = x0, z, x1, z + step
        if kind == "hedge":
            height = low * rng.uniform(0.7, 1.5)
            leaves = (hue, rng.uniform(0.5, 1.0), 0.0)
            mesh.add(sheets(*line, 0, height), leaves, Kind.BUSH, inwards)
            mesh.add(sheets(*line, height, height, side * 0.6), leaves, Kind.BUSH, UP)
        elif kind == "wall":
            mesh.add(sheets(*line, 0, height), stone, normal=inwards)
            mesh.add(sheets(*line, height, height, side * 0.6), stone, Kind.LEDGE, UP)
        elif kind == "bank":
            height = max(0.5, min(9.0, height + rng.normal(0, 0.6)))
            colour, cover = (0.4, 0.45, 0.3), Kind.GRASS
            if rng.random() < 0.4:
                colour, cover = rng.uniform(0.8, 1.2) * stone, Kind.SOLID
            face = sheets(*line, 0, height, side * height * slope)
            mesh.add(face, colour, cover, (-side * 0.6, 0.8, 0.0))
        else:
            rails, wide, colour = np.array((0.5,)), 0.3, (0.6, 0.62, 0.64)
            if kind == "fence":
                rails, wide, colour = np.array((0.45, 0.9)), 0.08, (0.5, 0.45, 0.38)
            mesh.add(sheets(*line, rails, rails + wide), colour, normal=inwards)
            mesh.add(bars(x0, 0.06, 0, 1.0, z), (0.42, 0.38, 0.33))


def _woods(mesh: Mesh, rng: Rng, way: _Way, side: float, half: float) -> None:
    """Add woods as outlines at several distances, and single trees in front of them."""
    for z in sorted(rng.uniform(18, 300, int(rng.integers(1, 6))), reverse=True):
        if rng.random() < 0.3:
            continue
        wide = rng.uniform(20, 120) * (0.5 + z / 150)
        near = way.at(z) * side + half + rng.uniform(3, 25)
        n = int(np.clip(wide, 12, 40))
        x = side * (near + np.linspace(0, wide, n))
        tall = rng.uniform(5, 15) * (1 + 0.25 * rng.standard_normal(n))
        tall = np.clip(tall * np.minimum(1, np.linspace(0.3, 6, n)), 1.0, None)
        spikes = rng.random() < 0.4
        hue = float(rng.random())
        for shade, part in ((1.0, 1.0), (0.75, 0.6)):
            top, colour, kind = tall * part, (hue, shade * 0.9, 0.0), Kind.BUSH
            if spikes:
                top[1::2] *= 0.7
                colour, kind = shade * np.array((0.14, 0.26, 0.17)), Kind.NEEDLE
            tips = (x[1:], top[1:], z), (x[:-1], top[:-1], z)
            band = polygons((x[:-1], 0, z), (x[1:], 0, z), *tips)
            mesh.add(band, colour, kind, SLANTED, layer=float(z))
    row = rng.random() < 0.3
    count = int(rng.integers(0, 7))
    if row:
        depths = np.arange(count) * rng.uniform(5, 10) + rng.uniform(5, 9)
    else:
        depths = rng.uniform(6, 70, count)
    for z in sorted(depths, reverse=True):
        off = half + (2.5 if row else rng.uniform(1.5, 18.0))
        tree(mesh, rng, way.at(z) + side * off, float(z))


def _houses(mesh: Mesh, rng: Rng, way: _Way, half: float) -> None:
    """Add a few houses or barns."""
    walls = tuple(WALLS[i] for i in rng.choice(len(WALLS), 3, replace=False))
    habit = Habit(walls, 1, rng.uniform(2.6, 3.2), rng.uniform(2.0, 3.5))
    for z in sorted(rng.uniform(16, 110, int(rng.integers(0, 4))), reverse=True):
        side, wide = float(rng.choice((-1, 1))), rng.uniform(7, 14)
        x = way.at(z) + side * (half + rng.uniform(3, 30))
        front = mesh.front(x - wide if side < 0 else x, z, 0, layer=z)
        building(rng, front, wide, habit)


def _roadside(mesh: Mesh, rng: Rng, way: _Way, half: float) -> None:
    """Add up to two signs or rocks."""
    for z in rng.uniform(5, 40, int(rng.integers(0, 3))):
        x = way.at(z) + float(rng.choice((-1, 1))) * (half + rng.uniform(0.5, 1.5))
        foot = mesh.at(x, z)
        if rng.random() < 0.6:
            foot.add(bars(0, 0.04, 0, 2.6), (0.45, 0.45, 0.45))
            foot.add(bars(0, 0.35, 1.7, 2.0 + rng.uniform(0.2, 0.7)), pick(rng, SIGNS))
        else:
            size = rng.uniform(0.4, 1.5)
            foot.block((-size, 0, 0), (size, size, size), pick(rng, _STONES))
