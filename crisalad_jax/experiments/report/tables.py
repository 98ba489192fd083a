"""Recalls as tables, for the terminal and as Markdown."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from rich.table import Table
from rich.text import Text

from crisalad_jax.utils.errors import InputError


class RecallRow(NamedTuple):
    """One line of a table of recalls."""

    benchmark: str
    model: str
    """Which weights, for instance "trained, seed 0"."""
    grouping: str
    """How images were batched: single, shuffled or sequential."""
    recalls: Mapping[int, float]
    """K -> fraction of the queries, 0 to 1."""


def recall_table(rows: Sequence[RecallRow], title: str | None = None) -> Table:
    """Make a table for the terminal: a line per row, recalls in percent with one decimal.

    A line is ruled between data sets.

    Raises:
        InputError: no rows, or a recall outside 0 to 1.
    """
    header, body = _recall_cells(rows)
    table = Table(title=title, title_justify="left")
    for name in header:
        justify = "right" if name.startswith("R@") else "left"
        table.add_column(name, justify=justify, overflow="fold")
    for cells, following in zip(body, [*body[1:], None], strict=True):
        last = following is not None and following[0] != cells[0]
        # `Text` keeps square brackets in a name from being markup.
        table.add_row(*(Text(cell) for cell in cells), end_section=last)
    return table


def no_formula(text: str) -> str:
    """Put a quote before a text that a spreadsheet would take for a formula."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r")) else text


def recall_markdown(rows: Sequence[RecallRow]) -> str:
    """Write the same table as Markdown, one line per row, ending in a newline.

    Raises:
        InputError: what `recall_table` raises.
    """
    header, body = _recall_cells(rows)
    rule = ["---:" if name.startswith("R@") else "---" for name in header]
    escaped = [[cell.replace("|", r"\|") for cell in cells] for cells in body]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in [header, rule, *escaped])


def _recall_cells(rows: Sequence[RecallRow]) -> tuple[list[str], list[list[str]]]:
    if not rows:
        raise InputError("rows: found none, expected at least one row of recalls")
    for row in rows:
        check_fractions(f"{row.benchmark}, {row.model}", row.recalls)
    ks = sorted({k for row in rows for k in row.recalls})
    body = [
        [row.benchmark, row.model, row.grouping]
        + [f"{100 * row.recalls[k]:.1f}" if k in row.recalls else "-" for k in ks]
        for row in rows
    ]
    return ["data set", "model", "grouping", *(f"R@{k}" for k in ks)], body


def check_fractions(name: str, recalls: Mapping[int, float]) -> None:
    """Check that there are recalls, and that all lie within 0 to 1.

    Raises:
        InputError: there are none, or one is outside 0 to 1.
    """
    if not recalls:
        raise InputError(f"{name}: found no recalls, expected at least one")
    for at, value in recalls.items():
        if not 0 <= value <= 1:
            raise InputError(f"{name}: found recall {value} at {at}, expected a fraction, 0 to 1")
