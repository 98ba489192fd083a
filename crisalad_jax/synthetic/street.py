"""Build one street with buildings, trees and lamps, all drawn from one seed."""

import numpy as np

from crisalad_jax.synthetic.buildings import Habit, building
from crisalad_jax.synthetic.mesh import (
    GLASS,
    ROOFS,
    WALLS,
    Kind,
    Mesh,
    Place,
    Reach,
    Rng,
    bars,
    draw_hills,
    flat,
    palette,
    pick,
    rects,
    triangles,
)
from crisalad_jax.synthetic.things import lamp, monument, tree, wires

_PAVING = palette("56 54 51, 62 58 52, 50 50 50")
_ASPHALT = palette("30 30 31, 36 35 34, 42 38 35")


def street(rng: Rng) -> Place:
    """Build a random street of a city."""
    mesh = Mesh()
    walls = tuple(WALLS[i] for i in rng.choice(len(WALLS), 5, replace=False))
    floors, storey = int(rng.integers(2, 6)), rng.uniform(2.9, 3.7)
    habit = Habit(walls, floors, storey, rng.uniform(2.0, 3.8))
    left, right = -rng.uniform(6.5, 12.0), rng.uniform(6.5, 12.0)
    length = rng.uniform(28.0, 62.0)
    kerbs = (left + rng.uniform(2.0, 3.5), right - rng.uniform(2.0, 3.5))

    _ground(mesh, rng, kerbs, length)
    _skyline(mesh, rng, length)
    _far_row(mesh, rng, length, habit)
    park = rng.choice(3, p=(0.7, 0.15, 0.15))
    for number, x, side in ((1, left, -1.0), (2, right, 1.0)):
        if park == number:
            _park(mesh, rng, x, side, length)
        else:
            _row(mesh, rng, x, side, length, habit)
    for x in (kerbs[0] - 0.6, kerbs[1] + 0.6):
        if rng.random() < 0.55:
            for z in np.arange(rng.uniform(7.0, 16.0), length - 2, rng.uniform(7.0, 14.0)):
                if rng.random() < 0.8:
                    tree(mesh, rng, x + rng.uniform(-0.3, 0.3), z + rng.uniform(-1, 1))
        if rng.random() < 0.6 or (x > 0 and not mesh.lamps):
            height = rng.uniform(5.0, 8.0)
            for z in np.arange(rng.uniform(6.0, 16.0), length + 4, rng.uniform(14.0, 24.0)):
                lamp(mesh, x, float(z), height)
    if rng.random() < 0.4:
        wires(mesh, rng, float(rng.choice(kerbs)), length)
    if rng.random() < 0.25:
        monument(mesh, rng, sum(kerbs) / 2, rng.uniform(0.45, 0.9) * length)

    hills = draw_hills(rng, 0.2)
    bearing, heading = float(rng.uniform(0, 360)), float(rng.uniform(-20, 20))
    lanes = (left, *kerbs, right)
    reach = Reach(height=(1.2, 3.0), lateral=1.2, forward=2.5, step=9.0)
    scene, bodies, lamps = mesh.scene(), mesh.bodies, np.array(mesh.lamps)
    return Place(scene, heading, lanes, reach, bearing, hills, bodies, lamps)


def _ground(mesh: Mesh, rng: Rng, kerbs: tuple[float, float], length: float) -> None:
    """Add pavements, the street, the crossing at its far end, and their markings."""
    paving, asphalt = pick(rng, _PAVING), pick(rng, _ASPHALT)
    left, right = kerbs
    mesh.ground(flat(-900, -20, 900, 2500), (0.44, 0.46, 0.40), Kind.GRASS)
    mesh.ground(flat(-200, -20, 200, length + 25), paving, Kind.PAVEMENT)
    street, crossing = flat(left, -20, right, length + 1), flat(-120, length + 1, 120, length + 8)
    mesh.ground(np.concatenate((street, crossing)), asphalt, Kind.ROAD)
    edge = np.array(kerbs)
    mesh.ground(flat(edge - 0.12, -5, edge + 0.12, length + 1), 1.25 * paving, Kind.PAVEMENT)
    white, middle = (0.78, 0.78, 0.74), (left + right) / 2
    if rng.random() < 0.7:
        dash = rng.uniform(1.5, 3.5)
        z = np.arange(1, length, dash * 2)
        mesh.ground(flat(middle - 0.08, z, middle + 0.08, z + dash), white, Kind.ROAD)
    if rng.random() < 0.45:
        z, x = rng.uniform(6.0, length - 6), np.arange(left + 0.4, right - 0.6, 1.0)
        mesh.ground(flat(x, z, x + 0.5, z + 3), white, Kind.ROAD)
    if rng.random() < 0.35:
        x = np.array((left + 2.2, right - 2.2))
        mesh.ground(flat(x - 0.06, -5, x + 0.06, length), white, Kind.ROAD)
    if rng.random() < 0.2:
        x = middle + np.array((-2.2, -0.8, 0.8, 2.2))
        mesh.ground(flat(x - 0.07, -5, x + 0.07, length), (0.20, 0.20, 0.21))


