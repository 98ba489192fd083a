"""Traffic in a place: cars, buses and people, drawn from a seed of their own."""

import functools

import numpy as np

from crisalad_jax.synthetic.materials import SIGNS, Colour, Kind, pick
from crisalad_jax.synthetic.mesh import (
    TO_CAMERA,
    UP,
    Front,
    Mesh,
    Scene,
    block,
    discs,
    flat,
    polygons,
    rectangles,
)

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


@functools.lru_cache(maxsize=8)
def build_passers(
    seed: int, lanes: tuple[float, float, float, float], *, traffic: bool = True
) -> Scene:
    """Build cars along the kerbs, traffic in the lanes, and people on the pavements.

    Without traffic there are people alone; one is far away, so that there is somebody.
    """
    rng = np.random.default_rng((seed, 1))
    mesh = Mesh()
    left, left_kerb, right_kerb, right = lanes
    if not traffic:
        for z in (120.0, *rng.uniform(3.0, 20.0, int(rng.integers(0, 3)))):
            _person(mesh, rng, rng.uniform(left * 0.8, right * 0.8), z)
        return mesh.scene()
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


def _vehicle(
    mesh: Mesh, rng: np.random.Generator, x: float, z: float, *, bus: bool, away: bool
) -> None:
    """Add a car or a bus in its lane; the camera sees its rear if it drives away."""
    paint = pick(rng, SIGNS if bus else _PAINT)
    half, length, height = (1.25, 10.5, 3.0) if bus else (0.9, 4.3, 0.95)
    mesh.layer = z + 0.01
    shadow = flat(x - half - 0.2, z - 0.2, x + half + 0.2, z + length)
    mesh.add(shadow, (0.1, 0.1, 0.1), UP)
    near = np.array((x - half, x + half - 0.3))
    mesh.add(rectangles(near, 0, near + 0.3, 0.5, z + 0.1), _TYRE, TO_CAMERA)
    block(mesh, (x - half, 0.3, z), (x + half, height, z + length), paint)
    flank = Front(
        mesh,
        (x + half if x < 0 else x - half, 0.0, z),
        (0.0, 0.0, 1.0),
        (1.0 if x < 0 else -1.0, 0.0, 0.0),
        sees_start=True,
    )
    if bus:
        u = 0.5 + 2.0 * np.arange(5)
        flank.add(rectangles(u, 1.4, u + 1.7, 2.5), _TINTED, Kind.SHOP)
        mesh.add(rectangles(x - 1.05, 1.3, x + 1.05, 2.6, z), _TINTED, TO_CAMERA, Kind.SHOP)
    else:
        block(mesh, (x - 0.74, 0.95, z + 0.7), (x + 0.74, 1.5, z + 3.2), paint)
        mesh.add(rectangles(x - 0.65, 1.0, x + 0.65, 1.42, z + 0.7), _TINTED, TO_CAMERA)
        u = np.array((0.5, 3.1))
        flank.add(rectangles(u, 0, u + 0.6, 0.6), _TYRE)
    lights = rectangles(near + 0.02, 0.6, near + 0.28, 0.85, z)
    if away:
        mesh.add(lights, (0.55, 0.08, 0.06), TO_CAMERA, Kind.TAILLIGHT)
    else:
        mesh.add(lights, (0.90, 0.90, 0.82), TO_CAMERA, Kind.HEADLIGHT)


def _person(mesh: Mesh, rng: np.random.Generator, x: float, z: float) -> None:
    mesh.layer = z
    tall, stride = rng.uniform(0.9, 1.08), rng.uniform(0.05, 0.3)
    hip, foot = np.array((-0.1, 0.1)) + x, np.array((-stride, stride)) + x
    legs = polygons(
        (hip + 0.08, 0.85 * tall, z),
        (hip - 0.08, 0.85 * tall, z),
        (foot - 0.08, 0.0, z),
        (foot + 0.08, 0.0, z),
    )
    mesh.add(legs, pick(rng, _PAINT[1:4]), TO_CAMERA)
    coat = rectangles(x - 0.26, 0.8 * tall, x + 0.26, 1.48 * tall, z)
    mesh.add(coat, pick(rng, SIGNS, 0.3), TO_CAMERA)
    mesh.add(discs(x, 1.63 * tall, 0.13, z), (0.62, 0.47, 0.38), TO_CAMERA)
