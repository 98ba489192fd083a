"""Tables of one's own: CSV with a column `name` and a row for each image."""

import csv
import math
import pathlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

from crisalad_jax.data.names import plain
from crisalad_jax.data.video import spelled
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import LARGEST, check_source


class NamedRow(NamedTuple):
    """A row of a table."""

    line: int
    where: str
    """What a message about it begins with: the file and the line."""
    name: str
    """The image's; a frame of a video's is as `data.video` writes it."""
    fields: Mapping[str, str]
    """Texts by column."""
    has_commas: bool
    """Whether decimals may have commas, as semicolons are between the fields."""

    def number(self, column: str) -> float:
        """Read a number; NaN where the text is none. Beside a point a comma may mean thousands."""
        text = self.fields[column]
        try:
            return float(text.replace(",", ".") if self.has_commas and "." not in text else text)
        except ValueError:
            return math.nan


def named_rows(
    table: pathlib.Path, check_header: Callable[[Sequence[str]], None]
) -> Iterator[NamedRow]:
    """Yield the rows of a table, whose names are there, each once however it is spelled.

    The separator is a comma or, where the header has more of them, a semicolon. Spaces around
    texts are dropped, and so is a spreadsheet's byte order mark.

    Args:
        table: the file.
        check_header: is given the columns before any row, and raises where they do not fit; with
            it a column `name` is there.

    Raises:
        InputError: the file cannot be read; a row with other than the header's number of fields,
            without a name, or with one that is there before; or what `check_header` raises.
    """
    check_source(table, "a table of UTF-8 CSV", largest=LARGEST)
    lines: dict[str, int] = {}
    try:
        with table.open(newline="", encoding="utf-8-sig") as file:
            first = file.readline()
            file.seek(0)
            separator = ";" if first.count(";") > first.count(",") else ","
            reader = csv.reader(file, delimiter=separator)
            header = [column.strip() for column in next(reader, [])]
            check_header(header)
            for row in reader:
                if not row:
                    continue
                where = f"{table}: line {reader.line_num}"
                if len(row) != len(header):
                    hint = ""
                    if len(row) > len(header) and separator == ",":
                        hint = "; between commas a decimal is written with a point"
                    raise InputError(
                        f"{where}: found {len(row)} fields, expected {len(header)} "
                        f"({separator.join(header)}{hint})"
                    )
                fields = {key: text.strip() for key, text in zip(header, row, strict=True)}
                name = spelled(fields["name"])
                if not name:
                    raise InputError(f"{where}: found no name, expected an image's")
                if (before := lines.setdefault(plain(name), reader.line_num)) < reader.line_num:
                    raise InputError(
                        f"{where}: found {name!r} twice, on line {before} too, expected it once"
                    )
                yield NamedRow(reader.line_num, where, name, fields, separator == ";")
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{table}: cannot be read as UTF-8 CSV: {reason}") from error
