"""Which database images are right for a query: by distance, or as a file lists them."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Float64, Int64

DEFAULT_RADIUS = 25.0
"""Radius in metres of the common rule (Arandjelovic et al. 2016)."""


def check_radius(radius: float) -> None:
    """Check a distance in metres.

    Raises:
        InputError: it is negative, infinite or no number.
    """
    if not 0 <= radius < math.inf:
        raise InputError(f"radius: found {radius}, expected finite metres from 0")


def within(
    database: Float64[np.ndarray, "images axis"],
    queries: Float64[np.ndarray, "q axis"],
    radius: float,
) -> tuple[Int64[np.ndarray, " _"], ...]:
    """Find the database images at most `radius` away from each query, as ascending indices."""
    import scipy.spatial  # takes a fifth of a second, which reading images does not need

    near = scipy.spatial.KDTree(database).query_ball_point(queries, radius, return_sorted=True)
    return tuple(np.array(references, np.int64) for references in near)


def indices(value: Any) -> Int64[np.ndarray, " _"]:
    """Convert a ground truth file's value, a number, flat list or integer array, to indices.

    Nested lists are refused, not flattened: a pickle of a few hundred bytes can hold nested lists
    of any size.

    Raises:
        TypeError: anything else.
        OverflowError: a number of more than 64 bits.
    """
    if isinstance(value, np.ndarray) and value.dtype != object:
        if value.size and value.dtype.kind not in "iu":
            raise TypeError(f"values of type {value.dtype}")
        return np.asarray(value).reshape(-1).astype(np.int64)
    items = value.reshape(-1) if isinstance(value, np.ndarray) else value
    items = items if isinstance(items, list | tuple | np.ndarray) else (items,)
    for item in items:
        if isinstance(item, bool | np.bool_) or not isinstance(item, int | np.integer):
            raise TypeError(f"values of type {type(item).__name__}")
    return np.array([int(item) for item in items], np.int64)


def matches(value: Any, database: int, *, windows: bool = False) -> Int64[np.ndarray, " _"]:
    """Return the unique database indices that a ground truth file gives a query, ascending.

    An index of -1 stands for no match (VPR-Bench) and is dropped.

    Args:
        value: a number, flat list or integer array.
        database: the number of images.
        windows: whether indices after the last image are dropped too, where others are left.

    Raises:
        InputError: they are no indices below `database`. The caller puts the file's name in front.
    """
    try:
        references = indices(value)
    except (TypeError, OverflowError) as error:
        raise InputError(f"found {error}, expected indices") from error
    references = np.unique(references[references != -1])
    if windows and references.size and 0 <= references[0] < database:
        references = references[references < database]
    if references.size and not 0 <= references[0] <= references[-1] < database:
        raise InputError(
            f"found reference indices {references[0]} to {references[-1]}, "
            f"expected 0 to {database - 1}, or -1 for no match"
        )
    return references


def is_nordland_star(positives: Sequence[Int64[np.ndarray, " _"]], database: int) -> bool:
    """Return whether this is VPR-Bench's Nordland: query i matches 10i - 1, 10i and 10i + 1.

    Its queries (2,760, summer) are every tenth frame of its database (27,592, winter).
    """
    return len(positives) > 1 and all(
        references.tolist()
        == [i for i in range(10 * query - 1, 10 * query + 2) if 0 <= i < database]
        for query, references in enumerate(positives)
    )
