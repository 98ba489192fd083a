"""The attacks: a handful of tries of two kinds, and all of them (slow).

Of kills, tests/training/test_interruption.py has some of training, and tests/retrieval/serve of the
service.
"""

import json
import os
import pathlib
import subprocess
import sys

import pytest

from tests.attack.world import ROOT

SOME = (("inputs", 0, "a sample", 16),)
ALL = (
    # In a container root may not mount, and writes into any folder: three tries then.
    ("disks", 0, "convert", 3),
    ("damage", 1, "", 4800),
    ("disks", 1, "", 200),
    ("disks", 0.6, "train limited, evaluate limited, extract .h5 limited, index limited", 24),
    ("hostile", 1, "", 400),
    ("inputs", 1, "", 1600),
    ("interruptions", 0, "some", 9),
    ("interruptions", 1, "forks", 192),
    ("interruptions", 1, "programs, training, busy, closed output", 88),
    ("interruptions", 1, "long", 24),
    ("kills", 1, "training", 240),
    ("kills", 1, "maps, extract .npy, extract .h5", 100),
    ("kills", 1, "map changes", 60),
    ("kills", 1, "compare", 6),
    ("clusters", 1, "", 4),
    ("kills", 1, "compare on Ray", 20),
    ("memory", 1, "", 7),
    ("processes", 1, "", 13),
    ("service", 1, "", 2000),
    ("surroundings", 1, "20 columns, python -O, python -W error, C locale, no home", 40),
    ("surroundings", 1, "switches of JAX", 8),
    ("surroundings", 1, "another user, a home to read, no /dev/shm, /tmp full", 0),
)


@pytest.mark.parametrize(
    ("script", "scale", "attacks", "tries"),
    [*SOME, *(pytest.param(*each, marks=pytest.mark.slow) for each in ALL)],
)
def test_attack(tmp_path: pathlib.Path, script: str, scale: float, attacks: str, tries: int):
    out = tmp_path / "rows.json"
    command = [sys.executable, "-m", f"tests.attack.{script}", "--out", str(out)]
    command += ["--scale", str(scale), *(["--only", *attacks.split(", ")] if attacks else [])]
    # Types are checked by other tests, and slow down programs that start often.
    environment = {**os.environ, "JAXTYPING_DISABLE": "1", "TMPDIR": str(tmp_path)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-5000:]
    rows = json.loads(out.read_text())["rows"]
    assert [line for row in rows for line in row["failures"]] == []
    # Few or no signals come before the first line of Python.
    assert all(row["tries"] for row in rows if "before" not in row["attack"])
    assert sum(row["tries"] for row in rows) >= tries