def _skyline(mesh: Mesh, rng: Rng, length: float) -> None:
    """Add distant towers, and at times a steeple: landmarks that barely move."""
    for _ in range(int(rng.integers(0, 6))):
        z = length + rng.uniform(90, 320)
        tower = mesh.at(rng.uniform(-0.9, 0.9) * z, z, layer=3000 + z)
        width, height = rng.uniform(14, 34), z * rng.uniform(0.18, 0.5)
        colour = pick(rng, WALLS[6:])
        tower.add(rects(0, 0, width, height), colour)
        if rng.random() < 0.5:
            tower.add(rects(width * 0.25, height, width * 0.75, height * 1.12), colour)
        columns, rows = int(rng.integers(3, 7)), int(rng.integers(6, 14))
        u = (np.arange(columns) + 0.2) * width / columns
        v = ((np.arange(rows) + 0.3) * height / rows)[:, None]
        panes = rects(u, v, u + 0.6 * width / columns, v + 0.5 * height / rows)
        tower.add(panes, 1.6 * GLASS, Kind.GLASS)
    if rng.random() < 0.4:
        z = length + rng.uniform(30, 90)
        steeple = mesh.at(rng.uniform(-0.5, 0.5) * z, z, layer=2000 + z)
        half, height = rng.uniform(2.5, 4), z * rng.uniform(0.28, 0.45)
        steeple.add(bars(0, half, 0, height), pick(rng, WALLS[:6]))
        spire = triangles(-half - 0.4, half + 0.4, height, 0, height * rng.uniform(1.2, 1.7))
        steeple.add(spire, pick(rng, ROOFS), Kind.ROOF, (0.0, 0.6, -0.8))
        steeple.add(bars(0, half * 0.3, height * 0.82, height * 0.93), (0.12, 0.12, 0.13))


def _far_row(mesh: Mesh, rng: Rng, length: float, habit: Habit) -> None:
    """Add the buildings that close the street, at varying distances and at times with a gap."""
    reach = 14 + length * 0.7
    stands: list[tuple[float, float, float]] = []
    x = -reach
    while x < reach:
        width = rng.uniform(8.0, 18.0)
        if rng.random() < 0.86:
            stands.append((length + 11 + rng.choice((0.0, 0.0, 3.0, 7.0)), x, width))
        x += width
    for z, x, width in sorted(stands, reverse=True):
        building(rng, mesh.front(x, z, 0, layer=1000 + z), width, habit)


def _row(mesh: Mesh, rng: Rng, x: float, side: float, length: float, habit: Habit) -> None:
    """Add one side of the street, from the camera to the crossing, with gaps and setbacks."""
    z = rng.uniform(-9.0, -2.0)
    while z < length - 5:
        width = min(rng.uniform(7.0, 17.0), length - z)
        if z > 4 and rng.random() < 0.12:
            z += width * 0.6
            continue
        face = x + side * rng.choice((0.0, 0.0, 0.0, 0.8, 2.5))
        building(rng, mesh.front(face, z, side, layer=z + width), width, habit)
        z += width


def _park(mesh: Mesh, rng: Rng, x: float, side: float, length: float) -> None:
    """Add lawn and trees behind a wall, on a side without houses."""
    mesh.ground(flat(x, -5, x + side * 90, length), (0.40, 0.48, 0.30), Kind.GRASS)
    for z in np.arange(rng.uniform(10, 16), length, rng.uniform(5.0, 9.0)):
        tree(mesh, rng, x + side * rng.uniform(2.0, 16.0), float(z))
    colour, height = pick(rng, WALLS), rng.uniform(0.7, 1.6)
    # The wall is in pieces, each with its own layer: a tree may stand in front of one and behind
    # the next.
    for z in np.arange(-3.0, length, 3.0):
        front = mesh.front(x, float(z), side, layer=float(z))
        front.add(rects(0, 0, 3, height), colour)
        front.add(rects(0, height, 3, height + 0.12), colour, Kind.LEDGE)
