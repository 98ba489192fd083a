"""The page of compiled programs has the committed figures."""

import pathlib
import subprocess
import sys

ROOT = pathlib.Path(__file__).parents[2]


def test_the_page_is_made_of_the_committed_figures(tmp_path: pathlib.Path):
    page = ROOT / "docs" / "accelerators" / "programs.md"
    copy = tmp_path / "page.md"
    script = ROOT / "scripts" / "bench" / "compile_check_page.py"
    figures = ROOT / "docs" / "accelerators"
    subprocess.run(
        [sys.executable, script, "--page", copy, "--figures", figures], check=True, cwd=ROOT
    )
    assert copy.read_text() == page.read_text()
