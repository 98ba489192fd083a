"""Build one place indoors: a corridor, a hall or a room, with what stands or hangs in it."""

from typing import NamedTuple

import numpy as np

from crisalad_jax.synthetic.mesh import (
    DOWN,
    GROUND_LAYER,
    SIGNS,
    UP,
    WALLS,
    Colour,
    Kind,
    Mesh,
    Place,
    Reach,
    Rng,
    bars,
    discs,
    draw_kind,
    flat,
    palette,
    pick,
    rects,
)

_EYE = 1.2
_START = -4.0
"""Metres along the corridor at which its walls begin, behind every camera."""
_WOOD = palette("50 34 20, 36 23 14, 66 52 36, 75 75 72, 30 38 46, 55 20 17")
_FLOORS = palette("40 40 41, 55 52 47, 30 31 36, 62 60 57, 42 27 20, 24 26 24")
_CEILINGS = palette("86 85 82, 72 72 70, 60 56 50, 30 30 30")


class _Box(NamedTuple):
    """The inside of a corridor in metres: x of its walls, its height, its length."""

    left: float
    right: float
    height: float
    length: float


def corridor(rng: Rng) -> Place:
    """Build a random corridor; one in four is a wide hall with columns."""
    hall = rng.random() < 0.25
    width = rng.uniform(5.0, 16.0) if hall else rng.uniform(1.5, 4.2)
    height = rng.uniform(3.0, 8.0) if hall else rng.uniform(2.2, 3.4)
    length = rng.uniform(14.0, 50.0)
    left = -width * rng.uniform(0.3, 0.7)
    box = _Box(left, left + width, height, length)
    mesh = _shell(rng, box)
    if hall or rng.random() < 0.15:
        _columns(mesh, rng, box)
    if rng.random() < 0.5:
        _hanging(mesh, rng, box)
    return _place(mesh, rng, box, step=rng.uniform(1.2, 2.5))


def room(rng: Rng) -> Place:
    """Build a random room: a wide box with furniture, and objects also along its end wall."""
    width, length = rng.uniform(3.5, 10.0), rng.uniform(7.0, 13.0)
    left = -width * rng.uniform(0.3, 0.7)
    box = _Box(left, left + width, rng.uniform(2.3, 4.2), length)
    mesh = _shell(rng, box)
    end = mesh.front(0.0, length, 0, layer=GROUND_LAYER + 1)
    _stains(end, rng, pick(rng, WALLS), box)
    _along_wall(end, rng, box.left + 0.2, box.right, box.height)
    for z in sorted(rng.uniform(1.5, length - 0.5, int(rng.integers(3, 14))), reverse=True):
        _stand(mesh.at(rng.uniform(box.left + 0.5, box.right - 0.5), z), rng)
    return _place(mesh, rng, box, step=(length - 3.0) / 3.5)


def _place(mesh: Mesh, rng: Rng, box: _Box, step: float) -> Place:
    """Draw where cameras stand and look, for a place inside a box."""
    lateral = min(0.8, 0.12 * (box.right - box.left))
    reach = Reach((0.5, min(1.9, box.height - 0.4)), lateral, forward=0.3, step=step)
    heading, lanes = rng.uniform(-12, 12), (box.left, box.left, box.right, box.right)
    return Place(mesh.scene(), heading, lanes, reach, indoors=True, traffic=False)


def _shell(rng: Rng, box: _Box) -> Mesh:
    """Build floor, ceiling, end and side walls, with what is on them."""
    mesh, height, length = Mesh(_EYE), box.height, box.length
    mesh.layer = GROUND_LAYER + 1  # walls and ceiling, painted before all objects
    walls = [pick(rng, WALLS), pick(rng, WALLS)]
    if rng.random() < 0.7:
        walls[1] = walls[0]
    band = rng.uniform(0.8, 1.4) if rng.random() < 0.4 else 0.0
    dado, skirting = pick(rng, WALLS), 0.8 * pick(rng, _WOOD)

    _floor(mesh, rng, box)
    _ceiling(mesh, rng, box)
    _end(mesh, rng, box)
    for x, side, wall in ((box.left, -1.0, walls[0]), (box.right, 1.0, walls[1])):
        front = mesh.front(x, 0.0, side)
        front.add(rects(_START, 0, length, height), wall)
        _stains(front, rng, wall, box)
        if band:
            front.add(rects(_START, 0, length, band), dado)
            front.add(rects(_START, band, length, band + 0.06), skirting)
        front.add(rects(_START, 0, length, 0.12), skirting)
        _along_wall(front, rng, _START, length, height)
    return mesh


