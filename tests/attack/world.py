"""What all attacks share: a world of small data sets, every verb's command, forks, and a report.

A process that has imported everything, and that has started no device, forks for each command. A
command then takes some hundredths of a second where it fails early.
"""

import argparse
import contextlib
import dataclasses
import fcntl
import functools
import importlib
import json
import os
import pathlib
import random
import resource
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from crisalad_jax.config.io import to_plain
from crisalad_jax.nn.model import Model
from crisalad_jax.utils.files import write_json

ROOT = pathlib.Path(__file__).parents[2]
COMMANDS: Mapping[str, str] = {
    "train": "train --data @city --out OUT/run --quiet --config @recipe.json "
    "--weights @weights.safetensors --val @town --patience None",
    "evaluate": "evaluate --data @town --weights @weights.safetensors --quiet --batch-size 4 "
    "--seeds 1 --json OUT/table.json --out OUT/pictures --report OUT/report",
    "extract .npy": "extract --weights @weights.safetensors --images @images --quiet "
    "--batch-size 4 --out OUT/d.npy",
    "extract .h5": "extract --weights @weights.safetensors --images @images --quiet "
    "--batch-size 4 --out OUT/d.h5",
    "pairs": "pairs --map @map --out OUT/pairs.txt --overlap 2 --quiet",
    "index": "index --weights @weights.safetensors --images @images --quiet --out OUT/map "
    "--batch-size 4",
    "query": "query @images --map @map --quiet --json OUT/answers.json --gallery OUT/gallery.png",
    "pca": "pca --descriptors @d.npy --dim 3 --quiet --out OUT/pca.safetensors",
    "export": "export --weights @weights.safetensors --out OUT/program",
    "export .onnx": "export --weights @weights.safetensors --out OUT/onnx --format onnx",
    "convert": "convert @weights.safetensors OUT/public.pth --format reference",
    "info": "info --weights @weights.safetensors --json OUT/info.json",
    "compare": "compare --train @city --test @town --preset tiny --methods gem --seeds 1 "
    "--epochs 1 --image-size 98 98 --out OUT/comparison --quiet",
    "render": "render --out OUT/world --scenes 12 --test-scenes 3 --image-size 30 40 --quiet",
    "demo": "demo --out OUT/demo --quiet",
    "vocabulary": "vocabulary --images @images --out OUT/v.safetensors --preset tiny "
    "--image-size 98 98 --clusters 4 --quiet --aggregator netvlad",
    "ablate": "ablate --train @city --test @town --preset tiny --rows gem --seeds 1 --epochs 1 "
    "--image-size 98 98 --out OUT/ablation --quiet",
}
"""Commands that write files into OUT; `@` is what `World.path` returns."""
VERBS = tuple(name for name in COMMANDS if name not in ("vocabulary", "ablate", "export .onnx"))
"""All but three that take as long as others and do much the same."""
PRODUCTS: Mapping[str, str] = {
    "d.npy": "extract .npy",
    "d.h5": "extract .h5",
    "map": "index",
    "pca.safetensors": "pca",
    "program": "export",
    "onnx": "export .onnx",
    "run": "train",
    "comparison": "compare",
}
"""What other verbs read or attacks change, and the verb that makes it."""


@dataclasses.dataclass(frozen=True)
class World:
    """Files and folders that commands read; no command writes into them."""

    root: pathlib.Path

    def path(self, name: str) -> pathlib.Path:
        """Return a path: one of the files of `make_world`, or a product, made where it is not."""
        made = self.root / name
        if made.exists():
            return made
        product = self.root / "products" / name
        if not product.exists():
            done = run(arguments(PRODUCTS[name], self, product.parent), cwd=self.root)
            assert done.code == 0, (name, done.err)
        return product


