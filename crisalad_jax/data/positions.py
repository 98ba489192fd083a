"""Read where images were taken, from their @UTM names or from a table."""

import csv
import math
import os
import pathlib
from collections.abc import Sequence
from typing import NamedTuple

from crisalad_jax.data.video import spelled
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import LARGEST, check_source

AXES = (("east", "north"), ("lat", "lon"), ("x", "y"))
"""Names of a position's two numbers: metres of UTM, degrees, or metres of a frame of one's own."""


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
            a column twice, no row, a row with more fields than that, without a name, a name twice,
            or a value that is no finite number, or no latitude or longitude.
    """
    return _read_table(pathlib.Path(path), must=False)


def _read_table(path: pathlib.Path, *, must: bool) -> ImageTable:
    """Read a table; with `must`, every row has a position."""
    lines: list[tuple[int, str]] = []
    seen: set[str] = set()
    positions: dict[str, tuple[float, float]] = {}
    check_source(path, "a table of UTF-8 CSV", largest=LARGEST)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            first = file.readline()
            file.seek(0)
            separator = ";" if first.count(";") > first.count(",") else ","
            rows = csv.DictReader(file, delimiter=separator)
            header = rows.fieldnames = [name.strip() for name in rows.fieldnames or []]
            axes = _axes(path, header, must=must)
            for row in rows:
                where, name = f"{path}: line {rows.line_num}", spelled(row["name"] or "")
                if None in row:
                    raise InputError(
                        f"{where}: found more fields than the header's {len(header)}, expected as "
                        "many (between commas a decimal is written with a point)"
                    )
                if not name:
                    raise InputError(f"{where}: found no name, expected an image's")
                if name in seen:
                    raise InputError(f"{where}: found {name!r} twice, expected it once")
                seen.add(name)
                lines.append((rows.line_num, name))
                # A field that is missing is an error, and no empty one.
                if axes is not None and (must or any(row[axis] != "" for axis in axes)):
                    positions[name] = _position(row, axes, separator, where)
    except (OSError, ValueError, csv.Error) as error:
        if isinstance(error, InputError):
            raise
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{path}: cannot read these positions: {reason}") from error
    return ImageTable(lines, None if axes is None else Positions(axes, positions))


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


def _position(
    row: dict[str, str], axes: tuple[str, str], separator: str, where: str
) -> tuple[float, float]:
    texts = [row[axis] for axis in axes]
    # With two marks a comma may stand before thousands: that is no number.
    commas = separator == ";" and not any("," in text and "." in text for text in texts if text)
    try:
        first, second = (float(text.replace(",", ".") if commas else text) for text in texts)
    except (TypeError, AttributeError, ValueError):
        first = second = math.nan
    if not (math.isfinite(first) and math.isfinite(second)):
        raise InputError(f"{where}: found {texts}, expected two finite numbers")
    if axes == AXES[1] and not (abs(first) <= 90 and abs(second) <= 180):
        raise InputError(f"{where}: found {texts}, expected a latitude and a longitude")
    if max(abs(first), abs(second)) > MOST_METRES:
        raise InputError(
            f"{where}: found {texts}, expected metres {' and '.join(axes)}, at most {MOST_METRES:g}"
        )
    return first, second
