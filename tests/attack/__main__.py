"""Attack everything, and put the counts into docs/reliability.md.

    python -m tests.attack [--rows rows.json] [--only damage,kills]

Takes an hour or so on two cores. With --rows, results of an earlier call that are not tried again
are kept.
"""

import argparse
import json
import pathlib
import subprocess
import sys
import tempfile

from crisalad_jax.utils.files import around, atomic_path
from tests.attack.world import ROOT

SCRIPTS = ("kills", "interruptions", "memory", "disks", "damage", "inputs")
PAGE = ROOT / "docs" / "reliability.md"


def table(rows: list[dict]) -> str:
    """Return the rows as a Markdown table."""
    lines = ["| attack | promise | tries | failures |", "| --- | --- | ---: | ---: |"]
    for row in rows:
        texts = (row[name].replace("|", "\\|") for name in ("attack", "promise"))
        lines.append(f"| {' | '.join(texts)} | {row['tries']:,} | {len(row['failures']):,} |")
    tries, failures = (sum(numbers) for numbers in zip(*map(_numbers, rows), strict=True))
    return "\n".join([*lines, f"| **all** | | **{tries:,}** | **{failures:,}** |"])


def _numbers(row: dict) -> tuple[int, int]:
    return row["tries"], len(row["failures"])


def main() -> int:
    """Run the scripts, and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rows", type=pathlib.Path)
    parser.add_argument("--only", default=",".join(SCRIPTS))
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = given.rows or pathlib.Path(folder) / "rows.json"
        for script in filter(None, given.only.split(",")):
            command = [sys.executable, "-m", f"tests.attack.{script}", "--out", str(rows)]
            subprocess.run(command, cwd=ROOT, check=False)
        found = json.loads(rows.read_text(encoding="utf-8"))["rows"]
    before, after = around(PAGE, "attacks")
    with atomic_path(PAGE) as temporary:
        temporary.write_text(f"{before}\n{table(found)}\n\n{after}", encoding="utf-8")
    return 1 if any(row["failures"] for row in found) else 0


if __name__ == "__main__":
    sys.exit(main())