def make_world(root: pathlib.Path) -> World:
    """Write a training set (city), an evaluation set (town), images, weights and a recipe."""
    from tests import conftest

    def make() -> int:
        from crisalad_jax.checkpoints.weights import save_weights

        conftest.write_city(root / "city")
        conftest.write_town(root / "town")
        for number in range(8):
            conftest.write_picture(root / "images" / "sub" / f"{number}.jpg", number)
        write_json(root / "recipe.json", to_plain(conftest.RECIPE))
        model = conftest.MODEL
        save_weights(root / "weights.safetensors", Model(conftest.random_params(model), model))
        return 0

    root.mkdir(parents=True, exist_ok=True)
    done = forked(make, cwd=root)  # it uses JAX
    assert done.code == 0, done.err
    return World(root)


def arguments(verb: str, world: World, out: pathlib.Path) -> list[str]:
    """Return the command of a verb that writes into a folder."""
    return [
        str(world.path(word[1:])) if word[0] == "@" else word.replace("OUT", str(out))
        for word in COMMANDS[verb].split()
    ]


def with_flag(given: Sequence[str], flag: str, *values: str) -> list[str]:
    """Give a flag other values, in place of those it has."""
    given = list(given)
    if flag in given:
        start = given.index(flag)
        end = start + 1
        while end < len(given) and not given[end].startswith("--"):
            end += 1
        del given[start:end]
    return [*given, flag, *values]


def one_line(err: str) -> bool:
    """Return whether a command said one line of ours beside notes."""
    lines = [line for line in err.splitlines() if not line.startswith("crisalad: note: ")]
    return len(lines) == 1 and lines[0].startswith("crisalad: ")


class Done(NamedTuple):
    """What a command did."""

    code: int
    """Its exit code; minus the number of the signal that ended it; 1000 where it hung."""
    out: str
    err: str
    seconds: float
    peak_bytes: int
    """Largest resident memory beyond that of the process it was forked from."""

    def told_in_one_line(self) -> bool:
        """Return whether it failed as a command should: code 2, one line beside notes."""
        return self.code == 2 and one_line(self.err)


HUNG = 1000


def import_everything() -> None:
    """Import the command line and all that its verbs import, without starting a device."""
    from crisalad_jax import cli

    for name in cli._COMMANDS:
        importlib.import_module(f"crisalad_jax.cli.{name.replace('-', '_')}")
    for name in (
        *("faiss", "h5py", "matplotlib.pyplot", "optax", "orbax.checkpoint", "tyro"),
        *("crisalad_jax.checkpoints.export", "crisalad_jax.experiments.demo"),
        *("crisalad_jax.experiments.report", "crisalad_jax.experiments.train"),
        *("crisalad_jax.experiments.comparison", "crisalad_jax.retrieval.extract"),
    ):
        importlib.import_module(name)


def run(given: Sequence[str], *, cwd: pathlib.Path, **options: Any) -> Done:
    """Run a command of the command line in a forked process, as `forked` does."""
    return forked(lambda: command(given), cwd=cwd, **options)


def command(given: Sequence[str], ready: Callable[[], None] = lambda: None) -> int:
    """Run a command in this process, as the program `crisalad` does; return its exit code.

    The demo, which has no flags for that, is a smaller one.

    Args:
        given: its arguments.
        ready: called as soon as signals are handled.
    """
    from crisalad_jax.__main__ import keep_on_without_reader
    from crisalad_jax.cli import main
    from crisalad_jax.experiments import demo
    from crisalad_jax.utils.signals import end_at_signals

    small = {"train_places": 24, "test_places": 12, "epochs": 2}
    demo.DemoConfig = functools.partial(demo.DemoConfig, **small)
    end_at_signals()
    keep_on_without_reader()
    ready()
    code = main(list(given))
    sys.stdout.flush()
    return code


