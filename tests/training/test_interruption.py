"""Runs that are killed, told to stop, or out of room: what they leave, and that they go on.

Each run is a program of its own, with a state saved after every step, so that a kill often meets a
save.
"""

import dataclasses
import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest

from tests.conftest import RECIPE
from tests.training.programs import ROOT
from tests.training.test_loop import metrics_of

EPOCHS = 4
CONFIG = dataclasses.replace(RECIPE, epochs=EPOCHS, patience=None, save_top_k=2)
PROGRAM = """
import pathlib, sys

import crisalad_jax.training.loop
import crisalad_jax.training.run_files
import crisalad_jax.training.validation
from crisalad_jax.utils import compiler
from crisalad_jax.data.benchmarks import open_benchmark
from crisalad_jax.data.places import read_places
from crisalad_jax.utils.errors import InputError, Interrupted
from tests.training.test_interruption import CONFIG

city, town, out = map(pathlib.Path, sys.argv[1:4])
compiler.configure()
crisalad_jax.training.run_files.SAVE_SECONDS = -1.0
for statement in sys.argv[4:]:
    exec(statement)
try:
    crisalad_jax.training.loop.fit(
        CONFIG,
        read_places(city, min_images=2),
        out,
        validation=open_benchmark(town),
        quiet=True,
    )
except InputError as error:
    sys.exit(str(error))
except Interrupted as stopped:
    print(stopped)
    sys.exit(128 + stopped.number)
"""


@pytest.fixture(scope="module")
def start(shared: pathlib.Path, tmp_path_factory):
    """Start the program on a run's folder; compiled programs are kept between the starts."""
    cache = tmp_path_factory.mktemp("cache")
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cache)}

    def go(out: pathlib.Path, *statements: str) -> subprocess.Popen[str]:
        arguments = map(str, (shared / "city", shared / "town", out, *statements))
        return subprocess.Popen(
            [sys.executable, "-c", PROGRAM, *arguments],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    return go


@pytest.fixture(scope="module")
def whole(start, tmp_path_factory) -> pathlib.Path:
    """A run that nothing interrupts."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    finish(start(out))
    return out


def finish(program: subprocess.Popen[str]) -> None:
    _, errors = program.communicate()
    assert program.returncode == 0, errors


def lines_in(out: pathlib.Path) -> int:
    log = out / "metrics.jsonl"
    return log.read_bytes().count(b"\n") if log.exists() else 0


def wait_for_lines(program: subprocess.Popen[str], out: pathlib.Path, count: int) -> None:
    while program.poll() is None and lines_in(out) < count:
        time.sleep(0.002)


def assert_same_end(found: pathlib.Path, expected: pathlib.Path) -> None:
    assert metrics_of(found) == metrics_of(expected)
    weights = sorted(path.relative_to(expected) for path in expected.rglob("*.safetensors"))
    assert len(weights) == 4  # last, best, and the best two by name
    assert sorted(path.relative_to(found) for path in found.rglob("*.safetensors")) == weights
    for name in weights:
        assert (found / name).read_bytes() == (expected / name).read_bytes(), name


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.slow
def test_a_signal_saves_first_and_the_same_command_goes_on(start, whole, tmp_path, number):
    out = tmp_path / "run"
    # Without these saves, what is resumed from was saved because of the signal.
    seldom = "crisalad_jax.training.run_files.SAVE_SECONDS = 1e9"
    program = start(out, seldom)
    wait_for_lines(program, out, 4)
    program.send_signal(number)
    said, errors = program.communicate()
    assert program.returncode == 128 + number, errors
    step = metrics_of(out)[-1]["step"]
    assert f"after step {step}; the same command goes on" in said
    assert max(int(path.name) for path in (out / "state").iterdir()) == step
    finish(start(out))
    assert_same_end(out, whole)


@pytest.mark.slow
def test_a_signal_during_a_validation_does_not_wait_for_its_end(start, whole, tmp_path):
    """The validation is repeated, and is in the log once."""
    slow = (
        "real = crisalad_jax.training.validation.evaluate\n"
        "def evaluate(*arguments, **more):\n"
        "    print('validating', flush=True)\n"
        "    import time\n"
        # One long sleep would miss a signal that comes just before it.
        "    for _ in range(600): time.sleep(0.1)\n"
        "crisalad_jax.training.validation.evaluate = evaluate"
    )
    out = tmp_path / "run"
    program = start(out, slow)
    assert program.stdout is not None
    assert program.stdout.readline() == "validating\n"
    began = time.monotonic()
    program.terminate()
    _, errors = program.communicate()
    assert time.monotonic() - began < 50  # the sleep was cut short
    assert program.returncode == 128 + signal.SIGTERM, errors
    finish(start(out))
    assert_same_end(out, whole)


@pytest.mark.slow
@pytest.mark.parametrize("kilobytes", [1, 230])
def test_a_full_disk_is_one_line_and_the_run_goes_on_when_there_is_room(
    start, whole, tmp_path, kilobytes
):
    """No file may grow beyond so much: weights, or states, or the log does not fit."""
    limit = (
        "import jax; jax.config.update('jax_compilation_cache_dir', None); "
        "import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN); "
        f"limit = {kilobytes} * 1024; resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))"
    )
    out = tmp_path / "run"
    program = start(out)
    wait_for_lines(program, out, 3)
    program.kill()
    program.communicate()
    program = start(out, limit)
    _, errors = program.communicate()
    assert program.returncode == 1
    last = errors.strip().splitlines()[-1]
    assert last.startswith(str(out)), errors
    assert "cannot be written" in last or "cannot write" in last
    finish(start(out))
    assert_same_end(out, whole)
