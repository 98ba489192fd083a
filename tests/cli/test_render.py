"""`crisalad render`: what it writes, says and refuses."""

import json

from tests.cli.test_cli import fails, succeeds

SMALL = ("--scenes", "3", "--stations", "2", "--test-scenes", "2", "--image-size", "30", "40")


def test_it_says_what_it_wrote(tmp_path, capfd):
    out = tmp_path / "world"
    given = ("render", "--out", out, *SMALL, "--quiet", "--json", tmp_path / "said.json")
    said = succeeds(capfd, *given)
    assert said == (
        f"{out}: 6 places with 4 images each in {out / 'train'}; 4 other places in {out / 'test'}"
    )
    assert len(list((out / "train").rglob("*.jpg"))) == 6 * 4
    assert len(list((out / "test").rglob("*.jpg"))) == 4 * 2
    told = json.loads((tmp_path / "said.json").read_text())
    assert (told["places"], told["test_places"], told["seed"]) == (6, 4, 0)


def test_a_world_that_is_there_stays_and_another_is_refused_by_what_differs(tmp_path, capfd):
    given = ("render", "--out", tmp_path / "world", *SMALL, "--quiet")
    succeeds(capfd, *given)
    written = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    assert "already rendered, 6 places with 4 images each" in succeeds(capfd, *given)
    for flag, value, words in (
        ("--repaint", "0.2", "another configuration (repaint: 0.3, not 0.2)"),
        ("--varied", "season", "another configuration (varied: ['stand', "),
    ):
        fails(capfd, *given, flag, value, words=(words,))
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == written


def test_bad_input_is_one_line_and_leaves_nothing(tmp_path, capfd):
    out = tmp_path / "world"
    for flag, value, words in (
        ("--scenes", "0", "WorldConfig.scenes: found 0, expected a whole number of at least 1"),
        ("--repaint", "-1", "WorldConfig.repaint: found -1.0, expected 0 to 3"),
        ("--sceneries", "sea", "sea"),
        ("--varied", "sun", "sun"),
        ("--seed", "-1", "WorldConfig.seed: found -1"),
    ):
        fails(capfd, "render", "--out", out, *SMALL, flag, value, words=(words,))
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("mine")
    words = ("found a file, expected a folder",)
    fails(capfd, "render", "--out", tmp_path / "file", *SMALL, words=words)
    assert (tmp_path / "file").read_text() == "mine"
