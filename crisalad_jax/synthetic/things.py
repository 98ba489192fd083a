"""Build objects and passers-by: trees, lamps, wires, monuments, vehicles and people."""

import functools

import numpy as np

from crisalad_jax.synthetic.mesh import (
    SIGNS,
    SLANTED,
    UP,
    WALLS,
    Kind,
    Lanes,
    Mesh,
    Rng,
    Scene,
    bars,
    discs,
    flat,
    palette,
    pick,
    polygons,
    rects,
    sheets,
    triangles,
)

_PAINT = palette("75 75 76, 16 17 19, 55 12 11, 15 25 45, 84 83 80, 40 42 44, 24 36 28")
_TYRE = (0.05, 0.05, 0.05)
_TINTED = (0.10, 0.12, 0.14)


def tree(mesh: Mesh, rng: Rng, x: float, z: float) -> None:
    """Add a broad-leaved tree, bare in winter, or an evergreen conifer, at (x, z)."""
    mesh = mesh.at(x, z)
    height = rng.uniform(4.5, 8.5)
    bark = (0.26, 0.21, 0.17)
    mesh.add(bars(0, 0.16, 0, height * 0.6), bark)
    if rng.random() < 0.2:
        for low, reach in ((0.2, 1.9), (0.44, 1.4), (0.68, 0.9)):
            y = height * low
            tier = triangles(-reach, reach, y, 0, y + height * 0.42)
            mesh.add(tier, (0.13, 0.26, 0.17), Kind.NEEDLE, SLANTED)
        return
    n = 9
    angle = np.linspace(-1.1, 1.1, n) + rng.uniform(-0.12, 0.12, n)
    fork = height * rng.uniform(0.34, 0.6, n)
    length = height * rng.uniform(0.28, 0.46, n)
    tip_x, tip_y = np.sin(angle) * length, fork + np.cos(angle) * length
    mesh.add(triangles(0, 0.12, fork, tip_x, tip_y), bark)
    u, v = tip_x / 2, (fork + tip_y) / 2
    mesh.add(triangles(u, u + 0.08, v, u + np.sin(angle * 0.3) * 0.9, v + 1.0), bark)
    hue = float(rng.random())
    for shade, lift, count in ((0.62, -0.25, 6), (0.85, 0.1, 6), (1.08, 0.45, 5)):
        across = height * 0.21 * (rng.normal(0, 0.62, count) - lift * 0.5)
        up = height * (0.72 + 0.21 * (rng.normal(0, 0.62, count) + lift))
        crown = discs(across, up, height * 0.21 * rng.uniform(0.5, 0.85, count))
        # Each disc is a part: inside a part, an even number of overlapping polygons leaves a hole.
        for disc in crown:
            mesh.add(disc[None], (hue, shade, 0.0), Kind.LEAF, (0.0, 0.6, -0.8))


def lamp(mesh: Mesh, x: float, z: float, height: float) -> None:
    """Add a street lamp of this height in metres, with an arm over the street, at (x, z)."""
    mesh = mesh.at(x, z)
    tip = 1.3 if x < 0 else -1.3
    arm = bars(tip / 2, 0.65, height - 0.12, height)
    mesh.add(np.concatenate((bars(0, 0.09, 0, height), arm)), (0.20, 0.22, 0.22))
    mesh.add(bars(tip, 0.35, height - 0.32, height - 0.08), (0.75, 0.74, 0.68), Kind.LAMP)
    mesh.lamps.append((x + tip, height - 0.2, z))


def wires(mesh: Mesh, rng: Rng, x: float, length: float) -> None:
    """Add a line of poles with sagging wires at x, for `length` metres along the street."""
    height, gap = rng.uniform(7.0, 9.0), rng.uniform(14.0, 20.0)
    t = np.linspace(0, 1, 7)
    sag = height - 0.6 - 3.2 * t * (1 - t)
    y0, y1 = sag[:-1], sag[1:]
    z0, z1 = t[:-1] * gap, t[1:] * gap
    for z in np.arange(rng.uniform(4.0, 12.0), length, gap):
        pole = mesh.at(x, z)
        bar = bars(0, 0.9, height - 0.8, height - 0.65)
        pole.add(np.concatenate((bars(0, 0.13, 0, height), bar)), (0.30, 0.25, 0.21))
        for u in (-0.8, 0.8):
            wire = polygons((u, y0, z0), (u, y1, z1), (u, y1 + 0.04, z1), (u, y0 + 0.04, z0))
            pole.add(wire, (0.12, 0.12, 0.13))


