"""The demo's refusals, and a whole one at the smallest size."""

import pytest

from crisalad_jax.cli import main
from crisalad_jax.experiments.demo import DemoConfig, run_demo


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_an_occupied_place_is_refused_and_left_alone(tmp_path, capsys, kind):
    out = tmp_path / "out"
    if kind == "folder":
        out.mkdir()
        (out / "letter.txt").write_text("mine")
    else:
        out.write_text("mine")
    assert main(["demo", "--out", str(out), "--quiet"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    found = "files but no demo" if kind == "folder" else "a file, expected a folder"
    assert line.startswith(f"crisalad: {out}: found {found}")
    assert [path.name for path in tmp_path.rglob("*.txt")] == ["letter.txt"] * (kind == "folder")


@pytest.mark.slow
def test_a_small_demo_leaves_what_it_says(tmp_path):
    """Minutes long on two cores: the real model, on few places."""
    config = DemoConfig(train_places=24, test_places=12, epochs=2)
    summary = run_demo(config, tmp_path, quiet=True)
    assert all(picture.stat().st_size > 10_000 for picture in summary.pictures)
    assert {row.model for row in summary.rows} == {"HOG, no learning", "untrained", "trained"}
    assert len(summary.rows) == 7
    assert (tmp_path / "recalls.md").read_text().count("\n") == 9
    # A second call finds the city and the finished run, and says the same.
    assert run_demo(config, tmp_path, quiet=True).rows == summary.rows
