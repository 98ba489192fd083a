"""Run the scripts of this folder from tests."""

import json
import os
import pathlib
import subprocess
import sys
from typing import Any

from tests.attack.world import ROOT


def rows_of(script: str, folder: pathlib.Path, *arguments: object) -> list[dict[str, Any]]:
    """Run a script in a new process, which may fork since it has no JAX yet; return its rows."""
    out = folder / "rows.json"
    command = [sys.executable, "-m", f"tests.attack.{script}", "--out", out, *arguments]
    # Types are checked by other tests, and slow down programs that start often.
    environment = {**os.environ, "JAXTYPING_DISABLE": "1", "TMPDIR": str(folder)}
    done = subprocess.run(
        list(map(str, command)), cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert out.exists(), done.stderr[-2000:]
    return json.loads(out.read_text())["rows"]