def _floor(mesh: Mesh, rng: Rng, box: _Box) -> None:
    """Add the floor, with tiles, a carpet, planks or spots."""
    left, right, _, length = box
    colour = pick(rng, _FLOORS)
    mesh.add(flat(left, _START, right, length), colour, normal=UP, layer=GROUND_LAYER + 2)
    kind = draw_kind(rng, plain=0.2, tiles=0.3, carpet=0.2, boards=0.1, checks=0.2)
    if kind == "tiles":
        size, line = rng.uniform(0.3, 1.2), rng.uniform(0.01, 0.03)
        shade = rng.choice((0.75, 1.25)) * colour
        z, x = np.arange(_START, length, size), np.arange(left, right, size)
        mesh.ground(flat(left, z - line, right, z + line), shade)
        mesh.ground(flat(x - line, _START, x + line, length), shade)
    elif kind == "carpet":
        inset = rng.uniform(0.1, 0.3) * (right - left)
        mesh.ground(flat(left + inset, _START, right - inset, length), pick(rng, SIGNS, 0.3))
        if rng.random() < 0.5:
            edge = np.array((left + inset, right - inset - 0.08))
            mesh.ground(flat(edge, _START, edge + 0.08, length), pick(rng, SIGNS, 0.3))
    elif kind == "boards":
        x = np.arange(left, right, rng.uniform(0.15, 0.4))[::2]
        mesh.ground(flat(x, _START, x + 0.1, length), 0.88 * colour)
    elif kind == "checks":
        size = rng.uniform(0.3, 1.0)
        x, z = np.meshgrid(np.arange(left, right, size), np.arange(_START, length, size))
        odd = (np.indices(x.shape).sum(0) % 2).astype(bool)
        x, z = x[odd], z[odd]
        checks = flat(x, z, np.minimum(x + size, right), z + size)
        mesh.ground(checks, rng.uniform(0.5, 0.9) * colour)
    count = int(rng.integers(0, 14))
    x, z = rng.uniform(left, right - 0.3, count), rng.uniform(0, length, count)
    size = rng.uniform(0.1, 0.6, count)
    spots = flat(x, z, np.minimum(x + size, right), z + size * rng.uniform(0.5, 2.0))
    mesh.ground(spots, rng.uniform(0.6, 1.3) * colour)


def _ceiling(mesh: Mesh, rng: Rng, box: _Box) -> None:
    """Add the ceiling with its lamps, at times also panels, beams and pipes."""
    left, right, height, length = box
    colour = pick(rng, _CEILINGS)
    ceiling = flat(left, _START, right, length, height)
    mesh.add(ceiling, colour, normal=DOWN, layer=GROUND_LAYER + 2)
    if rng.random() < 0.45:
        size = rng.uniform(0.5, 1.3)
        z, x = np.arange(_START, length, size), np.arange(left, right, size)
        shade = rng.uniform(0.7, 0.9) * colour
        mesh.add(flat(left, z - 0.015, right, z + 0.015, height), shade, normal=DOWN)
        mesh.add(flat(x - 0.015, _START, x + 0.015, length, height), shade, normal=DOWN)
    kind = draw_kind(rng, panels=0.45, strip=0.2, points=0.2, none=0.15)
    gap, start = rng.uniform(1.8, 5.0), rng.uniform(0.0, 3.0)
    z = np.arange(start, length, gap)
    middle = (left + right) / 2
    rows = (middle,) if right - left < 6 else tuple(np.linspace(left, right, 4)[1:3])
    for x in rows if kind != "none" else ():
        if kind == "panels":
            w, d = rng.uniform(0.15, 0.7), rng.uniform(0.3, 0.7)
            lamps = flat(x - w, z - d, x + w, z + d, height)
        elif kind == "strip":
            lamps = flat(x - 0.07, z, x + 0.07, z + gap * 0.7, height)
        else:
            z = np.arange(start, length, gap / 2)
            lamps = flat(x - 0.1, z - 0.1, x + 0.1, z + 0.1, height)
        mesh.add(lamps, (0.96, 0.96, 0.92), Kind.LAMP, DOWN)
    if rng.random() < 0.25:
        depth = rng.uniform(0.15, 0.6)
        for at in np.arange(length - rng.uniform(0.5, 2), 0, -rng.uniform(2.0, 5.0)):
            mesh.add(rects(left, height - depth, right, height, at), 0.8 * colour, layer=at)
            under = flat(left, at, right, at + 0.3, height - depth)
            mesh.add(under, 0.9 * colour, normal=DOWN, layer=at)
    if rng.random() < 0.3:
        for _ in range(int(rng.integers(1, 4))):
            x, r = rng.uniform(left + 0.1, right - 0.2), rng.uniform(0.04, 0.15)
            pipe = flat(x - r, _START, x + r, length, height - 0.25)
            mesh.add(pipe, pick(rng, SIGNS + WALLS), normal=DOWN)


