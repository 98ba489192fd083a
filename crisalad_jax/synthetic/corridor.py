"""One place indoors: a corridor, a hall or a tunnel, with all that stands and hangs in it."""

import numpy as np

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
    Number,
    block,
    discs,
    flat,
    polygons,
    rectangles,
)
from crisalad_jax.synthetic.place import Place, Reach

_EYE = 1.2
_DOWN = (0.0, -1.0, 0.0)
_START = -4.0
"""Metres along the corridor at which its walls begin, behind every camera."""
_WOOD: tuple[Colour, ...] = (
    (0.50, 0.34, 0.20),
    (0.36, 0.23, 0.14),
    (0.66, 0.52, 0.36),
    (0.75, 0.75, 0.72),
    (0.30, 0.38, 0.46),
    (0.55, 0.20, 0.17),
)
_FLOORS: tuple[Colour, ...] = (
    (0.40, 0.40, 0.41),
    (0.55, 0.52, 0.47),
    (0.30, 0.31, 0.36),
    (0.62, 0.60, 0.57),
    (0.42, 0.27, 0.20),
    (0.24, 0.26, 0.24),
)


def corridor(rng: np.random.Generator) -> Place:
    """Build a corridor; one in four is a wide hall with columns."""
    mesh = Mesh(_EYE)
    hall = rng.random() < 0.25
    width = rng.uniform(5.0, 16.0) if hall else rng.uniform(1.5, 4.2)
    height = rng.uniform(3.0, 8.0) if hall else rng.uniform(2.2, 3.4)
    length = rng.uniform(14.0, 50.0)
    left = -width * rng.uniform(0.3, 0.7)
    right = left + width
    walls = [pick(rng, WALLS), pick(rng, WALLS)]
    if rng.random() < 0.7:
        walls[1] = walls[0]
    band = rng.uniform(0.8, 1.4) if rng.random() < 0.4 else 0.0
    dado = pick(rng, WALLS)
    skirting = scaled(pick(rng, _WOOD), 0.8)

    _floor(mesh, rng, left, right, length)
    _ceiling(mesh, rng, left, right, height, length)
    _end(mesh, rng, left, right, height, length, pick(rng, WALLS))
    for x, wall in ((left, walls[0]), (right, walls[1])):
        side = _wall(mesh, x)
        mesh.layer = GROUND_LAYER - 10
        side.add(rectangles(_START, 0, length, height), wall)
        _stains(side, rng, wall, height, length)
        if band:
            side.add(rectangles(_START, 0, length, band), dado)
            side.add(rectangles(_START, band, length, band + 0.06), skirting)
        side.add(rectangles(_START, 0, length, 0.12), skirting)
        _along_wall(mesh, side, rng, x, height, length)
    if hall or rng.random() < 0.15:
        _columns(mesh, rng, left, right, height, length)
    if rng.random() < 0.5:
        _hanging(mesh, rng, left, right, height, length)
    reach = Reach(
        height=(0.5, min(1.9, height - 0.4)),
        lateral=min(0.8, 0.12 * width),
        forward=0.3,
        step=float(rng.uniform(1.2, 2.5)),
    )
    heading = float(rng.uniform(-12, 12))
    lanes = (left, left, right, right)
    return Place(
        mesh.scene(),
        np.zeros((0, 3)),
        (),
        0.0,
        heading,
        lanes,
        np.zeros(96),
        reach,
        indoors=True,
        traffic=False,
    )


def _wall(mesh: Mesh, x: float) -> Front:
    normal = (1.0 if x < 0 else -1.0, 0.0, 0.0)
    return Front(mesh, (x, 0.0, 0.0), (0.0, 0.0, 1.0), normal, sees_start=True)


def _level(x0: Number, z0: Number, x1: Number, z1: Number, y: float) -> np.ndarray:
    return polygons((x0, y, z0), (x1, y, z0), (x1, y, z1), (x0, y, z1))


