"""Test XLA's options on each supported version of JAX: which exist, help, or crash.

    python scripts/bench/study_compiler.py
        [--python OTHER/bin/python ...] [--rounds 3] [--cases "describe b14 float32 8 2" ...]

Each program is compiled and timed in a separate process (`compiled_by.py`) with each library for
matrix products, and with other options that helped some program or version. The package uses the
defaults, and for describing the schedule with the least memory. The versions of JAX are those of
the given interpreters, one after another. If options crash the process, each is tried on its own,
and the table shows the signal that ended it; an option that a version lacks is shown as absent.
"""

import json
import os
import pathlib
import signal
import statistics
import subprocess
import sys
from typing import Any, NamedTuple

from libraries import LIBRARIES
from tables import Study, Table, count, flags, leave, read

from crisalad_jax.utils.host import usable_cores

HERE = pathlib.Path(__file__).parent
DEFAULT = "jaxlib's defaults"
CHOICES: dict[str, dict[str, Any]] = {
    DEFAULT: {},
    **LIBRARIES,
    "defaults, ordered for the least memory": {
        "xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"
    },
    "defaults, sums not in windows": {"xla_disable_hlo_passes": "tree_reduction_rewriter"},
}


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
    f"describe s14 float32 8 {CORES}",
    f"describe tiny float32 8 {CORES}",
    "train b14 float32 8 1",
    "train s14 float32 8 1",
    "train tiny float32 16 1",
]


def run(python: str, case: Program, choices: dict[str, Any], rounds: int) -> dict[str, Any]:
    """Run `compiled_by.py`, and return its results by choice; `failed` for those that crashed."""
    asked = json.dumps(case._asdict() | {"choices": choices, "rounds": rounds})
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
    if len(choices) > 1:
        each = [run(python, case, {name: value}, rounds) for name, value in choices.items()]
        return {name: found for one in each for name, found in one.items()}
    if done.returncode < 0:
        failed = signal.Signals(-done.returncode).name
    elif "No such compile option" in done.stderr:
        failed = "absent"
    else:
        failed = done.stderr.strip().splitlines()[-1]
    return {name: {"failed": failed} for name in choices}


def version(python: str) -> str:
    printed = subprocess.run(
        [python, "-c", "import jax; print(jax.__version__)"], stdout=subprocess.PIPE, check=True
    )
    return printed.stdout.decode().strip()


def main() -> None:
    parser = flags(__doc__ or "", "docs/performance")
    parser.add_argument("--python", nargs="+", default=[], help="interpreters with other versions")
    parser.add_argument("--cases", nargs="+", type=program, default=[program(c) for c in CASES])
    parser.add_argument("--rounds", type=count, default=3)
    arguments = read(parser, "study_compiler")
    versions = {version(python): python for python in (sys.executable, *arguments.python)}
    values, rows = [], []
    for case in arguments.cases:
        found = {}
        for jax, python in versions.items():
            print(*case, jax, file=sys.stderr, flush=True)
            found[jax] = run(python, case, CHOICES, arguments.rounds)
        best = {jax: max(map(rate, runs.values())) for jax, runs in found.items()}
        words = f"{case.work} {case.preset} {case.dtype}, {case.batch} on {case.devices}"
        for name in CHOICES:
            values.append({**case._asdict(), "options": name, **{v: found[v][name] for v in found}})
            cells = (cell(runs[name], best[jax]) for jax, runs in found.items())
            rows.append((words, name, *cells))
        rows.append(
            (words, "images per second of the fastest", *(f"{b:.3g}" for b in best.values()))
        )
    caption = (
        "Programs by XLA options and JAX version: speed relative to the fastest options, seconds "
        f"of the first call, MB. {processor()}, {CORES} cores; "
        f"medians of {arguments.rounds} rounds."
    )
    table = Table(("program", "options", *(f"jax {v}" for v in versions)), rows, caption, 2)
    leave("study_compiler", Study(table, values), arguments)


def processor() -> str:
    lines = pathlib.Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))


def rate(found: dict[str, Any]) -> float:
    return statistics.median(found.get("rates", [0.0]))


def cell(found: dict[str, Any], best: float) -> str:
    if "failed" in found:
        return found["failed"]
    return f"{rate(found) / best:.2f}, {found['first']:.1f} s, {found['megabytes']:.0f} MB"


if __name__ == "__main__":
    main()