def _end(mesh: Mesh, rng: Rng, box: _Box) -> None:
    """Add what closes the corridor: a wall, a door, a window, or an opening."""
    left, right, height, length = box
    wall, end = pick(rng, WALLS), mesh.front(0.0, length, 0)
    end.add(rects(left, 0, right, height), wall)
    middle, half = rng.uniform(0.3, 0.7) * (right - left) + left, rng.uniform(0.2, 0.45)
    half *= min(right - left, 3.0)
    kind = draw_kind(rng, wall=0.2, door=0.35, window=0.2, way=0.25)
    low, high = max(left, middle - half), min(right, middle + half)
    if kind == "door":
        door, top = pick(rng, _WOOD), min(2.1, height - 0.1)
        end.add(rects(low - 0.08, 0, high + 0.08, top + 0.08), 0.7 * door)
        end.add(rects(low, 0, high, top), door)
        if rng.random() < 0.5:
            end.add(rects(low + 0.15, 1.1, high - 0.15, top - 0.15), (0.8, 0.85, 0.9), Kind.WINDOW)
    elif kind == "window":
        sill, top = rng.uniform(0.0, 1.2), height - rng.uniform(0.1, 0.6)
        end.add(rects(low, sill, high, top), (1.0, 1.0, 1.0), Kind.WINDOW)
        end.add(bars(np.linspace(low, high, int(rng.integers(2, 6))), 0.03, sill, top), wall)
    elif kind == "way":
        shade = rng.uniform(0.15, 1.2)
        end.add(rects(low, 0, high, height * 0.9), shade * wall)
        inner = rects(low + 0.2 * half, 0, high - 0.3 * half, height * 0.75)
        end.add(inner, shade * rng.uniform(0.5, 1.5) * wall)


