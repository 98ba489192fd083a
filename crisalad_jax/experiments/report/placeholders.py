"""Positions that are none: placeholders such as (0, 0), and images far from all others."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

_TIMES = 10
_LEAST = 1000.0
_SHARE, _COUNT = 0.02, 5


class Placed(NamedTuple):
    """Which images are where the others are."""

    database: Bool[np.ndarray, " n"]
    queries: Bool[np.ndarray, " q"]
    limit: float
    """Metres from the centre beyond which an image is out of place."""


def find_placed(
    database: Float[np.ndarray, "n axis"], queries: Float[np.ndarray, "q axis"]
) -> Placed:
    """Tell images with a likely position from those with a placeholder.

    An image is out of place if it lies ten times farther from the median position than nine tenths
    of the images do, and over a kilometre. Neither is measured by images at (0, 0), nor by those
    that share one position with many others. A second city with a tenth of the images is in place.
    """
    points = np.concatenate([database, queries])
    _, which, counts = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    many = counts[which.reshape(-1)] >= max(_COUNT, _SHARE * len(points))
    trusted = points[~(many | (points == 0).all(axis=1))]
    trusted = trusted if len(trusted) else points
    centre = np.median(trusted, axis=0)
    reach = np.quantile(np.linalg.norm(trusted - centre, axis=1), 0.9)
    limit = max(_TIMES * float(reach), _LEAST)
    placed = np.linalg.norm(points - centre, axis=1) <= limit
    return Placed(placed[: len(database)], placed[len(database) :], limit)
