"""A place: its scene, and what the camera has to know of it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from crisalad_jax.synthetic.mesh import Scene


class Body(NamedTuple):
    """The ground plan and height of a building in metres, for its shadow."""

    x0: float
    x1: float
    z0: float
    z1: float
    height: float


class Reach(NamedTuple):
    """Where cameras stand in a place."""

    height: tuple[float, float]
    """Least and most metres from the ground."""
    lateral: float
    """Most metres to the side."""
    forward: float
    """Most metres along it, from a station."""
    step: float
    """Metres from one station to the next, which are places of their own that look alike."""


class Place(NamedTuple):
    """The scene of one place, and the orientation of its street."""

    scene: Scene
    lamps: Float[np.ndarray, "lamp 3"]
    bodies: tuple[Body, ...]
    bearing: float
    """Direction of the street in degrees clockwise from north."""
    heading: float
    """Direction of the default view in degrees clockwise from the street."""
    lanes: tuple[float, float, float, float]
    """x of the left fronts, the left kerb, the right kerb and the right fronts."""
    hills: Float[np.ndarray, " bearing"]
    """Height of the hills over the horizon, as a tangent, at equal steps around the compass."""
    reach: Reach
    indoors: bool = False
    traffic: bool = True
    """Whether vehicles pass; people do everywhere."""