def _stains(front: Mesh, rng: Rng, wall: Colour, box: _Box) -> None:
    """Add bricks, panels or spots to a wall."""
    height, length = box.height, box.length
    kind = draw_kind(rng, none=0.4, bricks=0.15, panels=0.2, spots=0.25)
    if kind == "bricks":
        n = 260
        u, v = rng.uniform(_START, length, n), rng.integers(0, int(height / 0.2), n) * 0.2
        bricks = rects(u, v, u + rng.uniform(0.3, 0.5), np.minimum(v + 0.18, height))
        front.add(bricks[: n // 2], 0.82 * wall)
        front.add(bricks[n // 2 :], 1.15 * wall)
    elif kind == "panels":
        u = np.arange(_START, length, rng.uniform(0.8, 2.5))
        front.add(bars(u, 0.02, 0, height), 0.7 * wall)
    elif kind == "spots":
        n = 30
        u, v = rng.uniform(_START, length, n), rng.uniform(0, height * 0.9, n)
        size = rng.uniform(0.1, 0.7, n)
        spots = rects(u, v, u + size, np.minimum(v + size * rng.uniform(0.3, 2), height))
        front.add(spots, rng.uniform(0.75, 1.2) * wall)


def _along_wall(front: Mesh, rng: Rng, start: float, stop: float, height: float) -> None:
    """Add doors, windows, boards and furniture along one wall, one after another."""
    doors, trim = pick(rng, _WOOD), 0.9 * pick(rng, _WOOD)
    # What recurs along this wall; the order and the spacing identify the place.
    kinds = ("door", "recess", "window", "board", "pillar", "cupboard", "bench", "box")
    kinds += ("opening", "pipe")
    weights = rng.dirichlet(np.full(len(kinds), 0.7))
    top = min(2.1, height - 0.15)
    u = start + rng.uniform(0.0, 2.0)
    while u < stop - 1.2:
        kind = rng.choice(kinds, p=weights)
        z = float(front.world(np.array((u, 0.0, 0.0)))[2])
        here = front.at(u, 0.0, layer=GROUND_LAYER - 1 - z * 1e-3)  # after all walls
        wide = rng.uniform(0.75, 1.1)
        if kind == "door":
            _door(here, rng, wide, top, doors, trim)
        elif kind == "recess":
            here.add(rects(0, 0, wide * 1.4, top), 0.5 * trim)
            here.add(rects(0.35, 0, wide * 1.4, top), doors)
        elif kind == "opening":
            wide *= 1.8
            here.add(rects(0, 0, wide, top * 1.05), (0.12, 0.12, 0.13))
            inner = rng.uniform(0.2, 0.9) * np.array((0.8, 0.8, 0.76))
            here.add(rects(wide * 0.5, 0, wide, top * 1.05), inner)
        elif kind == "window":
            wide *= rng.uniform(1.0, 2.0)
            sill, high = rng.uniform(0.5, 1.2), height - rng.uniform(0.2, 0.7)
            here.add(rects(-0.08, sill - 0.1, wide + 0.08, high + 0.08), trim)
            here.add(rects(0, sill, wide, high), (1.0, 1.0, 1.0), Kind.WINDOW)
            panes = np.linspace(0, wide, int(rng.integers(1, 4)) + 1)[1:-1]
            here.add(bars(panes, 0.03, sill, high), trim)
        elif kind == "board":
            v, tall = rng.uniform(1.0, 1.5), rng.uniform(0.3, 0.9)
            wide *= rng.uniform(0.5, 1.8)
            here.add(rects(0, v, wide, v + tall), pick(rng, SIGNS + WALLS, 0.2))
            n = int(rng.integers(0, 9))
            left, low = rng.uniform(0, 0.7, n) * wide, v + rng.uniform(0, 0.7, n) * tall
            notes = rects(left, low, left + 0.25 * wide, low + 0.25 * tall)
            here.add(notes[: n // 2], pick(rng, SIGNS, 0.3))
            here.add(notes[n // 2 :], (0.9, 0.9, 0.88))
        else:
            _furniture(front.at(u, 0.0, layer=z), rng, kind, wide, height)
        u += wide + rng.exponential(1.6) + 0.15


def _door(here: Mesh, rng: Rng, wide: float, top: float, doors: Colour, trim: Colour) -> None:
    """Add a door in its frame, at times with a pane or a panel, and with a sign."""
    here.add(rects(-0.08, 0, wide + 0.08, top + 0.08), trim)
    colour = doors if rng.random() < 0.8 else pick(rng, _WOOD)
    here.add(rects(0, 0, wide, top), colour)
    look = rng.integers(3)
    if look == 1:
        here.add(rects(0.2, 1.2, wide - 0.2, top - 0.2), (0.25, 0.3, 0.33))
    elif look == 2:
        here.add(rects(0.1, 0.1, wide - 0.1, 0.9), 0.8 * colour)
    here.add(rects(wide - 0.15, 0.95, wide - 0.05, 1.05), (0.8, 0.8, 0.75))
    if rng.random() < 0.4:
        here.add(rects(wide + 0.15, 1.4, wide + 0.4, 1.6), pick(rng, SIGNS))


def _furniture(here: Mesh, rng: Rng, kind: str, wide: float, height: float) -> None:
    """Add what protrudes from the wall: a pillar, a cupboard, a bench, a pipe or a box."""
    colour = pick(rng, _WOOD + WALLS)
    if kind == "pillar":
        rect, out = (0, 0, rng.uniform(0.3, 0.7), height), rng.uniform(0.1, 0.5)
    elif kind == "cupboard":
        tall = rng.uniform(0.9, min(2.2, height - 0.1))
        rect, out = (0, 0, wide, tall), rng.uniform(0.3, 0.5)
    elif kind == "bench":
        rect, out = (0, 0.35, wide * 1.4, 0.5), 0.45
    elif kind == "pipe":
        rect, out = (0, 0, 0.12, height), 0.12
    else:
        v = rng.uniform(0.2, 1.4)
        rect = (0, v, rng.uniform(0.2, 0.6), v + rng.uniform(0.2, 0.7))
        out, colour = rng.uniform(0.08, 0.25), pick(rng, SIGNS, 0.2)
    here.boxes(rect, out, colour)
    if kind == "cupboard":
        here.add(bars(wide / 2, 0.02, 0.05, rect[3] - 0.05, 0.45), 0.6 * colour)


def _stand(foot: Mesh, rng: Rng) -> None:
    """Add a free-standing object: a table, a chair, a shelf, a plant or a lamp."""
    colour = pick(rng, _WOOD + SIGNS)
    half, deep, tall = rng.uniform(0.2, 0.9), rng.uniform(0.4, 1.2), rng.uniform(0.4, 0.8)
    kind = draw_kind(rng, table=0.35, chair=0.25, chest=0.2, plant=0.1, lamp=0.1)
    if kind == "table":
        legs = np.array((-half + 0.05, half - 0.05))
        foot.add(bars(legs, 0.03, 0, tall, deep), 0.7 * colour)
        foot.block((-half, tall, 0), (half, tall + 0.06, deep), colour)
        foot.add(bars(legs, 0.03, 0, tall), 0.7 * colour)
        if rng.random() < 0.5:
            u = rng.uniform(-half, 0.5 * half)
            foot.add(rects(u, tall, u + 0.4, tall + rng.uniform(0.1, 0.4), 0.2), pick(rng, SIGNS))
    elif kind == "chair":
        foot.block((-0.22, 0.35, 0), (0.22, 0.45, 0.45), colour)
        foot.add(bars(np.array((-0.19, 0.19)), 0.03, 0, 0.4), 0.7 * colour)
        foot.add(rects(-0.22, 0.4, 0.22, 0.95, rng.choice((0.0, 0.45))), 0.9 * colour)
    elif kind == "chest":
        foot.block((-half, 0, 0), (half, 2 * tall, deep / 2), colour)
        shelves = np.linspace(0, 2 * tall, int(rng.integers(2, 6)))[1:-1]
        foot.add(rects(-half, shelves - 0.02, half, shelves + 0.02), 0.6 * colour)
    elif kind == "plant":
        foot.add(bars(0, 0.15, 0, 0.3), colour)
        for x, y, radius in rng.uniform((-0.2, 0.5, 0.1), (0.2, 1.2, 0.3), (7, 3)):
            foot.add(discs(x, y, radius), (0.18, 0.34 * rng.uniform(0.7, 1.2), 0.16), Kind.NEEDLE)
    else:
        foot.add(bars(0, 0.02, 0, 1.5), (0.2, 0.2, 0.2))
        foot.add(bars(0, 0.2, 1.4, 1.7, top=0.12), (0.96, 0.92, 0.8), Kind.LAMP)


def _columns(mesh: Mesh, rng: Rng, box: _Box) -> None:
    """Add two rows of columns, or one."""
    stone, half = pick(rng, WALLS), rng.uniform(0.15, 0.45)
    rows = (box.left * 0.6, box.right * 0.6) if rng.random() < 0.7 else (box.right * 0.5,)
    for z in np.arange(box.length - 1, 3.0, -rng.uniform(2.5, 6.0)):
        for x in rows:
            mesh.at(x, z).block((-half, 0, 0), (half, box.height, 2 * half), stone)


def _hanging(mesh: Mesh, rng: Rng, box: _Box) -> None:
    """Add signs under the ceiling, and objects on the floor."""
    left, right, height, length = box
    for z in rng.uniform(4.0, length, int(rng.integers(0, 4))):
        x, wide = rng.uniform(left, right - 0.5), rng.uniform(0.3, 1.2)
        v = height - rng.uniform(0.4, 0.7)
        sign = rects(0, v, min(wide, right - x), v + rng.uniform(0.15, 0.35))
        colour, kind = pick(rng, SIGNS), Kind.LAMP if rng.random() < 0.3 else Kind.SOLID
        mesh.at(x, z).add(sign, colour, kind)
    for z in rng.uniform(3.0, length, int(rng.integers(0, 5))):
        edge = rng.uniform(0.1, 0.3) * (right - left)
        foot = mesh.at(left + edge if rng.random() < 0.5 else right - edge, z)
        colour = pick(rng, _WOOD + SIGNS)
        if rng.random() < 0.4:
            foot.add(discs(0, 0.8, rng.uniform(0.2, 0.4)), (0.18, 0.34, 0.16), Kind.NEEDLE)
        else:
            half, tall = rng.uniform(0.1, 0.35), rng.uniform(0.3, 1.1)
            foot.block((-half, 0, 0), (half, tall, 2 * half), colour)
