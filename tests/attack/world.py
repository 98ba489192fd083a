"""A small world for attacks: data sets, weights, every verb of the command line, and a report.

A process that has imported everything, and that has started no device, forks for each command. A
command then takes some hundredths of a second where it fails early.
"""

import contextlib
import dataclasses
import importlib
import json
import os
import pathlib
import resource
import select
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from crisalad_jax.config.io import to_plain
from crisalad_jax.nn.model import Model
from crisalad_jax.utils.files import write_json

ROOT = pathlib.Path(__file__).parents[2]


class World(NamedTuple):
    """Folders and files that commands read; no command writes into them."""

    root: pathlib.Path
    city: pathlib.Path
    """A training set."""
    town: pathlib.Path
    """An evaluation set."""
    images: pathlib.Path
    """A folder of images."""
    weights: pathlib.Path
    recipe: pathlib.Path
    """A configuration of training."""

    def path(self, name: str) -> pathlib.Path:
        """Return the path of a product of `make_products`."""
        return self.root / "products" / name


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
        lines = [line for line in self.err.splitlines() if not line.startswith("crisalad: note: ")]
        return self.code == 2 and len(lines) == 1 and lines[0].startswith("crisalad: ")


HUNG = 1000


def make_world(root: pathlib.Path) -> World:
    """Write the data sets, in a child process: it uses JAX."""
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
    done = forked(make, cwd=root)
    assert done.code == 0, done.err
    names = ("city", "town", "images", "weights.safetensors", "recipe.json")
    return World(root, *(root / name for name in names))


Arguments = list[str]


def _train(world: World, out: pathlib.Path) -> Arguments:
    return [
        *("train", "--data", f"{world.city}", "--out", f"{out / 'run'}", "--quiet"),
        *("--config", f"{world.recipe}", "--weights", f"{world.weights}"),
        *("--val", f"{world.town}", "--patience", "None"),
    ]


def _evaluate(world: World, out: pathlib.Path) -> Arguments:
    return [
        *("evaluate", "--data", f"{world.town}", "--weights", f"{world.weights}", "--quiet"),
        *("--batch-size", "4", "--seeds", "1", "--json", f"{out / 'table.json'}"),
        *("--out", f"{out / 'pictures'}", "--report", f"{out / 'report'}"),
    ]


def _extract(name: str) -> Callable[[World, pathlib.Path], Arguments]:
    return lambda world, out: [
        *("extract", "--weights", f"{world.weights}", "--images", f"{world.images}", "--quiet"),
        *("--batch-size", "4", "--out", f"{out / name}", "--pairs", f"{out / 'pairs.txt'}"),
    ]


def _compare(world: World, out: pathlib.Path) -> Arguments:
    return [
        *("compare", "--train", f"{world.city}", "--test", f"{world.town}", "--preset", "tiny"),
        *("--methods", "gem", "--seeds", "1", "--epochs", "1", "--image-size", "98", "98"),
        *("--out", f"{out / 'comparison'}", "--quiet"),
    ]


def _vocabulary(world: World, out: pathlib.Path) -> Arguments:
    return [
        *("vocabulary", "--images", f"{world.images}", "--out", f"{out / 'v.safetensors'}"),
        *("--preset", "tiny", "--image-size", "98", "98", "--clusters", "4", "--quiet"),
        *("--aggregator", "netvlad"),
    ]


def _ablate(world: World, out: pathlib.Path) -> Arguments:
    return [
        *("ablate", "--train", f"{world.city}", "--test", f"{world.town}", "--preset", "tiny"),
        *("--rows", "gem", "--seeds", "1", "--epochs", "1", "--image-size", "98", "98"),
        *("--out", f"{out / 'ablation'}", "--quiet"),
    ]


VERBS: Mapping[str, Callable[[World, pathlib.Path], Arguments]] = {
    "train": _train,
    "evaluate": _evaluate,
    "extract .npy": _extract("d.npy"),
    "extract .h5": _extract("d.h5"),
    "index": lambda world, out: [
        *("index", "--weights", f"{world.weights}", "--images", f"{world.images}", "--quiet"),
        *("--out", f"{out / 'map'}", "--batch-size", "4"),
    ],
    "query": lambda world, out: [
        *("query", f"{world.images}", "--map", f"{world.path('map')}", "--quiet"),
        *("--json", f"{out / 'answers.json'}", "--gallery", f"{out / 'gallery.png'}"),
    ],
    "pca": lambda world, out: [
        *("pca", "--descriptors", f"{world.path('d.npy')}", "--dim", "3", "--quiet"),
        *("--out", f"{out / 'pca.safetensors'}"),
    ],
    "export": lambda world, out: [
        *("export", "--weights", f"{world.weights}", "--out", f"{out / 'program'}"),
    ],
    "convert": lambda world, out: [
        *("convert", f"{world.weights}", f"{out / 'public.pth'}", "--format", "reference"),
    ],
    "info": lambda world, out: [
        *("info", "--weights", f"{world.weights}", "--json", f"{out / 'info.json'}"),
    ],
    "compare": _compare,
    "render": lambda world, out: [
        *("render", "--out", f"{out / 'world'}", "--scenes", "12", "--test-scenes", "3"),
        *("--image-size", "30", "40", "--quiet"),
    ],
    "demo": lambda world, out: ["demo", "--out", f"{out / 'demo'}", "--quiet"],
}
"""A command of each verb that writes files, by what it writes into a folder."""
ALL = {**VERBS, "vocabulary": _vocabulary, "ablate": _ablate}
"""These, and the two that take as long as others and do much the same."""
NEEDS: Mapping[str, tuple[str, ...]] = {"query": ("index",), "pca": ("extract .npy",)}
"""Products that a verb reads, by the verbs that make them."""


