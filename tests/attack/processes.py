"""Kill a process of a run of four: the others end in a line, and the same command resumes.

    python -m tests.attack.processes --out rows.json [--scale 1] [--seed 0]

A state is saved at every exchange of the processes, so that many kills meet a save.
"""

import dataclasses
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from crisalad_jax.config.io import to_plain
from crisalad_jax.training.lost import HEARTBEAT
from crisalad_jax.utils.files import write_json
from tests.attack.world import ROOT, Attack, Bench, Row, carry_out, one_line, part_of
from tests.training.test_processes import CONFIG, STEP, free_port, logged, trained

PROGRAM = """
from crisalad_jax.training import run_files
run_files.SAVE_SECONDS = 0
from crisalad_jax.__main__ import main
main()
"""
RUN = dataclasses.replace(CONFIG, epochs=20)
STEPS = 40
PATIENCE = HEARTBEAT + 120
"""Seconds for the others to end: the service's limit, and what a busy machine takes."""
START = 900
"""Seconds for processes that share two cores to start, compile and take some steps."""


def start(bench: Bench, out: pathlib.Path, count: int) -> list[subprocess.Popen[str]]:
    """Start the processes of a run, or of its rest."""
    given = [sys.executable, "-c", PROGRAM, "train", "--config", str(bench.folder / "run.json")]
    given += ["--data", str(bench.world.path("city")), "--out", str(out), "--quiet"]
    meet = ["--coordinator-address", f"localhost:{free_port()}", "--num-processes", str(count)]
    return [
        subprocess.Popen(
            [*given, *([*meet, "--process-id", str(number)] if count > 1 else [])],
            cwd=ROOT,
            env={**os.environ, **bench.environment, "JAX_PLATFORMS": "cpu"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for number in range(count)
    ]


def ends(programs: list[subprocess.Popen[str]], seconds: float) -> list[tuple[int | None, str]]:
    """Return exit codes and what was said; None for a process that had to be killed."""
    limit, found = time.monotonic() + seconds, []
    for program in programs:
        code = None
        try:
            _, said = program.communicate(timeout=max(1, limit - time.monotonic()))
            code = program.returncode
        except subprocess.TimeoutExpired:
            program.kill()
            _, said = program.communicate()
        found.append((code, said))
    return found


def steps(out: pathlib.Path) -> int:
    """Count the steps that are logged."""
    log = out / "metrics.jsonl"
    return log.read_bytes().count(b"\n") if log.exists() else 0


def kill_one(bench: Bench, out: pathlib.Path, count: int) -> str:
    """Run on, kill one of the processes soon after a step, and return what is wrong."""
    programs, lost = start(bench, out, count), bench.random.randrange(count)
    before, due = steps(out), bench.random.randint(1, 3)
    limit = time.monotonic() + START
    while steps(out) - before < due and all(program.poll() is None for program in programs):
        if time.monotonic() > limit:
            break
        time.sleep(0.01)
    time.sleep(bench.random.uniform(0, 0.2))
    is_running = all(program.poll() is None for program in programs)
    programs[lost].kill()
    begun = time.monotonic()
    found = ends(programs, PATIENCE)
    took = time.monotonic() - begun
    bench.say(f"lost {lost} of {count} at step {steps(out)}; the others ended in {took:.1f} s")
    if not is_running:
        return f"ended before the kill: {found}"
    for number, (code, said) in enumerate(found):
        words = "".join(line for line in said.splitlines(True) if "crisalad: Note" not in line)
        told = one_line(words) and "processes: lost " in words
        if number != lost and not (code not in (None, 0, -signal.SIGKILL) and told):
            return f"process {number} of {count}, after {lost} was killed: code {code}, {said!r}"
    return ""


def apart(found: pathlib.Path, expected: pathlib.Path) -> tuple[float, float]:
    """Return the largest relative differences of a logged number, and of a parameter array."""
    ours, theirs = (np.array(logged(run, STEP)) for run in (found, expected))
    assert ours.shape == theirs.shape == (STEPS, len(STEP)), (ours.shape, theirs.shape)
    scale = np.where(theirs == 0, 1, np.abs(theirs))
    arrays: list[Mapping[str, Any]] = [trained(found), trained(expected)]
    of_arrays = [
        float(np.linalg.norm(array - arrays[1][name]) / (np.linalg.norm(arrays[1][name]) or 1))
        for name, array in arrays[0].items()
    ]
    return float((np.abs(ours - theirs) / scale).max()), max(of_arrays)


TOLERANCE = 1e-4
"""Relative, of every logged number and array: gradients of two or four parts are summed in another
order, and forty steps of Adam carry that on. Three runs differed by 2.4e-6 at most."""


def attack_processes(bench: Bench, scale: float) -> list[Row]:
    """Kill one of four processes time after time, and finish with four, two and one."""
    write_json(bench.folder / "run.json", to_plain(RUN))
    at_each = Row(
        "kills of one of four processes: each kill",
        "the others end by themselves, each with one line that says so and a code that is not 0",
    )
    of_ends = Row(
        "kills of one of four processes: the rest in four, two or one",
        "the losses and weights of one undisturbed process, within 1e-4",
    )
    whole, out = bench.folder / "whole", bench.folder / "run"

    def finish(folder: pathlib.Path, count: int) -> None:
        found = ends(start(bench, folder, count), START)
        if any(code != 0 for code, _ in found):
            of_ends.note(False, f"{count} processes: {found}")
        elif folder != whole:
            of_log, of_arrays = apart(folder, whole)
            bench.say(
                f"{count} processes: {of_log:.1e} apart in the log, {of_arrays:.1e} in arrays"
            )
            of_ends.note(max(of_log, of_arrays) <= TOLERANCE, f"{count}: {of_log} {of_arrays}")

    finish(whole, 1)
    kills = part_of(10, scale, least=2)
    for number in range(kills):
        wrong = kill_one(bench, out, 4)
        at_each.note(not wrong, wrong)
        if number in (kills // 3, 2 * kills // 3):
            count = 2 if number == kills // 3 else 1
            shutil.copytree(out, copy := bench.folder / f"with-{count}")
            finish(copy, count)
    finish(out, 4)
    return [at_each, of_ends]


ATTACKS: Mapping[str, Attack] = {"processes": attack_processes}


if __name__ == "__main__":
    sys.exit(carry_out(ATTACKS, __doc__))
