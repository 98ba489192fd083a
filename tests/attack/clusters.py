"""Kill what describes on a Ray cluster: workers, and the command itself.

    python -m tests.attack.clusters --out rows.json [--scale 1] [--seed 0] [--only workers ...]

Two nodes of one core each run on this machine. `extract` and `index` describe pictures on them, in
pieces of a few images, while workers or the command are killed at random moments.
"""

import os
import pathlib
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from typing import Any

from tests.attack.world import (
    ROOT,
    Attack,
    Bench,
    Row,
    carry_out,
    differences,
    files_in,
    has_temporaries,
    part_of,
)
from tests.ray_nodes import Nodes, ray_nodes

IMAGES = 480
TOGETHER = 8
"""Images of a piece, of a batch and of a segment."""
VERBS = ("extract", "index")
WORKER = "ray::_Worker"
"""How Ray names the processes that describe."""
PROGRAM = f"""
import sys
from crisalad_jax.retrieval import extract, on_cluster
from crisalad_jax.retrieval.maps import build
for module in (extract, on_cluster, build):
    assert module.SEGMENT
    module.SEGMENT = {TOGETHER}
from crisalad_jax.__main__ import main
main()
"""


def _files(folder: pathlib.Path) -> dict[str, Any]:
    """Return what two runs write alike."""
    return {
        name: (folder / name).read_bytes() if name.endswith((".npy", ".txt")) else None
        for name in files_in(folder)
        if ".crisalad-" not in name
    }


class Describing:
    """Commands that describe the pictures into a folder, on a cluster or here."""

    def __init__(self, bench: Bench, nodes: Nodes) -> None:
        from tests.conftest import write_picture

        self.images = bench.folder / "images of clusters"
        for number in range(IMAGES):
            write_picture(self.images / "sub" / f"{number:03d}.jpg", number)
        self._bench, self.nodes = bench, nodes

    def start(self, verb: str, out: pathlib.Path, *, here: bool = False) -> subprocess.Popen[str]:
        out.mkdir(parents=True, exist_ok=True)
        weights = str(self._bench.world.path("weights.safetensors"))
        given = [verb, "--weights", weights, "--images", str(self.images), "--quiet"]
        given += ["--batch-size", str(TOGETHER)]
        given += ["--out", str(out / ("d.npy" if verb == "extract" else "map"))]
        given += [] if here else ["--cluster", self.nodes.address]
        return subprocess.Popen(
            [sys.executable, "-c", PROGRAM, *given],
            cwd=ROOT,
            env={**self._bench.environment, **self.nodes.environment},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def whole(self, verb: str, folder: pathlib.Path) -> dict[str, Any]:
        """Return what one process writes."""
        process = self.start(verb, folder, here=True)
        _, err = process.communicate(timeout=1200)
        assert process.returncode == 0, err
        return _files(folder)

    def wrong(
        self, out: pathlib.Path, process: subprocess.Popen[str], whole: Mapping[str, Any]
    ) -> list[str]:
        """Return what is wrong with a folder at the end of a run."""
        _, err = process.communicate(timeout=1200)
        code = process.returncode
        notes = [line for line in err.splitlines() if not line.startswith("crisalad: note: ")]
        if code or notes:
            return [f"exit code {code}", *notes]
        left = self._workers_after(30)
        return [*differences(_files(out), whole), *has_temporaries(out), *left]

    def _workers_after(self, seconds: float) -> list[str]:
        """List workers that are left, after some time for Ray to end them."""
        end = time.monotonic() + seconds
        while (left := self.nodes.pids(WORKER)) and time.monotonic() < end:
            time.sleep(0.5)
        return [f"a worker is left: {each}" for each in left]


def attack_workers(bench: Bench, scale: float) -> list[Row]:
    """Kill workers while they describe, mostly after the map or the set has grown."""
    row = Row("kills of a cluster's workers", "the bytes of one process, no worker left")
    kills = part_of(10, scale)
    with ray_nodes() as nodes:
        commands = Describing(bench, nodes)
        for verb in VERBS:
            whole, killed, grown = commands.whole(verb, bench.folder / f"here {verb}"), 0, 0
            while killed < kills:
                out = bench.folder / f"workers {verb} {killed}"
                process = commands.start(verb, out)
                while process.poll() is None:
                    time.sleep(bench.random.uniform(0, 2))
                    records, at_work = len(list(out.rglob("0*.json"))), nodes.pids(WORKER)
                    if killed < kills and at_work and records != grown:
                        os.kill(bench.random.choice(at_work), signal.SIGKILL)
                        killed, grown = killed + 1, records
                        bench.say(f"{row.attack}: {verb}, {killed} of {kills}")
                wrong = commands.wrong(out, process, whole)
                row.note(not wrong, f"seed {bench.seed}, {verb}, {killed} kills: {wrong}")
    return [row]


def attack_commands(bench: Bench, scale: float) -> list[Row]:
    """Kill the command itself at any moment, and start it again."""
    row = Row(
        "kills of a command on a cluster", "the same command ends with the bytes of one process"
    )
    kills = part_of(10, scale)
    with ray_nodes() as nodes:
        commands = Describing(bench, nodes)
        for verb in VERBS:
            whole = commands.whole(verb, bench.folder / f"alone {verb}")
            begun = time.monotonic()
            commands.start(verb, bench.folder / f"undisturbed {verb}").communicate()
            seconds, out, killed = time.monotonic() - begun, bench.folder / f"commands {verb}", 0
            while killed < kills:
                process = commands.start(verb, out)
                try:
                    process.wait(bench.random.uniform(0, seconds))
                except subprocess.TimeoutExpired:
                    process.kill()
                    killed += 1
                    bench.say(f"{row.attack}: {verb}, {killed} of {kills}")
                    process.communicate()
                    continue
                wrong = commands.wrong(out, process, whole)
                row.note(not wrong, f"seed {bench.seed}, {verb}, {killed} kills: {wrong}")
                out = bench.folder / f"commands {verb} {killed}"
            wrong = commands.wrong(out, commands.start(verb, out), whole)
            row.note(not wrong, f"seed {bench.seed}, {verb}, {killed} kills: {wrong}")
    return [row]


ATTACKS: Mapping[str, Attack] = {"workers": attack_workers, "commands": attack_commands}


if __name__ == "__main__":
    sys.exit(carry_out(ATTACKS, __doc__))
