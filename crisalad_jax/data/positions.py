"""Read where images were taken, from their @UTM names or from a table."""

import csv
import math
import os
import pathlib
from collections.abc import Sequence
from typing import NamedTuple

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import LARGEST, check_source

AXES = (("east", "north"), ("lat", "lon"))
"""Names of a position's two numbers: metres of UTM, or degrees."""


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


def read_positions(path: str | os.PathLike[str]) -> Positions:
    """Read a table with the header `name,east,north` or `name,lat,lon`; other columns are ignored.

    Raises:
        InputError: the file cannot be read, has another header, one with both pairs or with a
            column twice, a row with more fields than that, a name twice, or a value that is no
            finite number, or no latitude or longitude.
    """
    path = pathlib.Path(path)
    positions: dict[str, tuple[float, float]] = {}
    check_source(path, "a table of UTF-8 CSV", largest=LARGEST)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.DictReader(file)
            header = rows.fieldnames or []
            axes = _axes(path, header)
            for row in rows:
                where = f"{path}: line {rows.line_num}"
                if None in row:
                    raise InputError(
                        f"{where}: found more fields than the header's {len(header)}, expected as "
                        "many (a decimal is written with a point)"
                    )
                if row["name"] in positions:
                    raise InputError(f"{where}: found {row['name']!r} twice, expected it once")
                positions[row["name"]] = _position(row, axes, where)
    except (OSError, ValueError, csv.Error) as error:
        if isinstance(error, InputError):
            raise
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{path}: cannot read these positions: {reason}") from error
    return Positions(axes, positions)


def _axes(path: pathlib.Path, header: Sequence[str]) -> tuple[str, str]:
    matching = [axes for axes in AXES if {"name", *axes} <= set(header)]
    twice = [name for name in header if header.count(name) > 1 and name in ("name", *sum(AXES, ()))]
    if twice:
        raise InputError(f"{path}: found the column {twice[0]} twice, expected it once")
    if len(matching) != 1:
        both = ", not both" if matching else ""
        raise InputError(
            f"{path}: found columns {', '.join(header) or 'none'}, expected name,east,north or "
            f"name,lat,lon{both}"
        )
    return matching[0]


def _position(row: dict[str, str], axes: tuple[str, str], where: str) -> tuple[float, float]:
    texts = [row[axis] for axis in axes]
    try:
        first, second = map(float, texts)
    except (TypeError, ValueError):
        first = second = math.nan
    if not (math.isfinite(first) and math.isfinite(second)):
        raise InputError(f"{where}: found {texts}, expected two finite numbers")
    if axes == AXES[1] and not (abs(first) <= 90 and abs(second) <= 180):
        raise InputError(f"{where}: found {texts}, expected a latitude and a longitude")
    if max(abs(first), abs(second)) > MOST_METRES:
        raise InputError(
            f"{where}: found {texts}, expected metres east and north, at most {MOST_METRES:g}"
        )
    return first, second