def forked(
    work: Callable[[], int],
    *,
    cwd: pathlib.Path,
    limit: float = 120,
    memory: int | None = None,
    during: Callable[[int], None] | None = None,
) -> Done:
    """Run a function in a process of its own, and wait for its end.

    Args:
        work: returns the exit code. An exception ends the process as it ends Python.
        cwd: the folder that it runs in.
        limit: seconds until it counts as hung, and is killed.
        memory: most bytes of address space beyond those it starts with.
        during: called with the number of the process as soon as that runs.
    """
    pipes = [os.pipe() for _ in range(2)]
    started = time.monotonic()
    process = os.fork()
    if process == 0:
        _child(work, cwd, memory, [writing for _, writing in pipes])
    watcher = os.pidfd_open(process)
    for reading, writing in pipes:
        os.close(writing)
        fcntl.fcntl(reading, fcntl.F_SETPIPE_SZ, LONGEST_OUTPUT)
        os.set_blocking(reading, False)
    try:
        if during is not None:
            during(process)
        left = limit - (time.monotonic() - started)
        ended, _, _ = select.select([watcher], [], [], max(left, 1))
        if not ended:
            os.kill(process, signal.SIGKILL)
        _, status, usage = os.wait4(process, 0)
        out, err = (_read(reading) for reading, _ in pipes)
    finally:
        for each in (watcher, *(reading for reading, _ in pipes)):
            os.close(each)
    code = os.waitstatus_to_exitcode(status) if ended else HUNG
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    peak = max(0, usage.ru_maxrss - base) * 1024
    return Done(code, out, err, time.monotonic() - started, peak)


LONGEST_OUTPUT = 2**20
"""A command that writes more than these bytes hangs."""


def _read(pipe: int) -> str:
    """Read what is in a pipe, which a grandchild may hold open."""
    try:
        return os.read(pipe, LONGEST_OUTPUT).decode(errors="replace")
    except BlockingIOError:
        return ""


def _child(
    work: Callable[[], int], cwd: pathlib.Path, memory: int | None, outputs: Sequence[int]
) -> None:
    """Do the work, and end this process."""
    code = 1
    try:
        for number, output in enumerate(outputs, start=1):
            os.dup2(output, number)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        sys.stdout = os.fdopen(1, "w", closefd=False)
        sys.stderr = os.fdopen(2, "w", closefd=False, errors="backslashreplace")
        os.chdir(cwd)
        if memory is not None:
            pages = int(pathlib.Path("/proc/self/statm").read_text().split()[0])
            most = pages * resource.getpagesize() + memory
            resource.setrlimit(resource.RLIMIT_AS, (most, most))
        code = work()
    except BaseException:
        import traceback

        with contextlib.suppress(BaseException):
            traceback.print_exc()
    finally:
        with contextlib.suppress(BaseException):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def files_in(folder: pathlib.Path) -> set[str]:
    """List all files and empty folders in a folder by their relative paths."""
    return {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file() or (path.is_dir() and not any(path.iterdir()))
    }


def has_temporaries(folder: pathlib.Path) -> list[str]:
    """List what a writer would have left: temporary names and locks."""
    return sorted(name for name in files_in(folder) if ".crisalad-" in name)


def without_times(value: Any) -> Any:
    """Leave out of JSON values what depends on the clock: all else is equal in two runs."""
    times = ("images_per_second", "waited_for_images", "seconds", "step_seconds", "added")
    if isinstance(value, dict):
        return {k: without_times(v) for k, v in value.items() if k not in (*times, "checksum")}
    return [without_times(each) for each in value] if isinstance(value, list) else value


def differences(found: Mapping[str, Any], expected: Mapping[str, Any]) -> list[str]:
    """List the names of files that two runs have not alike."""
    both = found.keys() & expected.keys()
    names = sorted(found.keys() | expected.keys())
    return [name for name in names if name not in both or found[name] != expected[name]]


def picture_bytes(suffix: str = ".png") -> bytes:
    """Return a small picture."""
    done, data = cv2.imencode(suffix, np.full((8, 8, 3), 90, np.uint8))
    assert done
    return data.tobytes()