def _floor(mesh: Mesh, rng: np.random.Generator, left: float, right: float, length: float) -> None:
    """Add the floor, with tiles, a carpet, planks or spots."""
    colour = pick(rng, _FLOORS)
    mesh.layer = GROUND_LAYER
    mesh.add(flat(left, _START, right, length), colour, UP)
    kind = rng.choice(("plain", "tiles", "carpet", "boards", "checks"), p=(0.2, 0.3, 0.2, 0.1, 0.2))
    mesh.layer = GROUND_LAYER - 1
    if kind == "tiles":
        size, line = rng.uniform(0.3, 1.2), rng.uniform(0.01, 0.03)
        shade = scaled(colour, rng.choice((0.75, 1.25)))
        z, x = np.arange(_START, length, size), np.arange(left, right, size)
        mesh.add(flat(left, z - line, right, z + line), shade, UP)
        mesh.add(flat(x - line, _START, x + line, length), shade, UP)
    elif kind == "carpet":
        inset = rng.uniform(0.1, 0.3) * (right - left)
        mesh.add(flat(left + inset, _START, right - inset, length), pick(rng, SIGNS, 0.3), UP)
        if rng.random() < 0.5:
            edge = np.array((left + inset, right - inset - 0.08))
            mesh.add(flat(edge, _START, edge + 0.08, length), pick(rng, SIGNS, 0.3), UP)
    elif kind == "boards":
        x = np.arange(left, right, rng.uniform(0.15, 0.4))
        mesh.add(flat(x[::2], _START, x[::2] + 0.1, length), scaled(colour, 0.88), UP)
    elif kind == "checks":
        size = rng.uniform(0.3, 1.0)
        x, z = np.meshgrid(np.arange(left, right, size), np.arange(_START, length, size))
        odd = (np.indices(x.shape).sum(0) % 2).astype(bool)
        x, z = x[odd], z[odd]
        mesh.add(
            flat(x, z, np.minimum(x + size, right), z + size),
            scaled(colour, rng.uniform(0.5, 0.9)),
            UP,
        )
    count = int(rng.integers(0, 14))
    x, z = rng.uniform(left, right - 0.3, count), rng.uniform(0, length, count)
    size = rng.uniform(0.1, 0.6, count)
    spots = flat(x, z, np.minimum(x + size, right), z + size * rng.uniform(0.5, 2.0))
    mesh.add(spots, scaled(colour, rng.uniform(0.6, 1.3)), UP)


def _ceiling(
    mesh: Mesh, rng: np.random.Generator, left: float, right: float, height: float, length: float
) -> None:
    """Add the ceiling: plain, of panels, with beams, pipes or a skylight; and its lamps."""
    colour = pick(
        rng, ((0.86, 0.85, 0.82), (0.72, 0.72, 0.70), (0.60, 0.56, 0.50), (0.3, 0.3, 0.3))
    )
    mesh.layer = GROUND_LAYER
    mesh.add(_level(left, _START, right, length, height), colour, _DOWN)
    mesh.layer = GROUND_LAYER - 1
    if rng.random() < 0.45:
        size = rng.uniform(0.5, 1.3)
        z, x = np.arange(_START, length, size), np.arange(left, right, size)
        shade = scaled(colour, rng.uniform(0.7, 0.9))
        mesh.add(_level(left, z - 0.015, right, z + 0.015, height), shade, _DOWN)
        mesh.add(_level(x - 0.015, _START, x + 0.015, length, height), shade, _DOWN)
    middle = (left + right) / 2
    kind = rng.choice(("panels", "strip", "points", "none"), p=(0.45, 0.2, 0.2, 0.15))
    gap, start = rng.uniform(1.8, 5.0), rng.uniform(0.0, 3.0)
    z = np.arange(start, length, gap)
    rows = (middle,) if right - left < 6 else tuple(np.linspace(left, right, 4)[1:3])
    bright = (0.96, 0.96, 0.92)
    for x in rows:
        if kind == "panels":
            w, d = rng.uniform(0.15, 0.7), rng.uniform(0.3, 0.7)
            mesh.add(_level(x - w, z - d, x + w, z + d, height), bright, _DOWN, Kind.LAMP)
        elif kind == "strip":
            strip = _level(x - 0.07, z, x + 0.07, z + gap * 0.7, height)
            mesh.add(strip, bright, _DOWN, Kind.LAMP)
        elif kind == "points":
            z2 = np.arange(start, length, gap / 2)
            mesh.add(_level(x - 0.1, z2 - 0.1, x + 0.1, z2 + 0.1, height), bright, _DOWN, Kind.LAMP)
    if rng.random() < 0.25:
        depth = rng.uniform(0.15, 0.6)
        for at in np.arange(length - rng.uniform(0.5, 2), 0, -rng.uniform(2.0, 5.0)):
            mesh.layer = float(at)
            beam = rectangles(left, height - depth, right, height, at)
            mesh.add(beam, scaled(colour, 0.8), TO_CAMERA)
            under = _level(left, at, right, at + 0.3, height - depth)
            mesh.add(under, scaled(colour, 0.9), _DOWN)
    if rng.random() < 0.3:
        mesh.layer = GROUND_LAYER - 5
        for _ in range(int(rng.integers(1, 4))):
            x, r = rng.uniform(left + 0.1, right - 0.2), rng.uniform(0.04, 0.15)
            pipe = pick(rng, SIGNS + WALLS)
            mesh.add(_level(x - r, _START, x + r, length, height - 0.25), pipe, _DOWN)


