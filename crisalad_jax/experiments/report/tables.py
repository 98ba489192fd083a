"""Tables for the terminal, for Markdown and for a page, and files of text."""

import csv
import io
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import rich.table
from rich.text import Text

from crisalad_jax.utils.files import atomic_path

NOTHING = "-"
"""Cell of what is unknown or does not apply."""


class Cell(NamedTuple):
    """A cell of a table."""

    text: str
    note: str = ""
    """What is less important, as an interval: its lines are below the text in a page, elsewhere
    after it."""
    kind: str = ""
    """How a page shows it: best, right or wrong."""


class Table(NamedTuple):
    """A table for any medium."""

    headers: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    labels: int = 1
    """Number of the first columns, which are words; the others are numbers, at the right."""
    title: str = ""

    def terminal(self) -> rich.table.Table:
        """Make the table for the terminal; with three labels a line parts groups of the first."""
        table = rich.table.Table(title=self.title or None, title_justify="left")
        for number, header in enumerate(self.headers):
            justify = "left" if number < self.labels else "right"
            table.add_column(header, justify=justify, overflow="fold")
        for cells, following in zip(self.rows, [*self.rows[1:], None], strict=True):
            last = self.labels > 2 and following is not None and following[0] != cells[0]
            # `Text` keeps square brackets in a name from being markup.
            table.add_row(*(Text(_in_line(cell)) for cell in cells), end_section=last)
        return table

    def markdown(self) -> str:
        """Write the table as Markdown, one line a row, ending in a newline."""
        rule = ["---"] * self.labels + ["---:"] * (len(self.headers) - self.labels)
        rows = [self.headers, *(map(_in_line, cells) for cells in self.rows)]
        head, *body = ([text.replace("|", r"\|") for text in row] for row in rows)
        return "".join(f"| {' | '.join(cells)} |\n" for cells in [head, rule, *body])


def _in_line(cell: Cell) -> str:
    return " ".join((cell.text, *cell.note.split("\n"))).rstrip()


class RecallRow(NamedTuple):
    """One line of a table of recalls."""

    benchmark: str
    model: str
    """Which weights, for instance "trained, seed 0"."""
    grouping: str
    """How images were batched: single, shuffled or sequential."""
    recalls: Mapping[int, float]
    """K -> fraction of the queries, 0 to 1."""


def recall_table(rows: Sequence[RecallRow], title: str = "") -> Table:
    """Make a table of recalls in percent with one decimal, a line for each row."""
    ks = sorted({k for row in rows for k in row.recalls})
    body = [
        [row.benchmark, row.model, row.grouping]
        + [f"{100 * row.recalls[k]:.1f}" if k in row.recalls else NOTHING for k in ks]
        for row in rows
    ]
    headers = ["data set", "model", "grouping", *(f"R@{k}" for k in ks)]
    return Table(headers, [list(map(Cell, cells)) for cells in body], labels=3, title=title)


def write_csv(path: pathlib.Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a CSV file of rows with the same columns; None is an empty cell."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: _no_formula(value) for name, value in row.items()})
    write_text(path, text.getvalue())


def _no_formula(value: Any) -> Any:
    """Put a quote before a text that a spreadsheet would take for a formula."""
    is_formula = isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r"))
    return f"'{value}" if is_formula else value


def write_text(path: pathlib.Path, text: str) -> None:
    """Write a file of UTF-8, whole or not at all; other bytes, as of names, become escapes."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace", newline="")
