"""Tables for the terminal, Markdown, LaTeX and HTML pages, and text files."""

import csv
import io
import itertools
import pathlib
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import rich.table
from rich.text import Text

from crisalad_jax.utils.files import atomic_path
from crisalad_jax.utils.output import printable

NOTHING = "-"
"""Cell for a value that is unknown or does not apply."""
_NAMED = {"\\": "backslash", "~": "asciitilde", "^": "asciicircum"}
_NAMED |= {"|": "bar", "<": "less", ">": "greater"}
_IN_LATEX = str.maketrans(
    {letter: rf"\text{name}{{}}" for letter, name in _NAMED.items()}
    | {letter: rf"\{letter}" for letter in "&%$#_{}"}
    # At the start of a line, LaTeX would take these as arguments of the previous line's end.
    | {letter: f"{{{letter}}}" for letter in "[]*"}
    | {"±": r"$\pm$", "Δ": r"$\Delta$", "\N{EN DASH}": "--"}
)


class Cell(NamedTuple):
    """A cell of a table."""

    text: str
    note: str = ""
    """Secondary text, such as an interval. In a page and in a `stacked` table its lines are below
    the text, elsewhere after it."""
    kind: str = ""
    """How a page highlights the cell: "best", "right" or "wrong"; "" for not at all."""


class Table(NamedTuple):
    """A table for the terminal, Markdown, LaTeX and pages."""

    headers: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    labels: int = 1
    """Number of leading columns that hold text; the others hold numbers, right-aligned."""
    title: str = ""
    stacked: bool = False
    """Whether notes are below their texts in the terminal too, with lines between the rows."""
    summed: bool = False
    """Whether the last row is the sum of the others."""

    def terminal(self) -> rich.table.Table:
        """Make the table for the terminal, with lines between groups of rows and above a sum."""
        table = rich.table.Table(
            title=self.title or None, title_justify="left", show_lines=self.stacked
        )
        for number, header in enumerate(self.headers):
            justify = "left" if number < self.labels else "right"
            table.add_column(header, justify=justify, overflow="fold")
        parting = "\n" if self.stacked else " "
        for cells, last in zip(self.rows, self._ends(), strict=True):
            # `Text` keeps square brackets in a name from being markup.
            texts = (Text(_in_line(cell, parting)) for cell in cells)
            table.add_row(*texts, end_section=last)
        return table

    def _ends(self) -> list[bool]:
        """Return whether each row has a line below it: before a sum, and between groups of rows.

        With three or more labels, the first one names a group if rows share it.
        """
        first = [row[0] for row in self.rows]
        groups = self.labels > 2 and len(set(first)) < len(first)
        ends = [groups and one != other for one, other in itertools.pairwise(first)]
        return [*ends[: len(ends) - self.summed], *[True] * self.summed, False]

    def markdown(self) -> str:
        """Return the table as Markdown, with one line per row, ending in a newline."""
        rule = ["---"] * self.labels + ["---:"] * (len(self.headers) - self.labels)
        headers = [header.replace("\n", " ") for header in self.headers]
        rows = [headers, *(map(_in_line, cells) for cells in self.rows)]
        head, *body = ([text.replace("|", r"\|") for text in row] for row in rows)
        return "".join(f"| {' | '.join(cells)} |\n" for cells in [head, rule, *body])

    def latex(self) -> str:
        """Return the table as a LaTeX tabular for the package booktabs, ending in a newline.

        Cells of kind "best" are bold, and notes follow their texts in a smaller size.
        """
        numbers = len(self.headers) - self.labels
        head = []
        for number, header in enumerate(self.headers):
            lines = r" \\ ".join(_in_latex(line) for line in header.split("\n"))
            side = "l" if number < self.labels else "r"
            head.append(rf"\shortstack[{side}]{{{lines}}}" if "\n" in header else lines)
        lines = [f"\\begin{{tabular}}{{{'l' * self.labels}{'r' * numbers}}}", r"\toprule"]
        lines += [rf"{' & '.join(head)} \\", r"\midrule"]
        for cells, last in zip(self.rows, self._ends(), strict=True):
            texts = (_cell_in_latex(cell, i >= self.labels) for i, cell in enumerate(cells))
            lines += [rf"{' & '.join(texts)} \\", *[r"\midrule"] * last]
        title = [f"% {printable(self.title)}"] if self.title else []
        return "\n".join([*title, *lines, r"\bottomrule", r"\end{tabular}", ""])


def _in_line(cell: Cell, parting: str = " ") -> str:
    return parting.join((cell.text, *cell.note.split("\n"))).rstrip()


def _in_latex(text: str, is_number: bool = False) -> str:
    """Escape a text; in numbers, typeset minus signs and the dashes of intervals."""
    text = printable(text).translate(_IN_LATEX)
    if is_number:
        text = re.sub(r"(?<=\d)-(?=\d)", "--", text)
        text = re.sub(r"(?<![\w-])-(?=\d)", "$-$", text)
    return text


def _cell_in_latex(cell: Cell, is_number: bool) -> str:
    text, note = (_in_latex(each, is_number) for each in (cell.text, cell.note.replace("\n", " ")))
    text = rf"\textbf{{{text}}}" if cell.kind == "best" else text
    return rf"{text} {{\footnotesize {note.strip()}}}" if note.strip() else text


class RecallRow(NamedTuple):
    """One line of a table of recalls."""

    benchmark: str
    model: str
    """Description of the model, for instance "trained, seed 0"."""
    grouping: str
    """How images were grouped into batches, for instance "single" or "shuffled"."""
    recalls: Mapping[int, float]
    """Fraction of the queries, 0 to 1, by K."""


def recall_table(rows: Sequence[RecallRow], title: str = "") -> Table:
    """Make a table of recalls in percent, with one decimal; "-" for each K that a row lacks."""
    ks = sorted({k for row in rows for k in row.recalls})
    body = [
        [row.benchmark, row.model, row.grouping]
        + [f"{100 * row.recalls[k]:.1f}" if k in row.recalls else NOTHING for k in ks]
        for row in rows
    ]
    headers = ["data set", "model", "grouping", *(f"R@{k}" for k in ks)]
    return Table(headers, [list(map(Cell, cells)) for cells in body], labels=3, title=title)


def write_csv(path: pathlib.Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows with the same columns as CSV; None is an empty cell, and formulas are quoted."""
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
    """Write a UTF-8 file atomically; bytes of file names that are not UTF-8 become escapes."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace", newline="")