def monument(mesh: Mesh, rng: Rng, x: float, z: float) -> None:
    """Add a column with a ball, or an obelisk, on a plinth in the street at (x, z)."""
    mesh = mesh.at(x, z)
    stone = pick(rng, WALLS[2:9])
    mesh.block((-1.5, 0.0, 0.0), (1.5, 0.9, 3.0), stone)
    height, half = rng.uniform(3.0, 9.0), rng.uniform(0.35, 0.9)
    stone = 0.9 * stone
    if rng.random() < 0.5:
        mesh.block((-half, 0.9, 1), (half, height, 1 + 2 * half), stone)
        mesh.add(discs(0, height + 0.7, 0.8, 1), (0.35, 0.40, 0.36), normal=SLANTED)
    else:
        mesh.add(bars(0, half, 0.9, height, top=0.15), stone)


@functools.lru_cache(maxsize=8)
def build_passers(seed: int, lanes: Lanes, traffic: bool, crowd: int = 0) -> Scene:
    """Build parked cars, moving traffic, people on the pavements, and `crowd` more people.

    Without traffic there are only people; one is far away, so that there is always somebody.
    """
    rng = np.random.default_rng((seed, 1))
    mesh = Mesh()
    left, *_, right = lanes
    if not traffic:
        for z in (120.0, *rng.uniform(3.0, 20.0, int(rng.integers(0, 3)))):
            _person(mesh, rng, rng.uniform(left * 0.8, right * 0.8), z)
    else:
        _traffic(mesh, rng, lanes)
    for z in rng.uniform(2.5, 15.0, crowd):
        _person(mesh, rng, rng.uniform(left * 0.9, right * 0.9), z)
    return mesh.scene()


def _traffic(mesh: Mesh, rng: Rng, lanes: Lanes) -> None:
    """Add cars along the kerbs, traffic in the lanes, and people on the pavements."""
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


def _vehicle(mesh: Mesh, rng: Rng, x: float, z: float, *, bus: bool, away: bool) -> None:
    """Add a car or a bus in its lane; the camera sees its rear if it drives away."""
    paint = pick(rng, SIGNS if bus else _PAINT)
    half, length, height = (1.25, 10.5, 3.0) if bus else (0.9, 4.3, 0.95)
    mesh = mesh.at(x, z)
    mesh.layer += 0.01
    mesh.add(flat(-half - 0.2, -0.2, half + 0.2, length), (0.1, 0.1, 0.1), normal=UP)
    near = np.array((-half, half - 0.3))
    mesh.add(rects(near, 0, near + 0.3, 0.5, 0.1), _TYRE)
    mesh.block((-half, 0.3, 0), (half, height, length), paint)
    side = -1.0 if x < 0 else 1.0
    flank = mesh.front(-side * half, 0, side)
    if bus:
        u = 0.5 + 2.0 * np.arange(5)
        flank.add(rects(u, 1.4, u + 1.7, 2.5), _TINTED, Kind.SHOP)
        mesh.add(bars(0, 1.05, 1.3, 2.6), _TINTED, Kind.SHOP)
    else:
        mesh.block((-0.74, 0.95, 0.7), (0.74, 1.5, 3.2), paint)
        mesh.add(bars(0, 0.65, 1.0, 1.42, 0.7), _TINTED)
        u = np.array((0.5, 3.1))
        flank.add(rects(u, 0, u + 0.6, 0.6), _TYRE)
    red, white = ((0.55, 0.08, 0.06), Kind.TAILLIGHT), ((0.90, 0.90, 0.82), Kind.HEADLIGHT)
    mesh.add(rects(near + 0.02, 0.6, near + 0.28, 0.85), *(red if away else white))


def _person(mesh: Mesh, rng: Rng, x: float, z: float) -> None:
    mesh = mesh.at(x, z)
    tall, stride = rng.uniform(0.9, 1.08), rng.uniform(0.05, 0.3)
    hip, foot = np.array((-0.1, 0.1)), np.array((-stride, stride))
    legs = sheets(foot - 0.08, 0, foot + 0.08, 0, 0, 0.85 * tall, hip - foot)
    mesh.add(legs, pick(rng, _PAINT[1:4]))
    mesh.add(bars(0, 0.26, 0.8 * tall, 1.48 * tall), pick(rng, SIGNS, 0.3))
    mesh.add(discs(0, 1.63 * tall, 0.13), (0.62, 0.47, 0.38))
