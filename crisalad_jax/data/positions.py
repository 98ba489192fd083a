"""Read where images were taken, from their @UTM names or from a table."""

import math
import os
import pathlib
from collections.abc import Sequence
from typing import NamedTuple

from crisalad_jax.config.concise import brief
from crisalad_jax.data.named_table import NamedRow, named_rows
from crisalad_jax.utils.errors import InputError

AXES = (("east", "north"), ("lat", "lon"), ("x", "y"))
"""Names of a position's two numbers: metres of UTM, degrees, or metres of a frame of one's own."""


@brief
class Positions(NamedTuple):
    """Positions by image name; images without a position are absent."""

    axes: tuple[str, str]
    of: dict[str, tuple[float, float]]


MOST_METRES = 1e8
"""Largest coordinate in metres: twice the Earth's circumference, and its square is finite."""


def utm_position(name: str) -> tuple[float, float] | None:
    """Read east and north in metres from a name `@UTM_east@UTM_north@...`; None for other names."""
    fields = name.split("@")
    try:
        east, north = float(fields[1]), float(fields[2])
    except (IndexError, ValueError):
        return None
    return (east, north) if math.isfinite(east) and math.isfinite(north) else None


def utm_positions(names: Sequence[str]) -> Positions:
    """Read east and north in metres of the images with names `@UTM_east@UTM_north@...`."""
    positions = {}
    for name in names:
        position = utm_position(pathlib.PurePosixPath(name).name)
        if position is not None:
            positions[name] = position
    return Positions(AXES[0], positions)


@brief
class ImageTable(NamedTuple):
    """A table of images, with their positions as far as it has them."""

    rows: list[tuple[int, str]]
    """Line and name of each image, in the table's order."""
    positions: Positions | None
    """Positions by name; None where the table has no such columns."""


def read_positions(path: str | os.PathLike[str]) -> Positions:
    """Read a table of `name,east,north`, `name,lat,lon` or `name,x,y`; see `read_image_table`.

    Raises:
        InputError: as `read_image_table`; no columns of positions, or a row without one.
    """
    positions = _read_table(pathlib.Path(path), must=True).positions
    assert positions is not None
    return positions


def read_image_table(path: str | os.PathLike[str]) -> ImageTable:
    """Read a table with a column `name`, and perhaps a position: east,north or lat,lon or x,y.

    The separator is a comma or, where the header has more of them, a semicolon; then decimals may
    have commas. x and y count only where there is neither of the other pairs. A row whose two
    numbers are both empty has no position. Other columns are ignored.

    Raises:
        InputError: the file cannot be read, has another header, one with both other pairs or with
            a column twice, a row with other than as many fields, without a name, a name twice,
            or a value that is no finite number, or no latitude or longitude.
    """
    return _read_table(pathlib.Path(path), must=False)


def _read_table(path: pathlib.Path, *, must: bool) -> ImageTable:
    """Read a table; with `must`, every row has a position."""
    found: list[tuple[str, str] | None] = []
    rows = list(named_rows(path, lambda header: found.append(_axes(path, header, must=must))))
    (axes,) = found
    positions = {
        row.name: _position(row, axes)
        for row in rows
        if axes is not None and (must or any(row.fields[axis] for axis in axes))
    }
    return ImageTable(
        [(row.line, row.name) for row in rows], None if axes is None else Positions(axes, positions)
    )


_NEEDED = "name,east,north or name,lat,lon or name,x,y"


def _axes(path: pathlib.Path, header: Sequence[str], *, must: bool) -> tuple[str, str] | None:
    matching = [axes for axes in AXES if {"name", *axes} <= set(header)]
    if len(matching) > 1 and matching[-1] == AXES[-1]:
        matching.pop()  # x and y may be of anything, such as pixels
    used = {"name", *AXES[0], *AXES[1], *sum(matching, ())}
    twice = [name for name in header if header.count(name) > 1 and name in used]
    if twice:
        raise InputError(f"{path}: found the column {twice[0]} twice, expected it once")
    if len(matching) == 1:
        return matching[0]
    found = f"{path}: found columns {', '.join(header) or 'none'}"
    if matching:
        raise InputError(f"{found}, expected {_NEEDED}, only one of these")
    if must:
        raise InputError(f"{found}, expected {_NEEDED}")
    if "name" not in header:
        raise InputError(f"{found}, expected one called name")
    if any(axis in header for axes in AXES[:2] for axis in axes):
        raise InputError(f"{found}, expected both numbers of a position: {_NEEDED}")
    return None


def _position(row: NamedRow, axes: tuple[str, str]) -> tuple[float, float]:
    first, second = map(row.number, axes)
    found = f"{row.where}: found {[row.fields[axis] for axis in axes]}"
    if not (math.isfinite(first) and math.isfinite(second)):
        raise InputError(f"{found}, expected two finite numbers")
    if axes == AXES[1] and not (abs(first) <= 90 and abs(second) <= 180):
        raise InputError(f"{found}, expected a latitude and a longitude")
    if max(abs(first), abs(second)) > MOST_METRES:
        raise InputError(f"{found}, expected metres {' and '.join(axes)}, at most {MOST_METRES:g}")
    return first, second
