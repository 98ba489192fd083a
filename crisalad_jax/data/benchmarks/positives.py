"""Which database images are right for a query: by distance, or as a file lists them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from crisalad_jax.errors import InputError

DEFAULT_RADIUS = 25.0
"""Metres: the common rule (Arandjelovic et al. 2016)."""


def check_radius(radius: float) -> None:
    """Check a distance in metres.

    Raises:
        InputError: it is negative or no number.
    """
    if not radius >= 0:
        raise InputError(f"radius: found {radius}, expected metres from 0")


def within(
    database: Float64[np.ndarray, "images 2"], queries: Float64[np.ndarray, "q 2"], radius: float
) -> tuple[Int64[np.ndarray, " _"], ...]:
    """Ascending database indices at most `radius` away from each query.

    Memory stays linear in the database.
    """
    # Along the longer side of the map a band of twice the radius holds few candidates.
    axis = int(np.argmax(np.ptp(database, axis=0)))
    order = np.argsort(database[:, axis], kind="stable")
    ordered = database[order]
    # Rounding keeps order: the band's rounded edges lose none that is at most `radius` away.
    first = np.searchsorted(ordered[:, axis], queries[:, axis] - radius, side="left")
    last = np.searchsorted(ordered[:, axis], queries[:, axis] + radius, side="right")
    positives = []
    for query, start, stop in zip(queries, first, last, strict=True):
        squared = np.square(ordered[start:stop] - query).sum(axis=1)
        positives.append(np.sort(order[start:stop][squared <= radius * radius]))
    return tuple(positives)


def indices(value: Any) -> Int64[np.ndarray, " _"]:
    """Indices as ground truth files hold them: a number, a flat list, or an array of integers.

    Lists in lists are refused, not flattened: a few hundred bytes of a pickle can stand for lists
    in lists of any size.

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


def matches(value: Any, database: int) -> Int64[np.ndarray, " _"]:
    """The database images that a ground truth file gives for a query, ascending, each once.

    -1 stands for no match (VPR-Bench): it is never an index.

    Raises:
        InputError: they are no indices below `database`. The message is for behind a file's name.
    """
    try:
        found = indices(value)
    except (TypeError, OverflowError) as error:
        raise InputError(f"found {error}, expected indices") from error
    found = np.unique(found[found != -1])
    if found.size and not 0 <= found[0] <= found[-1] < database:
        raise InputError(
            f"found reference indices {found[0]} to {found[-1]}, "
            f"expected 0 to {database - 1}, or -1 for no match"
        )
    return found


def is_nordland_star(positives: Sequence[Int64[np.ndarray, " _"]], database: int) -> bool:
    """Whether a ground truth is that of VPR-Bench's Nordland: i matches 10i - 1, 10i and 10i + 1.

    There the queries (2,760, summer) are every tenth frame of the database (27,592, winter).
    """
    return len(positives) > 1 and all(
        found.tolist() == [i for i in range(10 * query - 1, 10 * query + 2) if 0 <= i < database]
        for query, found in enumerate(positives)
    )
