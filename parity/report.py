"""Format the table for the terminal, JSON and Markdown."""

import dataclasses
import math
import pathlib
import platform
from collections.abc import Mapping, Sequence
from importlib import metadata
from typing import Any

import rich.box
import rich.table

from crisalad_jax.utils.files import atomic_path, write_json
from parity.compare import Row

PACKAGES = ("jax", "optax", "torch", "numpy")
COLUMNS = ("layer", "what", "worst array", "shape", "max abs", "relative", "tolerance", "verdict")


def versions() -> dict[str, str]:
    """Return the versions that the numbers were measured with."""
    found = {name: metadata.version(name) for name in PACKAGES}
    return {"python": platform.python_version(), "machine": platform.machine(), **found}


def terminal_table(rows: Sequence[Row], precision: str) -> rich.table.Table:
    """Make the table of one precision, with misses highlighted."""
    table = rich.table.Table(
        *COLUMNS, title=f"{precision}: JAX against the torch reference", box=rich.box.SIMPLE_HEAD
    )
    for column in table.columns[4:7]:
        column.justify = "right"
    for row in rows:
        if row.precision == precision:
            table.add_row(*_cells(row), style=None if row.passed else "bold red")
    return table


def verdict(rows: Sequence[Row]) -> str:
    """Summarise all rows in one line."""
    missed = sum(not row.passed for row in rows)
    return f"{len(rows)} rows, {missed or 'none'} missed"


def _cells(row: Row) -> tuple[str, ...]:
    return (
        row.case,
        row.quantity,
        row.worst if row.arrays == 1 else f"{row.worst} (of {row.arrays})",
        " x ".join(map(str, row.shape)) or "scalar",
        f"{row.max_abs:.1e}",
        f"{row.relative:.1e}",
        f"{row.tolerance:.1e}",
        "pass" if row.passed else "MISS",
    )


def write_report(folder: pathlib.Path, rows: Sequence[Row], settings: Mapping[str, Any]) -> None:
    """Write `parity.json` and `parity.md` into `folder`, which is created if needed.

    Raises:
        InputError: the files can't be created there.
    """
    found = versions()
    document = {
        "passed": all(row.passed for row in rows),
        "settings": dict(settings),
        "versions": found,
        "rows": [_plain(row) for row in rows],
    }
    write_json(folder / "parity.json", document)
    with atomic_path(folder / "parity.md") as temporary:
        temporary.write_text(_markdown(rows, settings, found), encoding="utf-8")


def _plain(row: Row) -> dict[str, Any]:
    plain = dataclasses.asdict(row) | {"passed": row.passed}
    for name in ("max_abs", "relative", "tolerance"):  # JSON has no infinity
        plain[name] = plain[name] if math.isfinite(plain[name]) else None
    return plain


def _markdown(rows: Sequence[Row], settings: Mapping[str, Any], found: Mapping[str, str]) -> str:
    lines = [
        "# Numerical parity: JAX against the torch reference",
        "",
        f"**{verdict(rows)}.** Written by `python -m parity`; "
        + ", ".join(f"{name} {value}" for name, value in {**settings, **found}.items())
        + ".",
        "",
        "Relative error is the norm of the difference over the norm of the reference's array. A "
        "row shows the array with the largest relative error of those it covers; max abs is the "
        "largest difference in that array.",
    ]
    for precision in dict.fromkeys(row.precision for row in rows):
        chosen = [row for row in rows if row.precision == precision]
        lines += ["", f"## {precision}: {verdict(chosen)}", ""]
        lines += [_line(COLUMNS), _line(["---"] * 4 + ["---:"] * 3 + ["---"])]
        lines += [_line(_cells(row)) for row in chosen]
        lines += ["", "Why these tolerances:", ""]
        reasons: dict[str, list[float]] = {}
        for row in chosen:
            reasons.setdefault(row.why, []).append(row.tolerance)
        for why, values in reasons.items():
            low, high = min(values), max(values)
            value = f"{low:.1e}" if low == high else f"{low:.1e} to {high:.1e}"
            lines.append(f"- **{value}**: {why}.")
        notes = {f"{row.case}, {row.quantity}": row.note for row in chosen if row.note}
        if notes:
            lines += ["", "Notes:", ""] + [f"- {where}: {note}." for where, note in notes.items()]
    return "\n".join(lines) + "\n"


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
