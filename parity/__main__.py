"""`python -m parity`: compare every layer and whole training runs with the torch reference.

Exit codes: 0 if all rows are within tolerance, 1 if a row missed, 2 for bad arguments.
"""

import dataclasses
import pathlib
import sys
from collections.abc import Callable, Sequence

import rich.console
import tyro

from crisalad_jax.config.checks import choose
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import check_target
from crisalad_jax.utils.progress import progress_bar
from parity.cases import checks
from parity.compare import PRECISIONS, Row
from parity.full_size import full_size_checks
from parity.published import published_checks
from parity.report import terminal_table, verdict, write_report


@dataclasses.dataclass(frozen=True)
class Parity:
    """Compare crisalad_jax with its torch reference, in a table of errors and tolerances."""

    precision: str = ",".join(PRECISIONS)
    """Comma-separated precisions."""
    full_size: bool = False
    """Also compare ViT-B/14 with random weights, at 224 x 224, 322 x 322 and 224 x 308; and in
    float32 each published network with outputs of its authors' code. Needs up to 6 GB."""
    only: str = ""
    """Only rows whose name contains this, ignoring case."""
    seed: int = 0
    """Seed of weights and inputs."""
    out: pathlib.Path = pathlib.Path("parity-report")
    """Folder for parity.json and parity.md."""


Work = dict[tuple[str, str], Callable[[], list[Row]]]


def _plan(arguments: Parity) -> Work:
    """Collect the checks to run, by precision and name.

    Raises:
        InputError: an unknown precision, a negative seed, no row of this name in any of the
            precisions, or a folder that can't be created.
    """
    if arguments.seed < 0:
        raise InputError(f"--seed: found {arguments.seed}, expected at least 0")
    check_target(arguments.out / "parity.json")
    check_target(arguments.out / "parity.md")
    work: Work = {}
    for precision in arguments.precision.split(","):
        choose("--precision", precision, dict.fromkeys(PRECISIONS))
        found = checks(precision, arguments.seed)
        if arguments.full_size:
            found |= full_size_checks(precision, arguments.seed)
            found |= published_checks() if precision == "float32" else {}
        for name, check in found.items():
            if arguments.only.lower() in name.lower():
                work[precision, name] = check
    if not work:
        raise InputError(
            f"--only: found {arguments.only!r}, which is in the name of nothing that is compared "
            f"in {arguments.precision}"
        )
    return work


def _run(work: Work) -> list[Row]:
    rows: list[Row] = []
    with progress_bar("parity", len(work), "checks", quiet=False) as bar:
        for precision, name in list(work):
            bar.advance(0, f"{precision}: {name}")
            # Popped to free full-size weights before those of the next precision are made.
            rows += work.pop((precision, name))()
            bar.advance(1)
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command, and return its exit code."""
    try:
        settings = tyro.cli(Parity, prog="python -m parity", args=arguments)
    except SystemExit as stop:  # 2 after an error, 0 after --help
        return int(stop.code or 0)
    try:
        work = _plan(settings)
    except InputError as error:
        print("parity:", error, file=sys.stderr)
        return 2
    rows = _run(work)
    console = rich.console.Console(width=None if sys.stdout.isatty() else 200)
    for precision in dict.fromkeys(row.precision for row in rows):
        console.print(terminal_table(rows, precision))
    shown = {"precision": settings.precision, "seed": settings.seed}
    shown |= {"only": settings.only} if settings.only else {}
    write_report(settings.out, rows, shown)
    console.print(f"{verdict(rows)}. Written to {settings.out}: parity.md, parity.json")
    return 0 if all(row.passed for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
