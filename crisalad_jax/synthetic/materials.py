"""The city's materials: kinds of surface, and the colours that parts are drawn from."""

import enum

import numpy as np

Colour = tuple[float, float, float]
"""Red, green and blue, 0 to 1."""


class Kind(enum.IntEnum):
    """Material of a part, which decides how season and light change it."""

    SOLID = 0
    ROOF = 1
    LEDGE = 2
    PAVEMENT = 3
    ROAD = 4
    GRASS = 5
    LEAF = 6
    NEEDLE = 7
    GLASS = 8
    SHOP = 9
    LAMP = 10
    HEADLIGHT = 11
    TAILLIGHT = 12
    SOIL = 13
    """A field or ballast: of its own colour, under snow in winter."""
    BUSH = 14
    """Leaves that are bare twigs in winter."""
    WINDOW = 15
    """An opening to the sky, seen from inside."""


WALLS: tuple[Colour, ...] = (
    (0.55, 0.29, 0.23),
    (0.76, 0.60, 0.36),
    (0.84, 0.78, 0.64),
    (0.56, 0.56, 0.57),
    (0.70, 0.60, 0.48),
    (0.74, 0.54, 0.49),
    (0.58, 0.66, 0.72),
    (0.57, 0.63, 0.50),
    (0.86, 0.85, 0.82),
    (0.40, 0.27, 0.24),
    (0.66, 0.64, 0.61),
    (0.42, 0.45, 0.49),
    (0.70, 0.42, 0.30),
)
ROOFS: tuple[Colour, ...] = (
    (0.52, 0.27, 0.20),
    (0.33, 0.33, 0.36),
    (0.42, 0.34, 0.29),
    (0.30, 0.42, 0.38),
)
SIGNS: tuple[Colour, ...] = (
    (0.70, 0.16, 0.14),
    (0.13, 0.28, 0.52),
    (0.12, 0.40, 0.24),
    (0.85, 0.66, 0.14),
    (0.20, 0.18, 0.20),
    (0.82, 0.80, 0.76),
)
GLASS: Colour = (0.16, 0.20, 0.25)


def scaled(colour: Colour, gain: float) -> Colour:
    """Multiply a colour, or any other vector, by a number."""
    return (colour[0] * gain, colour[1] * gain, colour[2] * gain)


def pick(rng: np.random.Generator, colours: tuple[Colour, ...], spread: float = 0.06) -> Colour:
    """Draw one of the colours, up to a share `spread` lighter or darker."""
    colour = colours[rng.integers(len(colours))]
    return scaled(colour, 1 + rng.uniform(-spread, spread))
