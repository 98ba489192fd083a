"""Build one place of meaningless boxes, poles and sheets, with patterns on them.

In streets and rooms, a model may learn to rely on windows and doors. Here all shapes, sizes and
colours are random (after "dead leaves", Baradad et al. 2021, but in 3D).
"""

import numpy as np

from crisalad_jax.synthetic.mesh import (
    Colour,
    Kind,
    Mesh,
    Place,
    Reach,
    Rng,
    bars,
    discs,
    draw_hills,
    draw_kind,
    flat,
    rects,
    triangles,
)
from crisalad_jax.synthetic.things import tree


def shapes(rng: Rng) -> Place:
    """Build a random place of shapes on a ground of patches."""
    mesh = Mesh()
    half = rng.uniform(2.0, 8.0)
    colours = [_colour(rng) for _ in range(int(rng.integers(3, 9)))]
    _ground(mesh, rng, colours)
    for z in sorted(3.0 + rng.exponential(18.0, int(rng.integers(15, 60))), reverse=True):
        side = float(rng.choice((-1, 1)))
        x = side * (half + rng.exponential(0.3 * z + 1.0))
        if rng.random() < 0.08 and z > 15:
            x = rng.uniform(-half, half)
        size = np.exp(rng.uniform(np.log(0.4), np.log(3.0 + 0.12 * z)))
        _shape(mesh.at(x, z), rng, colours, size, side)
    for z in rng.uniform(5.0, 40.0, int(rng.integers(0, 4))):
        tree(mesh, rng, float(rng.choice((-1, 1))) * (half + rng.uniform(0.5, 9.0)), z)
    lanes = (-half - 2.0, -half, half, half + 2.0)
    reach = Reach(height=(0.6, 3.2), lateral=1.2, forward=2.0, step=rng.uniform(5.0, 9.0))
    bearing, heading = float(rng.uniform(0, 360)), float(rng.uniform(-20, 20))
    hills = draw_hills(rng, 0.4)
    return Place(mesh.scene(), heading, lanes, reach, bearing, hills, mesh.bodies, traffic=half > 5)


def _colour(rng: Rng) -> Colour:
    """Draw a colour, more often greyish than saturated."""
    grey, saturation = rng.uniform(0.08, 0.9), rng.random() ** 2
    return np.clip(grey * (1 + saturation * rng.uniform(-1, 1, 3)), 0.03, 0.95)


def _ground(mesh: Mesh, rng: Rng, colours: list[Colour]) -> None:
    """Add a ground with patches and stripes."""
    mesh.ground(flat(-900, -20, 900, 2500), _colour(rng), Kind.SOIL)
    for _ in range(int(rng.integers(4, 20))):
        z = rng.exponential(20.0)
        x, wide = rng.uniform(-1, 1) * (4 + z), rng.uniform(0.5, 3 + 0.5 * z)
        patch = flat(x, z, x + wide, z + rng.uniform(0.5, 4 + 0.5 * z))
        mesh.ground(patch, _some(rng, colours), Kind.ROAD)
    if rng.random() < 0.5:
        x, gap = rng.uniform(-4, 2), rng.uniform(0.6, 6.0)
        z = np.arange(rng.uniform(0, gap), 60, gap)
        stripes = flat(x, z, x + rng.uniform(0.2, 4.0), z + gap * rng.uniform(0.1, 0.5))
        mesh.ground(stripes, _some(rng, colours), Kind.ROAD)


def _some(rng: Rng, colours: list[Colour]) -> Colour:
    return colours[rng.integers(len(colours))] * rng.uniform(0.8, 1.2)


def _shape(here: Mesh, rng: Rng, colours: list[Colour], size: float, side: float) -> None:
    """Add a box, a sheet, a pole, a ball or a roof, about `size` metres wide."""
    colour = _some(rng, colours)
    kind = draw_kind(rng, box=0.55, sheet=0.15, pole=0.12, ball=0.1, roof=0.08)
    tall, low = size * rng.uniform(0.4, 2.5), 0.0
    if rng.random() < 0.15:
        low = rng.uniform(0.3, 2.5)
    half = size / 2
    if kind == "box":
        deep = size * rng.uniform(0.3, 2.0)
        here.block((-half, low, 0), (half, low + tall, deep), colour)
        flank = here.front(-side * half, 0, side)
        _pattern(flank, rng, colours, (0.0, low, deep, low + tall))
        _pattern(here, rng, colours, (-half, low, half, low + tall))
        if not low and tall > 2.5:
            x, _, z = here.world(np.zeros(3))
            here.bodies.append((x - half, x + half, z, z + deep, tall))
    elif kind == "sheet":
        here.add(rects(-half, low, half, low + tall), colour)
        _pattern(here, rng, colours, (-half, low, half, low + tall))
    elif kind == "pole":
        here.add(bars(0, 0.05 * size, 0, 2 * tall, top=0.05 * size * rng.uniform(0.2, 2.0)), colour)
    elif kind == "ball":
        here.add(discs(0, low + half, half), colour)
        here.add(discs(0.2 * half, low + 1.2 * half, 0.5 * half), 1.15 * colour)
    else:
        here.add(rects(-half, 0, half, tall), colour)
        here.add(triangles(-half, half, tall, rng.uniform(-half, half), 1.5 * tall), 0.8 * colour)


def _pattern(
    face: Mesh, rng: Rng, colours: list[Colour], rect: tuple[float, float, float, float]
) -> None:
    """Add a pattern to a face: a grid, stripes, bands, patches, or none."""
    u0, v0, u1, v1 = rect
    wide, tall, colour = u1 - u0, v1 - v0, _some(rng, colours)
    kind = draw_kind(rng, none=0.2, grid=0.3, stripes=0.15, bands=0.15, patches=0.2)
    columns, rows = int(rng.integers(1, 8)), int(rng.integers(1, 9))
    fill_u, fill_v = rng.uniform(0.2, 0.9, 2)
    u = u0 + (np.arange(columns) + (1 - fill_u) / 2) * wide / columns
    v = v0 + (np.arange(rows) + (1 - fill_v) / 2) * tall / rows
    across, up = fill_u * wide / columns, fill_v * tall / rows
    material = Kind.GLASS if rng.random() < 0.25 else Kind.SOLID
    if kind == "grid":
        present = rng.random((rows, columns)) < rng.choice((0.7, 1.0))
        cells = rects(u, v[:, None], u + across, v[:, None] + up)
        face.add(cells[present.ravel()], colour, material)
    elif kind == "stripes":
        face.add(rects(u, v0, u + across, v1), colour, material)
    elif kind == "bands":
        face.add(rects(u0, v, u1, v + up), colour, material)
    elif kind == "patches":
        for _ in range(int(rng.integers(1, 7))):
            a, b = u0 + np.sort(rng.random(2)) * wide, v0 + np.sort(rng.random(2)) * tall
            face.add(rects(a[0], b[0], a[1], b[1]), _some(rng, colours), material)