def _end(
    mesh: Mesh,
    rng: np.random.Generator,
    left: float,
    right: float,
    height: float,
    length: float,
    wall: Colour,
) -> None:
    """Add what closes the corridor: a wall, a door, a window, or a way on."""
    mesh.layer = GROUND_LAYER - 8
    mesh.add(rectangles(left, 0, right, height, length), wall, TO_CAMERA)
    mesh.layer = GROUND_LAYER - 9
    middle, half = rng.uniform(0.3, 0.7) * (right - left) + left, rng.uniform(0.2, 0.45)
    half *= min(right - left, 3.0)
    kind = rng.choice(("wall", "door", "window", "way"), p=(0.2, 0.35, 0.2, 0.25))
    low, high = max(left, middle - half), min(right, middle + half)
    if kind == "door":
        door = pick(rng, _WOOD)
        top = min(2.1, height - 0.1)
        mesh.add(
            rectangles(low - 0.08, 0, high + 0.08, top + 0.08, length), scaled(door, 0.7), TO_CAMERA
        )
        mesh.add(rectangles(low, 0, high, top, length), door, TO_CAMERA)
        if rng.random() < 0.5:
            pane = rectangles(low + 0.15, 1.1, high - 0.15, top - 0.15, length)
            mesh.add(pane, (0.8, 0.85, 0.9), TO_CAMERA, Kind.WINDOW)
    elif kind == "window":
        sill, top = rng.uniform(0.0, 1.2), height - rng.uniform(0.1, 0.6)
        mesh.add(rectangles(low, sill, high, top, length), (1.0, 1.0, 1.0), TO_CAMERA, Kind.WINDOW)
        bars = np.linspace(low, high, int(rng.integers(2, 6)))
        mesh.add(rectangles(bars - 0.03, sill, bars + 0.03, top, length), wall, TO_CAMERA)
    elif kind == "way":
        shade = rng.uniform(0.15, 1.2)
        mesh.add(rectangles(low, 0, high, height * 0.9, length), scaled(wall, shade), TO_CAMERA)
        inner = rectangles(low + 0.2 * half, 0, high - 0.3 * half, height * 0.75, length)
        mesh.add(inner, scaled(wall, shade * rng.uniform(0.5, 1.5)), TO_CAMERA)


