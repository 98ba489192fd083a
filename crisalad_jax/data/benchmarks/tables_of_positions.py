"""Positions of two folders' images, from tables beside the folders."""

import pathlib
from collections.abc import Sequence

import numpy as np

from crisalad_jax.data.metres import comparable
from crisalad_jax.data.names import matched
from crisalad_jax.data.positions import AXES, read_positions
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Float64

BOTH = "positions.csv"
SIDES = ("database", "queries")

Metres = Float64[np.ndarray, "images axis"]


def positions_beside(
    folder: pathlib.Path, database: Sequence[pathlib.Path], queries: Sequence[pathlib.Path]
) -> tuple[Metres, Metres] | tuple[None, None]:
    """Read where the images of two folders were taken, as points whose distances are metres.

    `positions.csv` names images by their path in `folder`, as `database/1.jpg`. Or `database.csv`
    and `queries.csv` name them by their path in these folders. The columns are `name,east,north`
    or `name,lat,lon`; degrees are projected to UTM if all are of one zone, else they become points
    on the ellipsoid (`metres.comparable`).

    Args:
        folder: the folder that holds `database/`, `queries/` and the tables.
        database: images of the one.
        queries: images of the other.

    Returns:
        The positions of the database and of the queries; None where there is no table.

    Raises:
        InputError: one side's table without the other's, or both kinds; tables of metres and of
            degrees; an image without a position; or what `read_positions` raises.
    """
    both, sides = folder / BOTH, [folder / f"{side}.csv" for side in SIDES]
    there = [table for table in (both, *sides) if table.exists()]
    if not there:
        return None, None
    if there not in ([both], sides):
        raise InputError(
            f"{folder}: found {', '.join(table.name for table in there)}, expected {BOTH}, or "
            "database.csv and queries.csv"
        )
    found, axes = [], set()
    for table, images, side in zip(
        there if len(there) == 2 else there * 2, (database, queries), SIDES, strict=True
    ):
        root = folder if table == both else folder / side
        positions = read_positions(table)
        axes.add(positions.axes)
        names = ["/".join(image.parts[len(root.parts) :]) for image in images]
        lines = matched(names, positions.of)
        missing = [name for name in names if name not in lines]
        if missing:
            raise InputError(
                f"{table}: found {len(missing)} of {len(names)} images of {side} without a line, "
                f"expected all; the first is {missing[0]}"
            )
        found.append(np.array([positions.of[lines[name]] for name in names], np.float64))
    if len(axes) > 1:
        raise InputError(
            f"{there[0]}: found lat,lon in one table and east,north in the other, expected the same"
        )
    if axes == {AXES[1]}:
        found = np.split(comparable(*np.concatenate(found).T), [len(found[0])])
    return found[0], found[1]
