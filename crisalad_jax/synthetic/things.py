"""What stands in streets and fields: trees, lamps, wires, monuments."""

import numpy as np

from crisalad_jax.synthetic.materials import WALLS, Kind, pick, scaled
from crisalad_jax.synthetic.mesh import (
    TO_CAMERA,
    Mesh,
    Vector,
    block,
    discs,
    polygons,
    rectangles,
)


def tree(mesh: Mesh, rng: np.random.Generator, x: float, z: float) -> None:
    """Add a broad-leaved tree, bare in winter, or an evergreen conifer."""
    mesh.layer = z
    height = rng.uniform(4.5, 8.5)
    bark = (0.26, 0.21, 0.17)
    mesh.add(rectangles(x - 0.16, 0, x + 0.16, height * 0.6, z), bark, TO_CAMERA)
    if rng.random() < 0.2:
        for low, reach in ((0.2, 1.9), (0.44, 1.4), (0.68, 0.9)):
            y = height * low
            tier = polygons((x - reach, y, z), (x + reach, y, z), (x, y + height * 0.42, z))
            mesh.add(tier, (0.13, 0.26, 0.17), (0.0, 0.5, -0.85), Kind.NEEDLE)
        return
    n = 9
    angle = np.linspace(-1.1, 1.1, n) + rng.uniform(-0.12, 0.12, n)
    fork = height * rng.uniform(0.34, 0.6, n)
    length = height * rng.uniform(0.28, 0.46, n)
    tip_x, tip_y = x + np.sin(angle) * length, fork + np.cos(angle) * length
    mesh.add(polygons((x, fork, z), (x + 0.12, fork, z), (tip_x, tip_y, z)), bark, TO_CAMERA)
    middle_x, middle_y = (x + tip_x) / 2, (fork + tip_y) / 2
    twig_x, twig_y = middle_x + np.sin(angle * 0.3) * 0.9, middle_y + 1.0
    twigs = polygons((middle_x, middle_y, z), (middle_x + 0.08, middle_y, z), (twig_x, twig_y, z))
    mesh.add(twigs, bark, TO_CAMERA)
    hue = float(rng.random())
    for shade, lift, count in ((0.62, -0.25, 6), (0.85, 0.1, 6), (1.08, 0.45, 5)):
        across = height * 0.21 * (rng.normal(0, 0.62, count) - lift * 0.5)
        up = height * (0.72 + 0.21 * (rng.normal(0, 0.62, count) + lift))
        crown = discs(x + across, up, height * 0.21 * rng.uniform(0.5, 0.85, count), z)
        # Each disc is a part: inside a part, an even number of overlapping polygons leaves a hole.
        for disc in crown:
            mesh.add(disc[None], (hue, shade, 0.0), (0.0, 0.6, -0.8), Kind.LEAF)


def lamp(mesh: Mesh, x: float, z: float, height: float) -> Vector:
    """Add a street lamp with an arm over the street; return the position of its light."""
    mesh.layer = z
    tip = x + 1.3 if x < 0 else x - 1.3
    post = rectangles(x - 0.09, 0, x + 0.09, height, z)
    arm = rectangles(min(x, tip), height - 0.12, max(x, tip), height, z)
    mesh.add(np.concatenate((post, arm)), (0.20, 0.22, 0.22), TO_CAMERA)
    head = rectangles(tip - 0.35, height - 0.32, tip + 0.35, height - 0.08, z)
    mesh.add(head, (0.75, 0.74, 0.68), TO_CAMERA, Kind.LAMP)
    return (tip, height - 0.2, z)


def wires(mesh: Mesh, rng: np.random.Generator, x: float, length: float) -> None:
    """Add a line of poles with sagging wires."""
    height, gap = rng.uniform(7.0, 9.0), rng.uniform(14.0, 20.0)
    t = np.linspace(0, 1, 7)
    sag = height - 0.6 - 3.2 * t * (1 - t)
    y0, y1 = sag[:-1], sag[1:]
    for z in np.arange(rng.uniform(4.0, 12.0), length, gap):
        mesh.layer = float(z)
        pole = rectangles(x - 0.13, 0, x + 0.13, height, z)
        bar = rectangles(x - 0.9, height - 0.8, x + 0.9, height - 0.65, z)
        mesh.add(np.concatenate((pole, bar)), (0.30, 0.25, 0.21), TO_CAMERA)
        z0, z1 = z + t[:-1] * gap, z + t[1:] * gap
        for end in (x - 0.8, x + 0.8):
            wire = polygons(
                (end, y0, z0), (end, y1, z1), (end, y1 + 0.04, z1), (end, y0 + 0.04, z0)
            )
            mesh.add(wire, (0.12, 0.12, 0.13), TO_CAMERA)


def monument(mesh: Mesh, rng: np.random.Generator, x: float, z: float) -> None:
    """Add a column with a ball, or an obelisk, on a plinth in the street."""
    mesh.layer = z
    stone = pick(rng, WALLS[2:9])
    block(mesh, (x - 1.5, 0.0, z), (x + 1.5, 0.9, z + 3.0), stone)
    height, half = rng.uniform(3.0, 9.0), rng.uniform(0.35, 0.9)
    if rng.random() < 0.5:
        block(
            mesh, (x - half, 0.9, z + 1), (x + half, height, z + 1 + 2 * half), scaled(stone, 0.9)
        )
        mesh.add(discs(x, height + 0.7, 0.8, z + 1), (0.35, 0.40, 0.36), (0.0, 0.5, -0.85))
    else:
        obelisk = polygons(
            (x - half, 0.9, z), (x + half, 0.9, z), (x + 0.15, height, z), (x - 0.15, height, z)
        )
        mesh.add(obelisk, scaled(stone, 0.9), TO_CAMERA)
