"""Attack everything, and write the counts to docs/reliability/attacks.md.

    python -m tests.attack [--rows rows.json] [--only damage,kills]

Takes an hour or so on two cores. With --rows, results of an earlier call that are not tried again
are preserved.
"""

import argparse
import json
import pathlib
import subprocess
import sys
import tempfile

from crisalad_jax.utils.files import atomic_path
from tests.attack.world import ROOT

SCRIPTS = (
    *("kills", "interruptions", "memory", "disks", "damage", "inputs"),
    *("service", "hostile", "surroundings", "clusters", "processes"),
)
PAGE = ROOT / "docs" / "reliability" / "attacks.md"


def table(rows: list[dict]) -> str:
    """Return the rows as a Markdown table, a line for each attack: what stands before its colon."""
    groups: dict[tuple[str, str], list[dict]] = {}
    for row in rows:
        groups.setdefault((row["attack"].partition(": ")[0], row["promise"]), []).append(row)
    lines = ["| attack | promise | tries | failures |", "| --- | --- | ---: | ---: |"]
    for (attack, promise), group in groups.items():
        kinds = [row["attack"].partition(": ")[2] for row in group]
        of = f": {', '.join(map(_code, kinds))}" if all(kinds) else ""
        tries, failures = _sums(group)
        texts = (text.replace("|", "\\|") for text in (attack + of, promise))
        lines.append(f"| {' | '.join(texts)} | {tries:,} | {failures:,} |")
    tries, failures = _sums(rows)
    return "\n".join([*lines, f"| **all** | | **{tries:,}** | **{failures:,}** |"])


def _code(kind: str) -> str:
    """Return a kind in a form that Markdown takes as it is."""
    return f"`{kind}`" if kind[0] in "-'/." else kind


def _sums(rows: list[dict]) -> tuple[int, int]:
    return sum(row["tries"] for row in rows), sum(len(row["failures"]) for row in rows)


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
    with atomic_path(PAGE) as temporary:
        temporary.write_text(f"# All attacks\n\n{table(found)}\n", encoding="utf-8")
    return 1 if any(row["failures"] for row in found) else 0


if __name__ == "__main__":
    sys.exit(main())