def _stains(
    side: Front, rng: np.random.Generator, wall: Colour, height: float, length: float
) -> None:
    """Add bricks, panels or spots to a wall."""
    kind = rng.choice(("none", "bricks", "panels", "spots"), p=(0.4, 0.15, 0.2, 0.25))
    if kind == "bricks":
        n = 260
        u, v = rng.uniform(_START, length, n), rng.integers(0, int(height / 0.2), n) * 0.2
        bricks = rectangles(u, v, u + rng.uniform(0.3, 0.5), np.minimum(v + 0.18, height))
        side.add(bricks[: n // 2], scaled(wall, 0.82))
        side.add(bricks[n // 2 :], scaled(wall, 1.15))
    elif kind == "panels":
        u = np.arange(_START, length, rng.uniform(0.8, 2.5))
        side.add(rectangles(u - 0.02, 0, u + 0.02, height), scaled(wall, 0.7))
    elif kind == "spots":
        n = 30
        u, v = rng.uniform(_START, length, n), rng.uniform(0, height * 0.9, n)
        size = rng.uniform(0.1, 0.7, n)
        spots = rectangles(u, v, u + size, np.minimum(v + size * rng.uniform(0.3, 2), height))
        side.add(spots, scaled(wall, rng.uniform(0.75, 1.2)))


def _along_wall(
    mesh: Mesh, side: Front, rng: np.random.Generator, x: float, height: float, length: float
) -> None:
    """Add doors, windows, boards and furniture along one wall, each at its place."""
    doors, trim = pick(rng, _WOOD), scaled(pick(rng, _WOOD), 0.9)
    # What recurs in this corridor; the distances, and what comes between, make the place.
    kinds = np.array(
        (
            "door",
            "recess",
            "window",
            "board",
            "pillar",
            "cupboard",
            "bench",
            "box",
            "opening",
            "pipe",
        )
    )
    weights = rng.dirichlet(np.full(len(kinds), 0.7))
    z = _START + rng.uniform(0.0, 2.0)
    while z < length - 1.2:
        kind = rng.choice(kinds, p=weights)
        mesh.layer = GROUND_LAYER - 20 - z * 1e-3
        wide = rng.uniform(0.75, 1.1)
        top = min(2.1, height - 0.15)
        if kind == "door":
            side.add(rectangles(z - 0.08, 0, z + wide + 0.08, top + 0.08), trim)
            colour = doors if rng.random() < 0.8 else pick(rng, _WOOD)
            side.add(rectangles(z, 0, z + wide, top), colour)
            look = rng.integers(3)
            if look == 1:
                side.add(rectangles(z + 0.2, 1.2, z + wide - 0.2, top - 0.2), (0.25, 0.3, 0.33))
            elif look == 2:
                side.add(rectangles(z + 0.1, 0.1, z + wide - 0.1, 0.9), scaled(colour, 0.8))
            side.add(rectangles(z + wide - 0.15, 0.95, z + wide - 0.05, 1.05), (0.8, 0.8, 0.75))
            if rng.random() < 0.4:
                side.add(rectangles(z + wide + 0.15, 1.4, z + wide + 0.4, 1.6), pick(rng, SIGNS))
        elif kind == "recess":
            side.add(rectangles(z, 0, z + wide * 1.4, top), scaled(trim, 0.5))
            side.add(rectangles(z + 0.35, 0, z + wide * 1.4, top), doors)
        elif kind == "opening":
            wide *= 1.8
            side.add(rectangles(z, 0, z + wide, top * 1.05), (0.12, 0.12, 0.13))
            inner = rng.uniform(0.2, 0.9)
            side.add(
                rectangles(z + wide * 0.5, 0, z + wide, top * 1.05), scaled((0.8, 0.8, 0.76), inner)
            )
        elif kind == "window":
            wide *= rng.uniform(1.0, 2.0)
            sill, high = rng.uniform(0.5, 1.2), height - rng.uniform(0.2, 0.7)
            side.add(rectangles(z - 0.08, sill - 0.1, z + wide + 0.08, high + 0.08), trim)
            side.add(rectangles(z, sill, z + wide, high), (1.0, 1.0, 1.0), Kind.WINDOW)
            bars = np.linspace(z, z + wide, int(rng.integers(1, 4)) + 1)[1:-1]
            side.add(rectangles(bars - 0.03, sill, bars + 0.03, high), trim)
        elif kind == "board":
            v, tall = rng.uniform(1.0, 1.5), rng.uniform(0.3, 0.9)
            wide *= rng.uniform(0.5, 1.8)
            paper = pick(rng, SIGNS + WALLS, 0.2)
            side.add(rectangles(z, v, z + wide, v + tall), paper)
            n = int(rng.integers(0, 9))
            u, w = z + rng.uniform(0, 0.7, n) * wide, v + rng.uniform(0, 0.7, n) * tall
            notes = rectangles(u, w, u + 0.25 * wide, w + 0.25 * tall)
            side.add(notes[: n // 2], pick(rng, SIGNS, 0.3))
            side.add(notes[n // 2 :], (0.9, 0.9, 0.88))
        else:
            mesh.layer = z
            colour = pick(rng, _WOOD + WALLS)
            if kind == "pillar":
                side.boxes(
                    (z, 0.0, z + rng.uniform(0.3, 0.7), height), rng.uniform(0.1, 0.5), colour
                )
            elif kind == "cupboard":
                tall = rng.uniform(0.9, min(2.2, height - 0.1))
                side.boxes((z, 0.0, z + wide, tall), rng.uniform(0.3, 0.5), colour)
                front = rectangles(
                    z + wide / 2 - 0.02, 0.05, z + wide / 2 + 0.02, tall - 0.05, 0.45
                )
                side.add(front, scaled(colour, 0.6))
            elif kind == "bench":
                side.boxes((z, 0.35, z + wide * 1.4, 0.5), 0.45, colour)
            elif kind == "pipe":
                side.boxes((z, 0.0, z + 0.12, height), 0.12, colour)
            else:
                v = rng.uniform(0.2, 1.4)
                box = (z, v, z + rng.uniform(0.2, 0.6), v + rng.uniform(0.2, 0.7))
                side.boxes(box, rng.uniform(0.08, 0.25), pick(rng, SIGNS, 0.2))
        z += wide + rng.exponential(1.6) + 0.15


def _columns(
    mesh: Mesh, rng: np.random.Generator, left: float, right: float, height: float, length: float
) -> None:
    """Add two rows of columns, or one."""
    stone, half = pick(rng, WALLS), rng.uniform(0.15, 0.45)
    rows = (left * 0.6, right * 0.6) if rng.random() < 0.7 else (right * 0.5,)
    for z in np.arange(length - 1, 3.0, -rng.uniform(2.5, 6.0)):
        for x in rows:
            mesh.layer = float(z)
            block(mesh, (x - half, 0, z), (x + half, height, z + 2 * half), stone)


def _hanging(
    mesh: Mesh, rng: np.random.Generator, left: float, right: float, height: float, length: float
) -> None:
    """Add signs under the ceiling, and things that stand about on the floor."""
    for z in rng.uniform(4.0, length, int(rng.integers(0, 4))):
        mesh.layer = float(z)
        x, wide = rng.uniform(left, right - 0.5), rng.uniform(0.3, 1.2)
        v = height - rng.uniform(0.4, 0.7)
        sign = rectangles(x, v, min(x + wide, right), v + rng.uniform(0.15, 0.35), float(z))
        mesh.add(sign, pick(rng, SIGNS), TO_CAMERA, Kind.LAMP if rng.random() < 0.3 else Kind.SOLID)
    for z in rng.uniform(3.0, length, int(rng.integers(0, 5))):
        edge = rng.uniform(0.1, 0.3) * (right - left)
        x = left + edge if rng.random() < 0.5 else right - edge
        mesh.layer = float(z)
        colour = pick(rng, _WOOD + SIGNS)
        if rng.random() < 0.4:
            mesh.add(
                discs(x, 0.8, rng.uniform(0.2, 0.4), float(z)),
                (0.18, 0.34, 0.16),
                TO_CAMERA,
                Kind.NEEDLE,
            )
        else:
            half, tall = rng.uniform(0.1, 0.35), rng.uniform(0.3, 1.1)
            block(mesh, (x - half, 0, z), (x + half, tall, z + 2 * half), colour)
