"""Read CSV tables, and match the image names in tables and lists to files on disk.

Spellings differ: Windows writes backslashes, and macOS writes accents as separate characters (NFD).
"""

import collections
import csv
import io
import math
import pathlib
import re
import unicodedata
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from crisalad_jax.data.frames import spelled
from crisalad_jax.data.remote import is_remote, list_names, list_remote, read_remote
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import LARGEST, check_source

AXES = (("east", "north"), ("lat", "lon"), ("x", "y"))
"""Names of a position's two coordinates: UTM metres, degrees, or metres in a custom frame."""
MOST_METRES = 1e8
"""Largest coordinate in metres: 2.5 times the Earth's circumference, and its square is finite."""
_LINE = 2**20
"""Characters after which a line is cut: the rest then has too many or too few fields."""
_MOST = {"lat": 90.0, "lon": 180.0} | dict.fromkeys(("east", "north", "x", "y"), MOST_METRES)
"""Largest value in a column of positions."""
_SPELLINGS = {
    "name": ("filename", "file", "image", "path"),
    "lat": ("latitude",),
    "lon": ("lng", "long", "longitude"),
    "east": ("easting", "utm_east"),
    "north": ("northing", "utm_north"),
    "time": ("timestamp", "t", "date"),
}
"""Other names for the columns of tables of images and tracks; of several, the first one counts."""


def number_of(text: str) -> float:
    """Convert decimal text to a float, and other text to NaN; `float` would read 1_0 as 10."""
    plain = re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", text, re.ASCII | re.IGNORECASE)
    return float(text) if plain else math.nan


class Row(NamedTuple):
    """A row of a `Table`: the text of each of its fields, by the name of the column."""

    path: pathlib.Path
    line: int
    fields: dict[str, str]
    has_commas: bool
    """Whether a comma may be the decimal mark, because semicolons separate the fields."""

    @property
    def where(self) -> str:
        """Prefix of messages about the row: the file and the line."""
        return f"{self.path}: line {self.line}"

    def text(self, column: str) -> str:
        """Return the text in a column, which must not be empty.

        Raises:
            InputError: the field is empty.
        """
        if not self.fields[column]:
            raise InputError(f"{self.where}: found no {column}, expected one")
        return self.fields[column]

    def number(self, column: str) -> float:
        """Return the finite number in a column; a field with both a comma and a point is refused.

        Raises:
            InputError: the field is not a number, or is out of range for a position.
        """
        text, most = self.fields[column], _MOST.get(column, math.inf)
        value = number_of(text.replace(",", ".") if self.has_commas and "." not in text else text)
        if not (math.isfinite(value) and abs(value) <= most):
            limits = f" from -{most:g} to {most:g}" if most < math.inf else ""
            raise InputError(f"{self.where}: {column}: found {text!r}, expected a number{limits}")
        return value


class Table(NamedTuple):
    """A CSV file without its blank rows; `has_commas` is that of each `Row`."""

    path: pathlib.Path
    columns: list[str]
    """Fields of the first row without spaces around them; see `read_table` for other spellings."""
    lines: Iterator[tuple[int, list[str]]]
    """Line number and fields of each later row, one field per column; can be iterated once."""
    has_commas: bool

    def axes(self, of: str, *, must: bool) -> tuple[str, str] | None:
        """Return the names of the two columns of positions, one of `AXES`; None without positions.

        Args:
            of: name of the column that identifies the rows, for the message.
            must: whether positions are required.

        Raises:
            InputError: the table has both east,north and lat,lon, half of one, or none if `must`.
        """
        # x and y may be anything, such as pixels, and count only if there is no other pair.
        begun = [axes for axes in AXES[:2] if set(axes) & set(self.columns)]
        axes = (begun or [AXES[2]])[0]
        if len(begun) < 2 and set(axes) <= set(self.columns):
            return axes
        if begun or must:
            expected = " or ".join(f"{of},{','.join(axes)}" for axes in AXES)
            raise InputError(
                f"{self.path}: found columns {', '.join(self.columns)}, expected only one of "
                f"{expected}"
            )
        return None

    def rows(self) -> Iterator[Row]:
        """Yield each row, without spaces around its fields."""
        for line, fields in self.lines:
            by_column = dict(zip(self.columns, map(str.strip, fields), strict=True))
            yield Row(self.path, line, by_column, self.has_commas)

    def named_rows(self) -> Iterator[tuple[str, Row]]:
        """Yield the name and row of each image, with frames of videos named as in `data.frames`.

        Raises:
            InputError: a row has no name, or the name of an earlier row (by `normal_name`).
        """
        lines: dict[str, int] = {}
        for row in self.rows():
            name = spelled(row.text("name"))
            if (before := lines.setdefault(normal_name(name), row.line)) != row.line:
                raise InputError(
                    f"{row.where}: found {name!r} twice, on line {before} too, expected it once"
                )
            yield name, row


