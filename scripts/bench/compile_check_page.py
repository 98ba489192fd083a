"""Tabulate the figures of `scripts/compile_check`.

    python scripts/bench/compile_check_page.py [--figures docs/accelerators] [--page PAGE.md]

`compile_check.sh` produces the figures. Machines without figures are left out of the page.
"""

import argparse
import json
import math
import pathlib
import statistics
from collections.abc import Callable, Mapping, Sequence

from tables import Table, markdown

from crisalad_jax.experiments.tables import write_text
from scripts.compile_check import ProgramCheck, read_check
from scripts.compile_check.tables import (
    COLUMNS,
    LABELS,
    MADE_OF,
    TAKES,
    cells,
    rounded,
)

FILES = ("compile_check.json", "grown-64.json", "grown-256.json")
"""192 images on every machine; then 24 images a chip on 64 and on 256."""
# Measured the same way at commit e070138, where training failed for GPUs with cuDNN's attention.
FAILS = "fails; {} without fused attention"
BEFORE: Sequence[tuple[str, str, str, str, Callable[[ProgramCheck], float]]] = (
    ("v5e-8 train", "compiler, ms", "77.8", "50", lambda x: 1e3 * (x.compiler or 0)),
    ("v5e-1 describe", "compiler, ms", "332", "180", lambda x: 1e3 * (x.compiler or 0)),
    ("v6e-8 train", "compiler, ms", "36.1", "", lambda x: 1e3 * (x.compiler or 0)),
    ("h100 train", "roofline, ms", FAILS.format(96.6), "60", lambda x: 1e3 * x.roofline),
    ("h100-8 train", "roofline, ms", FAILS.format(12.7), "8.5", lambda x: 1e3 * x.roofline),
    ("v5e-1 train", "memory, GB", "16.5", "16, with room", lambda x: x.memory / 1e9),
    ("v5e-8 train", "memory, GB", "2.26", "", lambda x: x.memory / 1e9),
    ("h100 train", "memory, GB", FAILS.format(12.3), "", lambda x: x.memory / 1e9),
    ("v5e-8 train", "collectives", "105", "", lambda x: sum(x.collectives.values())),
    ("v5e-8 train", "sums in bfloat16", "4", "0", lambda x: x.bfloat16_sums),
)


def figures(programs: Sequence[ProgramCheck], columns: Sequence[str], caption: str) -> Table:
    chosen = [COLUMNS.index(name) for name in columns]
    rows = [tuple(cells(each)[position] for position in chosen) for each in programs]
    return Table(tuple(columns), rows, caption, LABELS)


def before_and_after(programs: Mapping[str, ProgramCheck]) -> Table:
    rows = [
        (name, what, before, goal, f"{figure(programs[name]):.3g}")
        for name, what, before, goal, figure in BEFORE
        if name in programs
    ]
    caption = "All figures were counted the same way."
    return Table(("program", "figure", "before", "goal", "now"), rows, caption, 2)


def scaling(programs: Mapping[str, ProgramCheck]) -> Table:
    """Tabulate the speedup of more devices on the same batch."""
    rows = []
    for few, many, devices in (
        ("h100", "h100-8", 8),
        ("v5e-1", "v5e-8", 8),
        ("v5e-8", "v5e-64", 8),
    ):
        if not programs.keys() >= {f"{few} train", f"{many} train"}:
            continue
        one, more = programs[f"{few} train"], programs[f"{many} train"]
        gain = more.images_per_second / one.images_per_second
        memory = f"{one.memory / 1e9:.2f} to {more.memory / 1e9:.2f}"
        share = more.messages * more.images_per_second / more.images
        rows.append(
            (
                f"{few} to {many}",
                f"{rounded(one.images_per_second):,} to {rounded(more.images_per_second):,}",
                f"{gain:.1f}",
                f"{100 * gain / devices:.0f} %",
                f"{100 * share:.0f} %",
                memory,
            )
        )
    header = ("machines", "images/s", "speedup", "efficiency", "messages", "memory, GB")
    return Table(header, rows, "Training on 192 images.", 1)


def loader(programs: Mapping[str, ProgramCheck], measured: pathlib.Path) -> Table:
    """Tabulate how many cores load images as fast as training consumes them."""
    rates = {
        each["size"]: 1e3 / statistics.median(each["ms"])
        for each in json.loads(measured.read_text())
        if each["contender"] == "ours" and each["cores"] == 1
    }
    rows = []
    for name in ("h100", "h100-8", "v5e-1", "v5e-8", "v6e-8"):
        if f"{name} train" not in programs:
            continue
        wanted = programs[f"{name} train"].images_per_second
        cores = (str(math.ceil(wanted / rate)) for rate in rates.values())
        rows.append((name, f"{rounded(wanted):,}", *cores))
    header = ("machine", "images/s", *(f"cores, {size}" for size in rates))
    words = ", ".join(f"{rate:.0f} from {size}" for size, rate in rates.items())
    caption = f"Images per second loaded by one core: {words}."
    return Table(header, rows, caption, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--figures", type=pathlib.Path, default=pathlib.Path("docs/accelerators"))
    parser.add_argument(
        "--page", type=pathlib.Path, default=pathlib.Path("docs/accelerators/programs.md")
    )
    arguments = parser.parse_args()
    there = [arguments.figures / name for name in FILES if (arguments.figures / name).exists()]
    usual, *grown = (read_check(path).programs for path in there)
    by_name = {f"{each.target} {each.program}": each for each in usual}
    larger = [each for programs in grown for each in programs if each.program == "train"]
    larger = [by_name[name] for name in ("v5e-8 train", "v5e-64 train") if name in by_name] + larger
    measured = pathlib.Path(__file__).parents[2] / "docs" / "training" / "bench_loader.json"
    versions = read_check(arguments.figures / FILES[0]).versions
    compilers = ", ".join(f"{name} {version}" for name, version in versions.items())
    tables = {
        "Time and memory": figures(usual, TAKES, f"Figures per device ({compilers})."),
        "Operations": figures(usual, MADE_OF, ""),
        "Before and after": before_and_after(by_name),
        "More devices": scaling(by_name),
        "More devices and images": figures(larger, TAKES, "Training."),
        "Cores for loading": loader(by_name, measured),
    }
    if len(larger) == 1:  # nothing larger than the reference was compiled
        del tables["More devices and images"]
    sections = (f"## {title}\n\n{markdown(table)}" for title, table in tables.items())
    write_text(arguments.page, "\n".join(["# Programs compiled for accelerators\n", *sections]))


if __name__ == "__main__":
    main()