@dataclasses.dataclass
class Row:
    """A line of the report: what was tried, how often, and what failed."""

    attack: str
    promise: str
    """What holds, in words."""
    tries: int = 0
    failures: list[str] = dataclasses.field(default_factory=list)
    """A line for each try that failed."""

    def note(self, right: bool, words: str) -> None:
        """Count a try, and its words if it failed."""
        self.tries += 1
        if not right:
            self.failures.append(words)


def write_rows(path: pathlib.Path, rows: Sequence[Row]) -> None:
    """Add rows to a report, in place of earlier ones of the same attacks."""
    there = []
    if path.exists():
        there = json.loads(path.read_text())["rows"]
    names = {row.attack for row in rows}
    kept = [row for row in there if row["attack"] not in names]
    write_json(path, {"rows": [*kept, *map(dataclasses.asdict, rows)]})


@dataclasses.dataclass
class Bench:
    """What the attacks of a script work with."""

    world: World
    folder: pathlib.Path
    random: random.Random
    seed: int
    environment: Mapping[str, str]
    """Of programs of their own."""
    say: Callable[[str], None]

    def program(self, given: Sequence[str]) -> subprocess.Popen[bytes]:
        """Start the command line as users do."""
        return subprocess.Popen(
            [sys.executable, "-m", "crisalad_jax", *given],
            cwd=ROOT,
            env={**os.environ, **self.environment},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )


Attack = Callable[[Bench, float], list[Row]]
"""Returns rows; the number is the part of the full count of tries."""


def part_of(count: int, scale: float, least: int = 1) -> int:
    """Return a part of the full count of tries."""
    return max(least, round(scale * count))


def keep_programs(folder: pathlib.Path) -> dict[str, str]:
    """Keep all compiled programs of this process' children in a folder: a child starts sooner.

    Returns:
        The environment that makes other processes do the same.
    """
    import jax

    values = {
        "jax_compilation_cache_dir": str(folder),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_num_cpu_devices": 1,
    }
    for name, value in values.items():
        jax.config.update(name, value)
    return {name.upper(): str(value) for name, value in values.items()}


def carry_out(
    attacks: Mapping[str, Attack],
    document: str | None,
    *,
    optional: Sequence[str] = (),
    keep: bool = True,
) -> int:
    """Run the attacks that the arguments choose, write their rows, and return the exit code.

    Args:
        attacks: by name.
        document: the script's docstring.
        optional: names of attacks that run only if they are chosen.
        keep: whether commands share what they compile.
    """
    parser = argparse.ArgumentParser(description=(document or "").splitlines()[0])
    parser.add_argument("--out", type=pathlib.Path, required=True, help="report to add rows to")
    parser.add_argument(
        "--scale", type=float, default=1.0, help="part of the full counts; 0 for a handful"
    )
    parser.add_argument("--seed", type=int, default=0)
    usual = [name for name in attacks if name not in optional]
    parser.add_argument("--only", nargs="+", choices=attacks, default=usual)
    given = parser.parse_args()
    for number in (signal.SIGINT, signal.SIGHUP):  # ignored under nohup and in the background
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
    begun, failures = time.monotonic(), 0

    def say(line: str) -> None:
        print(f"[{time.monotonic() - begun:5.0f} s] {line}", file=sys.stderr, flush=True)

    import_everything()
    with tempfile.TemporaryDirectory() as temporary:
        folder = pathlib.Path(temporary)
        kept = keep_programs(folder / "programs") if keep else {}
        environment = kept | {"PYTHONPATH": str(ROOT)}
        world = make_world(folder / "world")
        bench = Bench(world, folder, random.Random(given.seed), given.seed, environment, say)
        for name in given.only:
            rows = attacks[name](bench, given.scale)
            write_rows(given.out, rows)
            for row in rows:
                say(f"{row.attack}: {row.tries} tries, {len(row.failures)} failures")
                for line in row.failures:
                    say(f"    {line}")
                failures += len(row.failures)
    return 1 if failures else 0
