"""`crisalad calibrate`, and what `query` and `info` make of it."""

import json
import pathlib

import pytest

from tests.cli.test_cli import fails, files_in, succeeds
from tests.cli.test_index import query
from tests.conftest import BATCH


def calibrate(folder: pathlib.Path, data: pathlib.Path, *more: object) -> tuple:
    return (
        *("calibrate", "--map", folder, "--data", data, "--batch-size", BATCH, "--quiet"),
        *more,
    )


def test_a_map_is_calibrated_and_says_unknown(folder, shared, tmp_path, capfd, queries):
    said = succeeds(capfd, *calibrate(folder, shared / "town", "--precision", 0.4))
    value = json.loads((folder / "calibration.json").read_text())
    least = value["min_similarity"]
    assert f"calibration.json: answers below similarity {least:.9g} are unknown from now on" in said
    assert (value["precision"], value["database"], value["unknown"]) == (0.4, 7, 1)
    assert value["right"] / value["answered"] >= 0.4

    assert f"calibration min_similarity {least}, precision 0.4," in succeeds(
        capfd, "info", "--map", folder
    )
    answers = tmp_path / "answers.jsonl"
    said = succeeds(capfd, *query(folder, queries, "--json", answers))
    lines = [json.loads(line) for line in answers.read_text().splitlines()]
    # The same queries were calibrated on: as many are answered as then.
    unknown = 5 - value["answered"]
    assert [line["known"] for line in lines].count(False) == unknown
    assert said == (
        f"{answers}: 5 queries in a map of 7 images; by jax; {unknown} of 5 unknown, below "
        f"similarity {least:.9g} (rests on {value['answered']} answers)"
    )
    # What a flag says stands before what the map remembers.
    table = succeeds(capfd, *query(folder, queries, "--min-similarity", -1))
    assert "unknown" not in table


def test_what_cannot_be_is_one_line_and_leaves_nothing(folder, shared, tmp_path, capfd):
    before = files_in(folder)
    town = shared / "town"
    fails(capfd, *calibrate(folder, town, "--precision", 99), words=("precision: found 99",))
    fails(capfd, *calibrate(tmp_path / "none", town), words=("found no map",))
    fails(capfd, *calibrate(folder, tmp_path / "none"), words=(f"{tmp_path / 'none'}",))
    # A radius of a centimetre: nothing is right.
    words = ("precision: no similarity reaches a precision of 99 %", "town")
    fails(capfd, *calibrate(folder, town, "--radius", 0.01), words=words)
    assert files_in(folder) == before


def test_a_damaged_calibration_is_left_out_with_a_similarity(folder, shared, capfd, queries):
    (folder / "calibration.json").write_text("{")
    fails(capfd, *query(folder, queries), words=("calibration.json", "the file may be removed"))
    for least in (-1, 0.5):
        said = succeeds(capfd, *query(folder, queries, "--min-similarity", least))
        assert ("unknown, below similarity 0.5" in said) == (least == 0.5)
        assert "rests on" not in said
    # It is replaced, not read.
    succeeds(capfd, *calibrate(folder, shared / "town", "--precision", 0.4))
    assert "rests on" in succeeds(capfd, *query(folder, queries))


def test_frames_of_a_camera_are_followed(folder, tmp_path, capfd, queries):
    answers = tmp_path / "answers.jsonl"
    followed = ("--sequence", "bayes", "--sequence-reach", 1)
    succeeds(capfd, *query(folder, queries, *followed, "--k", 7, "--json", answers))
    for line in map(json.loads, answers.read_text().splitlines()):
        # Over all images of the map, each rounded to six digits.
        total = sum(answer["probability"] for answer in line["neighbours"])
        assert total == pytest.approx(1, abs=7 * 5e-7)
    words = ("--sequence-reach: found without --sequence bayes",)
    fails(capfd, *query(folder, queries, "--sequence-reach", 1), words=words)
