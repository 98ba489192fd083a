"""Tables of compiled programs, for the terminal and for a page."""

import math
from collections.abc import Sequence

from rich.table import Table

from scripts.compile_check.check import CompileCheck, ProgramCheck

_NAMES = ("target", "program", "images")
_TAKES = (
    *("memory, GB", "TFLOP", "HBM, GB", "sent, MB", "roofline, ms", "compiler, ms"),
    *("kernels, ms", "messages, ms", "images/s"),
)
_MADE_OF = ("aliased, MB", "collectives", "bf16 sums", "fused attention", "host calls")
COLUMNS = (*_NAMES, *_TAKES, *_MADE_OF)
TAKES, MADE_OF = (*_NAMES, *_TAKES), (*_NAMES, *_MADE_OF)
LABELS = 2
"""Number of text columns, before those of numbers."""
_SHORT = {
    **{"all-reduce": "reduce", "all-gather": "gather", "reduce-scatter": "scatter"},
    **{"all-to-all": "to-all", "collective-permute": "permute"},
}


def cells(check: ProgramCheck) -> tuple[str, ...]:
    """Format a program in the columns of `COLUMNS`."""
    kinds = sorted(check.collectives.items())
    return (
        check.target,
        check.program,
        f"{check.images:,}",
        f"{check.memory / 1e9:.2f} of {check.card_memory / 1e9:.0f}",
        _digits(check.flops / 1e12),
        _digits(check.hbm_bytes / 1e9),
        _digits(check.sent / 1e6),
        _digits(1e3 * check.roofline),
        "-" if check.compiler is None else _digits(1e3 * check.compiler),
        "-" if check.kernels is None else _digits(1e3 * check.kernels),
        _digits(1e3 * check.messages),
        f"{rounded(check.images_per_second):,}",
        f"{check.aliased / 1e6:.0f}",
        ", ".join(f"{n} {_SHORT.get(kind, kind)}" for kind, n in kinds) or "-",
        str(check.bfloat16_sums),
        str(check.fused_attention),
        str(check.host_callbacks),
    )


def rounded(value: float) -> int:
    """Round to two significant digits; the model of time is less accurate than that."""
    digits = 10 ** max(0, math.floor(math.log10(value)) - 1) if value >= 1 else 1
    return round(value / digits) * digits


def _digits(value: float) -> str:
    return f"{value:.3g}" if 0 < value < 1000 else f"{value:.0f}"


def check_tables(check: CompileCheck) -> list[Table]:
    """Make the tables for the terminal: the resources of each program, and its operations."""
    return [_table(check, columns) for columns in (TAKES, MADE_OF)]


def _table(check: CompileCheck, columns: Sequence[str]) -> Table:
    table = Table()
    for name in columns:
        table.add_column(
            name, justify="left" if COLUMNS.index(name) < LABELS else "right", overflow="fold"
        )
    for each in check.programs:
        row = dict(zip(COLUMNS, cells(each), strict=True))
        table.add_row(*(row[name] for name in columns))
    return table


def markdown_table(programs: Sequence[ProgramCheck], columns: Sequence[str] = COLUMNS) -> str:
    """Format the table, or some of its columns, as Markdown."""
    chosen = [COLUMNS.index(name) for name in columns]
    rule = ["---" if position < LABELS else "---:" for position in chosen]
    rows = [[COLUMNS[position] for position in chosen], rule]
    rows += [[cells(each)[position] for position in chosen] for each in programs]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)