def read_table(path: pathlib.Path, *needed: str, any_spelling: bool = False) -> Table:
    """Read a table whose first row has the names of the columns.

    The separator is a semicolon if the first row has more semicolons than commas, and otherwise a
    comma. A byte order mark, as spreadsheets write it, is dropped.

    Args:
        path: the file, local or remote.
        *needed: required columns; if none are given, the first row may hold data instead of names.
        any_spelling: whether columns may be in capitals, or have other usual names such as
            latitude; they are then renamed to name, lat, lon, east, north and time.

    Raises:
        InputError: the file cannot be read, lacks a required column, or (given `needed`) has a
            column twice; or, while rows are read, a row has more or fewer fields than the first.
    """
    if not is_remote(path):
        check_source(path, "a table of UTF-8 CSV", largest=LARGEST)
    lines = _lines(path)
    separator, columns = next(lines)
    if any_spelling:
        columns = _plain(columns)
    missing = [name for name in needed if name not in columns]
    named = [name for name in columns if name]
    if missing or (needed and len(set(named)) < len(named)):
        found = ", ".join(columns) or "none"
        lacking = f"; missing {', '.join(missing)}" if missing else ", expected each once"
        raise InputError(f"{path}: found columns {found}{lacking}")
    return Table(path, columns, lines, separator == ";")


def _plain(columns: Sequence[str]) -> list[str]:
    """Return columns in lower case, with this package's names for those in `_SPELLINGS`."""
    plain = [column.lower() for column in columns]
    for own, others in _SPELLINGS.items():
        found = next((each for each in (own, *others) if each in plain), own)
        plain = [own if column == found else column for column in plain]
    return plain


def _lines(path: pathlib.Path) -> Iterator[tuple[Any, list[str]]]:
    """Yield the separator and the columns, then the number and the fields of every row."""
    try:
        opened = io.BytesIO(read_remote(path)) if is_remote(path) else path.open("rb")
        with io.TextIOWrapper(opened, encoding="utf-8-sig", newline="") as file:
            first = file.readline(_LINE)
            file.seek(0)
            separator = ";" if first.count(";") > first.count(",") else ","
            reader = csv.reader(iter(lambda: file.readline(_LINE), ""), delimiter=separator)
            columns = [column.strip() for column in next(filter(None, reader), [])]
            yield separator, columns
            for row in filter(None, reader):
                if len(row) != len(columns):
                    raise InputError(
                        f"{path}: line {reader.line_num}: found {len(row)} fields, expected "
                        f"{len(columns)} ({separator.join(columns)})"
                    )
                yield reader.line_num, row
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as UTF-8 CSV: {error}") from error


def normal_name(name: str) -> str:
    r"""Return a name with forward slashes, in Unicode normal form C.

    Example:
        >>> normal_name("caf" + "e\u0301" + "\\" + "1.jpg")
        'café/1.jpg'
    """
    return unicodedata.normalize("NFC", name.replace("\\", "/"))


def spellings(names: Collection[str]) -> dict[str, str]:
    """Map each name, and its `normal_name`, to the name."""
    return {normal_name(name): name for name in names} | {name: name for name in names}


def matched(names: Iterable[str], there: Collection[str]) -> dict[str, str]:
    """Map each name to the one in `there` that matches it; names without a match are left out.

    The match is the name itself, or else one that differs only in slashes or Unicode normal form.
    """
    existing = spellings(there)
    found = {name: existing.get(name, existing.get(normal_name(name))) for name in names}
    return {name: meant for name, meant in found.items() if meant is not None}


class Disk:
    """A finder of files that lists each folder only once, which is faster on remote disks."""

    def __init__(self, root: pathlib.Path | None = None) -> None:
        """Start without listings, or with those of all folders below a remote root.

        Raises:
            InputError: the address cannot be listed.
        """
        self._listings: dict[pathlib.Path, dict[str, str]] = {}
        self._is_whole = root is not None and is_remote(root)
        if root is not None and self._is_whole:
            inside: dict[pathlib.Path, set[str]] = collections.defaultdict(set)
            for path in list_remote(root):
                for each in (path, *path.parents[: len(path.parts) - len(root.parts) - 1]):
                    inside[each.parent].add(each.name)
            self._listings = {folder: spellings(names) for folder, names in inside.items()}

    def find(self, root: pathlib.Path, name: str) -> pathlib.Path | None:
        """Return the path below `root` that matches a name; None if there is none."""
        path = root / name
        if (there := self.names(path.parent).get(path.name)) is not None:
            return path.with_name(there)
        path = root
        for part in pathlib.PurePosixPath(normal_name(name)).parts:
            there = part if part in ("/", "..") else self.names(path).get(part)
            if there is None:
                return None
            path = path / there
        return path

    def names(self, folder: pathlib.Path) -> dict[str, str]:
        """Map the names in a folder, and their `normal_name`s, to the names themselves."""
        if folder not in self._listings:
            names = () if self._is_whole else list_names(folder)
            self._listings[folder] = spellings(names)
        return self._listings[folder]
