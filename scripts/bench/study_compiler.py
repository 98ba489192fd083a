"""What XLA's options are worth on each supported version of JAX: which exist, help, or crash.

    python scripts/bench/study_compiler.py [--out docs/performance] [--page docs/performance.md]
        [--python OTHER/bin/python ...] [--rounds 2] [--cases "describe b14 float32 8 2" ...]

Each program is compiled and timed in a process of its own (`compiled_by.py`) with each library's
matrix products, with and without the other options that `utils/compiler.py` has, and as the package
chooses. The versions of JAX are those of the interpreters given, which take turns with this one.
A process that ends by a signal is tabled as that signal; an option that a version lacks, as absent.
"""

import itertools
import json
import os
import pathlib
import signal
import statistics
import subprocess
import sys
from typing import Any, NamedTuple

from tables import Study, Table, count, flags, leave, read

from crisalad_jax.utils import compiler
from crisalad_jax.utils.host import usable_cores

HERE = pathlib.Path(__file__).parent
PACKAGE = "the package's choice"
DEFAULT = "jaxlib's defaults"


class Program(NamedTuple):
    work: str
    preset: str
    dtype: str
    batch: int
    devices: int


def program(words: str) -> Program:
    work, preset, dtype, batch, devices = words.split()
    return Program(work, preset, dtype, int(batch), int(devices))


CORES = usable_cores()
CASES = [
    f"describe b14 float32 8 {CORES}",
    "describe b14 float32 1 1",
    f"describe b14 bfloat16 8 {CORES}",
    f"describe tiny float32 8 {CORES}",
    "train b14 float32 8 1",
    "train b14 bfloat16 8 1",
    "train tiny float32 16 1",
]


def choices(work: str) -> dict[str, dict[str, Any] | None]:
    """The options to try, by the name that the table has for them."""
    libraries = compiler.LIBRARIES
    found: dict[str, dict[str, Any] | None] = {DEFAULT: {}, **libraries}
    if work == "describe":
        for name, value in compiler.BRIEF.items():
            found[f"YNN, {name.removeprefix('xla_')}"] = libraries["YNN"] | {name: value}
    return {**found, PACKAGE: None}


def run(python: str, case: Program, options: dict[str, Any] | None) -> dict[str, Any]:
    """What `compiled_by.py` prints; `failed` instead, where it did not come to that."""
    asked = json.dumps(case._asdict() | {"options": options})
    path = os.pathsep.join([str(HERE.parents[1]), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [python, str(HERE / "compiled_by.py"), asked],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode == 0:
        return json.loads(done.stdout.splitlines()[-1])
    if done.returncode < 0:
        return {"failed": signal.Signals(-done.returncode).name}
    absent = "No such compile option" in done.stderr
    return {"failed": "absent" if absent else done.stderr.strip().splitlines()[-1]}


def version(python: str) -> str:
    printed = subprocess.run(
        [python, "-c", "import jax; print(jax.__version__)"], stdout=subprocess.PIPE, check=True
    )
    return printed.stdout.decode().strip()


def main() -> None:
    parser = flags(__doc__ or "", "docs/performance")
    parser.add_argument("--python", nargs="+", default=[], help="interpreters with other versions")
    parser.add_argument("--cases", nargs="+", type=program, default=[program(c) for c in CASES])
    parser.add_argument("--rounds", type=count, default=2)
    arguments = read(parser, "study_compiler")
    versions = {version(python): python for python in (sys.executable, *arguments.python)}
    values, rows = [], []
    for case in arguments.cases:
        tried = list(itertools.product(choices(case.work).items(), versions.items()))
        found: dict[tuple[str, str], list[dict[str, Any]]] = {}
        for _ in range(arguments.rounds):
            for (name, options), (jax, python) in tried:
                print(*case, name, jax, file=sys.stderr, flush=True)
                found.setdefault((name, jax), []).append(run(python, case, options))
        best = max(rate(runs) for runs in found.values())
        words = f"{case.work} {case.preset} {case.dtype}, {case.batch} on {case.devices}"
        for name in choices(case.work):
            runs = {jax: found[name, jax] for jax in versions}
            values.append({**case._asdict(), "options": name, "runs": runs})
            rows.append((words, name, *(cell(each, best) for each in runs.values())))
    caption = (
        "Programs by options of XLA and version of JAX: speed over the program's fastest, "
        f"seconds of the first call, MB. {processor()}, {CORES} cores; medians of "
        f"{arguments.rounds} rounds, taking turns."
    )
    table = Table(("program", "options", *(f"jax {v}" for v in versions)), rows, caption, 2)
    leave("study_compiler", Study(table, values), arguments)


def processor() -> str:
    lines = pathlib.Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))


def rate(runs: list[dict[str, Any]]) -> float:
    return statistics.median(each.get("rate", 0.0) for each in runs)


def cell(runs: list[dict[str, Any]], best: float) -> str:
    failed = [each["failed"] for each in runs if "failed" in each]
    if failed:
        return failed[0]
    first, memory = (statistics.median(e[key] for e in runs) for key in ("first", "megabytes"))
    return f"{rate(runs) / best:.2f}, {first:.1f} s, {memory:.0f} MB"


if __name__ == "__main__":
    main()
