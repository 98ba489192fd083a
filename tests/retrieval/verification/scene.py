"""Points and cameras whose poses are known, projected by hand, and a matcher of them."""

from typing import NamedTuple

import cv2
import numpy as np

from crisalad_jax.retrieval.verification.camera import Intrinsics

CAMERA = Intrinsics(400.0, 410.0, 325.0, 235.0, 640, 480)
SIZE = 480, 640
NOISE = 0.3
"""Standard deviation of a point's pixels."""
POINTS = np.random.default_rng(5).uniform((-6, -4, 6), (6, 3, 16), (200, 3))
"""Metres to the right, down and ahead of the first camera; ahead is north."""


class View(NamedTuple):
    """A level camera: metres east and north, degrees clockwise from north."""

    east: float
    north: float
    heading: float

    @property
    def rotation(self):
        """From the room's axes to the camera's."""
        angle = np.deg2rad(self.heading)
        cos, sin = np.cos(angle), np.sin(angle)
        return np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])

    def see(self):
        """The points in the camera's axes."""
        return (POINTS - (self.east, 0, self.north)) @ self.rotation.T

    def pixels(self, seed):
        x, y, z = self.see().T
        exact = np.stack([CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy], axis=1)
        return exact + np.random.default_rng(seed).normal(0, NOISE, exact.shape)


VIEWS = [View(0, 0, 0), View(1.0, -0.6, 4), View(-0.8, 0.9, -8), View(0.5, 2.0, 3)]
QUERY = 3
"""The number of the last view; the first three are a map's."""
POSITIONS = [np.array([view.east, view.north]) for view in VIEWS]


def relative(first, second):
    """The true pose from one view's axes to another's."""
    (a, b), (p, q) = (VIEWS[first], VIEWS[second]), (POSITIONS[first], POSITIONS[second])
    moved = np.array([p[0] - q[0], 0, p[1] - q[1]])
    return b.rotation @ a.rotation.T, b.rotation @ moved


def degrees_between(first, second):
    """The angle of the rotation between two, or between two vectors."""
    if first.ndim == 2:
        cosine = (np.trace(first @ second.T) - 1) / 2
    else:
        cosine = first @ second / np.linalg.norm(first) / np.linalg.norm(second)
    return np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))


class PointMatcher:
    """Matches the points of views, which an image names by its colour; a third of them wrongly."""

    name = "points"

    def prepare(self, image):
        return int(image[0, 0, 0]) // 40

    def match(self, query, database):
        ours, theirs = (VIEWS[number].pixels(number) for number in (query, database))
        theirs = theirs.copy()
        theirs[::3] = theirs[::3][::-1]
        return ours, theirs


def picture(number):
    return np.full((*SIZE, 3), 40 * number, np.uint8)


def write_pictures(folder):
    """Write the pictures of a map's three views, and return their folder and names."""
    for number in range(QUERY):
        cv2.imwrite(str(folder / f"{number}.png"), picture(number))
    return [(str(folder), f"{number}.png") for number in range(QUERY)]