PRODUCTS = ("extract .npy", "extract .h5", "index", "pca", "export", "train")


def make_products(world: World, verbs: Sequence[str] = PRODUCTS) -> None:
    """Run the verbs whose products other verbs read or attacks change: into products/."""
    for verb in verbs:
        arguments = VERBS[verb](world, world.root / "products")
        done = run(arguments, cwd=world.root)
        assert done.code == 0, (verb, done.err)


def import_everything() -> None:
    """Import the command line and all that its verbs import, without starting a device."""
    from crisalad_jax import cli

    for name in cli._COMMANDS:
        importlib.import_module(f"crisalad_jax.cli.{name.replace('-', '_')}")
    for name in (
        "faiss",
        "h5py",
        "matplotlib.pyplot",
        "optax",
        "orbax.checkpoint",
        "tyro",
        "crisalad_jax.checkpoints.export",
        "crisalad_jax.experiments.comparison",
        "crisalad_jax.experiments.report",
        "crisalad_jax.experiments.train",
        "crisalad_jax.retrieval.extract",
    ):
        importlib.import_module(name)


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


def run(arguments: Sequence[str], *, cwd: pathlib.Path, **options: object) -> Done:
    """Run a command of the command line in a forked process, as `forked` does."""
    return forked(lambda: command(arguments), cwd=cwd, **options)  # pyright: ignore


def command(arguments: Sequence[str]) -> int:
    """Run a command in this process, as the program `crisalad` does; return its exit code."""
    from crisalad_jax.__main__ import keep_on_without_reader
    from crisalad_jax.cli import main
    from crisalad_jax.utils.signals import end_at_signals

    end_at_signals()
    keep_on_without_reader()
    code = main(list(arguments))
    sys.stdout.flush()
    return code


def forked(
    work: Callable[[], int],
    *,
    cwd: pathlib.Path,
    limit: float = 120,
    memory: int | None = None,
    during: Callable[[int], None] | None = None,
    environment: Mapping[str, str] = {},
) -> Done:
    """Run a function in a process of its own, and wait for its end.

    Args:
        work: returns the exit code. An exception ends the process as it ends Python.
        cwd: the folder that it runs in.
        limit: seconds until it counts as hung, and is killed.
        memory: most bytes of address space beyond those it starts with.
        during: called with the number of the process as soon as that runs.
        environment: variables of its own.
    """
    pipes = [os.pipe() for _ in range(2)]
    started = time.monotonic()
    process = os.fork()
    if process == 0:
        _child(work, cwd, memory, environment, [writing for _, writing in pipes])
    for _, writing in pipes:
        os.close(writing)
    watchers = [os.pidfd_open(process)]
    texts = {reading: b"" for reading, _ in pipes}
    code, peak = None, 0
    try:
        if during is not None:
            during(process)
        open_pipes = set(texts)
        while watchers or open_pipes:
            left = limit - (time.monotonic() - started)
            ready, _, _ = select.select([*open_pipes, *watchers], [], [], max(left, 1))
            if not ready:
                if not watchers:
                    break  # a grandchild holds the pipes
                os.kill(process, signal.SIGKILL)
                code, limit = HUNG, limit + 60
            for each in open_pipes & set(ready):
                data = os.read(each, 2**16)
                texts[each] += data
                if not data:
                    open_pipes.discard(each)
            if watchers and watchers[0] in ready:
                _, status, usage = os.wait4(process, 0)
                code = os.waitstatus_to_exitcode(status) if code is None else code
                peak = usage.ru_maxrss * 1024
                os.close(watchers.pop())
                limit = time.monotonic() - started + 1
    finally:
        for each in (*texts, *watchers):
            os.close(each)
    assert code is not None
    out, err = (text.decode(errors="replace") for text in texts.values())
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return Done(code, out, err, time.monotonic() - started, max(0, peak - base))


def _child(
    work: Callable[[], int],
    cwd: pathlib.Path,
    memory: int | None,
    environment: Mapping[str, str],
    outputs: Sequence[int],
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
        os.environ.update(environment)
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


def picture_bytes(height: int = 8, width: int = 8) -> bytes:
    """Return a small PNG."""
    done, data = cv2.imencode(".png", np.full((height, width, 3), 90, np.uint8))
    assert done
    return data.tobytes()


def without_times(value: Any) -> Any:
    """Leave out of JSON values what depends on the clock: all else is equal in two runs."""
    times = ("images_per_second", "waited_for_images", "seconds", "step_seconds", "added")
    if isinstance(value, dict):
        return {k: without_times(v) for k, v in value.items() if k not in (*times, "checksum")}
    return [without_times(each) for each in value] if isinstance(value, list) else value
