"""Programs of their own, for tests of several devices."""

import os
import pathlib
import subprocess
import sys
from typing import Any

import jax

ROOT = pathlib.Path(__file__).parents[2]
# Ten steps of a tiny model take XLA longer to optimise than to run.
SOON = "--xla_backend_optimization_level=0"
if jax.__version_info__ < (0, 11):  # later ones end at the flag, which they do not know
    SOON += " --xla_cpu_use_fusion_emitters=false"
COMPILED_SOON = {**os.environ, "XLA_FLAGS": SOON}


def run_on_devices(count: int, source: str, *arguments: Any) -> list[str]:
    """Run a program on so many virtual devices of a CPU; return the lines that it prints."""
    done = subprocess.run(
        [sys.executable, "-c", source, *map(str, arguments)],
        cwd=ROOT,
        env={**COMPILED_SOON, "JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": str(count)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()
