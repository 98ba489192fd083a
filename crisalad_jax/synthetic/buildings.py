"""Add one building to the front of a street: walls, roof, windows, and shops or doors."""

from typing import NamedTuple

import numpy as np

from crisalad_jax.synthetic.mesh import (
    GLASS,
    ROOFS,
    SIGNS,
    WALLS,
    Colour,
    Kind,
    Mesh,
    Number,
    Paint,
    Rng,
    bars,
    draw_kind,
    palette,
    pick,
    polygons,
    rects,
    sheets,
    triangles,
)

_TRIMS = palette("88 87 84, 30 27 25, 70 66 58, 24 33 30")


class Habit(NamedTuple):
    """Properties shared by a street's buildings; `floors` counts those above the ground floor."""

    walls: tuple[Colour, ...]
    floors: int
    storey: float
    """Metres from floor to floor."""
    spacing: float
    """Metres from the middle of one window to the middle of the next."""


DEPTH = 11.0
"""Metres from a building's front to its back."""


def building(rng: Rng, front: Mesh, width: float, habit: Habit) -> None:
    """Add a building to a front, from u = 0 to u = `width` metres (the axes of `Mesh.front`)."""
    wall, trim = pick(rng, habit.walls), pick(rng, _TRIMS)
    floors = max(1, habit.floors + int(rng.integers(-2, 3)))
    ground = rng.uniform(3.2, 4.8)
    storey = habit.storey + rng.uniform(-0.3, 0.4)
    height = ground + storey * floors + rng.uniform(0.2, 1.0)

    end = 0.0 if front.sees_start else width
    front.add(sheets(end, 0, end, -DEPTH, 0, height), 0.85 * wall, normal=front.end_normal)
    _roof(rng, front, width, height, wall)
    front.add(rects(0, 0, width, height), wall)
    base = 0.72 * wall if rng.random() < 0.5 else pick(rng, WALLS)
    front.add(rects(0, 0, width, ground - 0.3), base)
    if rng.random() < 0.3:
        u = np.linspace(0.35, width - 0.35, int(rng.integers(2, 5)))
        front.add(bars(u, 0.3, ground, height), 1.16 * wall)
    levels = ground + storey * np.arange(floors)
    if rng.random() < 0.4:
        front.add(rects(0, levels - 0.15, width, levels + 0.12), 1.18 * wall, Kind.LEDGE)

    _windows(rng, front, width, levels, storey, habit, trim)
    use = draw_kind(rng, shop=0.42, arcade=0.16, door=0.42)
    if use == "shop":
        _shops(rng, front, width, ground - 1.1)
    elif use == "arcade":
        u, cell = _axes(width, rng.uniform(3.0, 5.0))
        _arches(front, u, cell * 0.34, 0.0, ground - 1.3, (0.13, 0.12, 0.12), Kind.SOLID)
    else:
        _door(rng, front, width, ground - 1.0, trim)
    if rng.random() < 0.55:
        front.boxes((0.0, height - 0.45, width, height), 0.5, trim, Kind.LEDGE)
    if rng.random() < 0.3:
        u, top = rng.uniform(0.15, 0.85) * width, ground + rng.uniform(1.0, 3.5)
        sign = (u - 0.1, ground - 0.2, u + 0.1, top)
        front.boxes(sign, rng.uniform(0.9, 1.5), pick(rng, SIGNS))
    corners = front.world(np.array(((0, 0, 0), (width, 0, -DEPTH))))
    (x0, _, z0), (x1, _, z1) = np.sort(corners, axis=0)
    front.bodies.append((x0, x1, z0, z1, height))


def _axes(width: float, spacing: float) -> tuple[np.ndarray, float]:
    """Divide a width into equal cells about `spacing` wide; return their middles and width."""
    count = max(1, round(width / spacing))
    return (np.arange(count) + 0.5) * width / count, width / count


