"""Compare describing, training steps and starts with their peers, on each supported JAX version.

    python scripts/bench/bench_versions.py
        [--python OTHER/bin/python ...] [--presets tiny s14 b14] [--rounds 3]

It runs `bench_describe.py`, `bench_train.py` and `bench_start.py` with this interpreter and with
each other one, in turn; all need the `dev` and `bench` extras. Peers have the versions that pip
installed for each interpreter. `study_compiler.py` compares our versions with each other.
"""

import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
from typing import Any

from study_compiler import processor, version
from tables import Study, Table, count, flags, leave, read

from crisalad_jax.utils.host import usable_cores

HERE = pathlib.Path(__file__).parent
STARTS = ("ours, cold", "ours, warm")


def run(python: str, bench: str, *options: str) -> list[dict[str, Any]]:
    """Run a bench with an interpreter, and return its unrounded numbers."""
    root = os.pathsep.join([str(HERE.parents[1]), os.environ.get("PYTHONPATH", "")])
    with tempfile.TemporaryDirectory(prefix="bench-versions-") as out:
        command = [python, str(HERE / f"{bench}.py"), "--out", out, *options]
        print(*command, file=sys.stderr, flush=True)
        subprocess.run(command, env=os.environ | {"PYTHONPATH": root}, check=True)
        return json.loads((pathlib.Path(out) / f"{bench}.json").read_text())


def races(bench: str, values: list[dict[str, Any]]) -> dict[str, float]:
    """Return our speedup over the fastest other engine in each race of a bench, by medians."""
    found: dict[str, dict[str, float]] = {}
    for value in values:
        words = [value["model"]]
        if bench != "bench_start":
            words += [value["dtype"], str(value["batch"])]
        times = found.setdefault(", ".join(words), {})
        times[value["contender"]] = statistics.median(value["ms"])
    if bench == "bench_start":
        eager = "torch eager"
        found = {
            f"{words}, {ours.removeprefix('ours, ')}": {eager: times[eager], ours: times[ours]}
            for words, times in found.items()
            for ours in STARTS
        }
    return {words: _race(times) for words, times in found.items()}


def _race(times: dict[str, float]) -> float:
    ours = [ms for name, ms in times.items() if name.startswith("ours")]
    return min(ms for name, ms in times.items() if not name.startswith("ours")) / min(ours)


def main() -> None:
    parser = flags(__doc__ or "", "docs/performance")
    parser.add_argument("--python", nargs="+", default=[], help="interpreters with other versions")
    parser.add_argument("--presets", nargs="+", default=["tiny", "s14", "b14"])
    parser.add_argument("--rounds", type=count, default=3)
    arguments = read(parser, "bench_versions")
    pythons = {version(python): python for python in (sys.executable, *arguments.python)}
    rounds = ["--rounds", str(arguments.rounds)]
    sizes = ["--presets", *arguments.presets, "--batches", "8", *rounds]
    starts = [name for name in arguments.presets if name != "s14"]
    benches = {
        "bench_describe": [*sizes, "--dtypes", "float32", "bfloat16"],
        "bench_train": sizes,
        "bench_start": ["--preset", *starts, *rounds],
    }
    values, rows = [], []
    for bench, options in benches.items():
        found = {jax: races(bench, run(p, bench, *options)) for jax, p in pythons.items()}
        for words in next(iter(found.values())):
            faster = {jax: one[words] for jax, one in found.items()}
            values.append({"bench": bench, "race": words, "faster": faster})
            rows.append((bench, words, *(f"{each:.2f}" for each in faster.values())))
        header = ("bench", "what", *(f"jax {jax}" for jax in pythons))
        caption = (
            "Speedup over the fastest other engine (starts: over torch eager), by version of JAX. "
            f"{processor()}, {usable_cores()} cores; medians of {arguments.rounds} rounds."
        )
        leave("bench_versions", Study(Table(header, rows, caption, 2), values), arguments)


if __name__ == "__main__":
    main()