def _arches(
    front: Mesh, u: Number, half: Number, v0: Number, v1: Number, albedo: Paint, kind: Kind
) -> None:
    """Add openings with a rounded head, `half` metres to either side of u."""
    front.add(bars(u, half, v0, v1), albedo, kind)
    front.add(bars(u, half, v1, v1 + 0.8 * half, top=0.5 * half), albedo, kind)


def _roof(rng: Rng, front: Mesh, width: float, height: float, wall: Colour) -> None:
    """Add a pitched, gabled, mansard or flat roof, with dormers, chimneys or tanks."""
    tiles = pick(rng, ROOFS)
    shape = draw_kind(rng, pitched=0.3, gable=0.17, mansard=0.15, flat=0.38)
    x, _, z = front.normal
    uphill = (x * 0.6, 0.8, z * 0.6)
    if shape == "pitched":
        back, ridge = -DEPTH / 2, height + rng.uniform(1.8, 4.0)
        end = 0.0 if front.sees_start else width
        gable = polygons((end, height, 0), (end, height, -DEPTH), (end, ridge, back))
        front.add(gable, 0.85 * wall, normal=front.end_normal)
        front.add(rects(0, height, width, ridge, 0.3, back), tiles, Kind.ROOF, uphill)
        u = rng.uniform(0.1, 0.8) * width
        front.add(rects(u, (height + ridge) / 2, u + 0.9, ridge + 1.2, back * 0.7), 0.8 * wall)
    elif shape == "gable":
        rise, steps = width * rng.uniform(0.3, 0.55), int(rng.integers(1, 5))
        if steps == 1:
            front.add(triangles(0, width, height, width / 2, height + rise), wall)
        else:
            v = height + rise * np.arange(steps) / steps
            inset = width / 2 * np.arange(steps) / steps
            front.add(rects(inset, v, width - inset, v + rise / steps), wall)
        u = width / 2
        front.add(bars(u, 0.5, height + 0.2, height + rise * 0.45), GLASS, Kind.GLASS)
    elif shape == "mansard":
        top = height + rng.uniform(2.4, 3.4)
        front.add(rects(0, height, width, top, 0, -1), tiles, Kind.ROOF, uphill)
        u, _ = _axes(width, rng.uniform(2.6, 4.5))
        front.add(bars(u, 0.75, height + 0.4, top - 0.3, -0.1), 1.1 * wall)
        front.add(bars(u, 0.45, height + 0.6, top - 0.6, -0.1), GLASS, Kind.GLASS)
    else:
        parapet = height + rng.uniform(0.3, 0.9)
        front.add(rects(0, height, width, parapet), 0.9 * wall, Kind.LEDGE)
        if rng.random() < 0.5:
            u, size = rng.uniform(0.1, 0.6) * width, rng.uniform(1.5, 4.0)
            tank = rects(u, height, u + size, height + size * rng.uniform(0.6, 1.3), -3.0)
            front.add(tank, 0.7 * wall)
        if rng.random() < 0.4:
            u, top = rng.uniform(0.1, 0.9) * width, height + rng.uniform(2.5, 6.0)
            mast = np.array((u, u - 0.9)), np.array((height, top - 0.9))
            tips = np.array((u + 0.14, u + 1.0)), np.array((top, top - 0.76))
            front.add(rects(*mast, *tips, -2.0), (0.25, 0.25, 0.27))


def _windows(
    rng: Rng, front: Mesh, wide: float, levels: np.ndarray, rise: float, habit: Habit, trim: Colour
) -> None:
    """Add windows above the ground floor, with frames, shutters, sills and balconies."""
    axis, cell = _axes(wide, habit.spacing * rng.uniform(0.8, 1.25))
    columns = len(axis)
    halves = np.full(columns, cell * rng.uniform(0.17, 0.33))
    tall = rise * rng.uniform(0.45, 0.72)
    low = levels + (rise - tall) * rng.uniform(0.4, 0.7)
    high = low + tall
    style = draw_kind(rng, grid=0.76, bands=0.14, shafts=0.10)
    # The rhythm of the columns identifies the building in every season and light.
    rhythm = rng.integers(6)
    present = np.ones(columns, bool)
    if rhythm == 1 and columns > 2:
        present[columns // 2] = False
    elif rhythm == 2:
        halves[1::2] *= 0.55
    elif rhythm == 3 and columns > 3:
        present[2::3] = False
    elif rhythm == 4 and columns > 2:
        halves[columns // 2] = cell * 0.42
    axis, halves = axis[present], halves[present]
    if style == "bands":
        axis, halves = np.array([wide / 2]), np.array([wide * rng.uniform(0.4, 0.48)])
    elif style == "shafts":
        low, high = low[:1], high[-1:]
    elif len(levels) > 2 and rng.random() < 0.35:
        high[-1] = low[-1] + tall * 0.6
    left, right = axis - halves, axis + halves
    v0, v1 = low[:, None], high[:, None]

    if rng.random() < 0.6:
        front.add(rects(left - 0.22, v0 - 0.22, right + 0.22, v1 + 0.22), trim)
    panes = rects(left, v0, right, v1)
    if style != "grid":
        front.add(panes, GLASS, Kind.GLASS)
        if style == "shafts":
            v = levels[1:, None]
            front.add(rects(left, v, right, v + 0.3), trim)
        return
    if rng.random() < 0.2:
        shutter = pick(rng, _TRIMS)
        front.add(rects(left - halves * 0.75, v0, left, v1), shutter)
        front.add(rects(right, v0, right + halves * 0.75, v1), shutter)
    if rng.random() < 0.22:
        _arches(front, axis, halves, v0, v1, GLASS, Kind.GLASS)
    else:
        front.add(panes, GLASS, Kind.GLASS)
    if rng.random() < 0.45:
        front.add(bars(axis, 0.06, v0, v1), trim)
    if rng.random() < 0.5:
        front.add(rects(left - 0.15, v0 - 0.22, right + 0.15, v0), trim, Kind.LEDGE)
    if rng.random() < 0.32:
        on = rng.random(len(axis)) < rng.choice((0.4, 1.0))
        front.boxes((left[on] - 0.25, v0 - 0.45, right[on] + 0.25, v0 + 0.6), 0.9, trim)


def _shops(rng: Rng, front: Mesh, width: float, lintel: float) -> None:
    """Add shop windows, each with a door and a sign, some with an awning."""
    middle, span = _axes(width, rng.uniform(4.0, 8.0))
    start = middle - span / 2
    end = start + span * rng.uniform(0.5, 0.8)
    front.add(rects(start + 0.4, 0.5, end, lintel), 1.2 * GLASS, Kind.SHOP)
    front.add(rects(end + 0.35, 0, end + 1.3, lintel), 1.2 * GLASS, Kind.SHOP)
    for u0, u1 in zip(start, end, strict=True):
        front.add(rects(u0 + 0.3, lintel + 0.1, u0 + span - 0.3, lintel + 0.8), pick(rng, SIGNS))
        if rng.random() < 0.4:
            high, low, out = lintel + 0.2, lintel - 0.5, rng.uniform(1.0, 1.6)
            front.add(rects(u0, high, u1, low, 0, out), pick(rng, SIGNS), Kind.LEDGE)


def _door(rng: Rng, front: Mesh, width: float, lintel: float, trim: Colour) -> None:
    """Add a house door between windows."""
    u, _ = _axes(width, rng.uniform(2.4, 4.0))
    at = int(rng.integers(len(u)))
    others = np.delete(u, at)
    front.add(bars(others, 0.6, 1.1, lintel), GLASS, Kind.GLASS)
    front.add(bars(u[at], 0.95, 0, 2.9), trim)
    front.add(bars(u[at], 0.65, 0, 2.6), pick(rng, SIGNS))
