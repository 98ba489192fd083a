"""Test errors, verdicts, the files and the exit codes."""

import dataclasses
import json
import math
import pathlib

import numpy as np
import pytest

import parity.cases.parts
from parity.__main__ import main
from parity.cases import CASES, RUNS, checks
from parity.compare import (
    Row,
    Tolerance,
    compare,
    compare_joined,
    compare_signs,
    compare_truth,
    relative_error,
)
from parity.full_size import cosine_row
from parity.report import terminal_table, write_report

LOOSE = Tolerance(0.5, "for a test")


def row_of(
    ours: dict[str, list[float]],
    theirs: dict[str, list[float]],
    noise: dict[str, str] | None = None,
) -> Row:
    left, right = ({k: np.array(v) for k, v in side.items()} for side in (ours, theirs))
    return compare("layer", "forward", "float32", left, right, LOOSE, noise=noise)


def test_the_error_is_relative_to_the_reference() -> None:
    assert relative_error(np.array([3.0, 5.0]), np.array([3.0, 4.0])) == pytest.approx(1 / 5)
    assert relative_error(np.zeros(2), np.zeros(2)) == 0
    assert relative_error(np.array([1e-9]), np.zeros(1)) == math.inf
    assert relative_error(np.array([math.nan]), np.ones(1)) == math.inf


def test_a_row_shows_the_worst_array() -> None:
    row = row_of({"a": [1.0], "b": [3.0, 5.0]}, {"a": [1.0], "b": [3.0, 4.0]})
    assert (row.worst, row.shape, row.arrays, row.passed) == ("b", (2,), 2, True)
    assert row.max_abs == 1
    assert row.relative == pytest.approx(0.2)


@pytest.mark.parametrize(
    "ours", [{"a": [math.nan]}, {"a": [1.0, 1.0]}, {}, {"a": [1.0], "b": [0.0]}, {"a": [2.0]}]
)
def test_what_is_wrong_or_missing_is_a_miss(ours: dict[str, list[float]]) -> None:
    assert not row_of(ours, {"a": [1.0]}).passed


def pair(ours: dict[str, list[float]], theirs: dict[str, list[float]]) -> list[dict]:
    return [{k: np.array(v) for k, v in side.items()} for side in (ours, theirs)]


def test_arrays_joined_are_one() -> None:
    sides = pair({"a": [1.0, 0.0], "b": [3.0, 5.0]}, {"a": [1.0, 0.0], "b": [3.0, 4.0]})
    row = compare_joined("layer", "step", "bfloat16", *sides, LOOSE)
    assert (row.worst, row.shape, row.arrays, row.max_abs) == ("all together", (4,), 2, 1)
    assert row.relative == pytest.approx(1 / math.sqrt(26))


def test_signs_are_counted_in_each_array() -> None:
    """Zero counts as a separate sign."""
    theirs = {"a": [1.0, -2.0, 0.0], "b": [3.0, 4.0, 5.0]}
    sides = pair({"a": [1.0, 2.0, 1.0], "b": [3.0, -4.0, 5.0]}, theirs)
    row = compare_signs("layer", "signs", "bfloat16", *sides, LOOSE)
    assert (row.worst, row.relative, row.max_abs, row.passed) == ("a", 2, 4, False)
    assert compare_signs("layer", "signs", "bfloat16", *pair(theirs, theirs), LOOSE).relative == 0


@pytest.mark.parametrize("check", [compare_joined, compare_signs])
@pytest.mark.parametrize("ours", [{"a": [math.nan]}, {"a": [1.0, 1.0]}, {}])
def test_joined_too_what_is_wrong_or_missing_is_a_miss(check, ours) -> None:
    row = check(
        "layer", "step", "bfloat16", *pair(ours, {"a": [1.0]}), Tolerance(1e9, "for a test")
    )
    assert not row.passed


def test_noise_is_measured_by_what_cancels() -> None:
    ours, theirs = {"dead": [2e-3], "alive": [4.0]}, {"dead": [-1e-3], "alive": [4.0]}
    assert not row_of(ours, theirs).passed
    row = row_of(ours, theirs, {"dead": "alive"})
    assert row.passed
    # The larger of the two relative to the terms that cancel, not their difference.
    assert row.relative == pytest.approx(2e-3 / 4)
    assert not row_of({**ours, "dead": [3.0]}, theirs, {"dead": "alive"}).passed


@pytest.mark.parametrize(
    ("ours", "theirs"), [(1.0, math.nan), (math.nan, 1.0), (1.0, math.inf), (math.inf, 1.0)]
)
def test_noise_that_is_no_number_is_a_miss(ours: float, theirs: float) -> None:
    sides = {"dead": [ours], "alive": [4.0]}, {"dead": [theirs], "alive": [4.0]}
    assert not row_of(*sides, {"dead": "alive"}).passed


def test_a_tolerance_that_is_no_number_holds_nothing() -> None:
    row = row_of({"a": [1.0]}, {"a": [1.0]})
    assert row.passed
    for tolerance in (math.inf, math.nan):
        assert not dataclasses.replace(row, tolerance=tolerance).passed


def truth_row_of(ours: float, theirs: float, truth: float) -> Row:
    sides = ({"a": np.array([x, 2.0])} for x in (ours, theirs, truth))
    return compare_truth("layer", "forward", "bfloat16", *sides)


def test_the_truth_may_be_missed_by_half_as_much_again_as_torch_misses_it() -> None:
    norm = math.sqrt(1 + 2**2)
    row = truth_row_of(1.2, 1.1, 1.0)
    assert row.relative == pytest.approx(0.2 / norm)
    assert row.tolerance == pytest.approx(1.5 * 0.1 / norm)
    assert row.max_abs == pytest.approx(0.2)
    assert not row.passed
    assert truth_row_of(1.14, 1.1, 1.0).passed
    assert not truth_row_of(1.16, 1.1, 1.0).passed
    assert truth_row_of(1.0, 1.0, 1.0).passed


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("ours", [1.0, 5.0, math.nan, math.inf])
def test_a_truth_is_nothing_without_numbers(ours: float, bad: float) -> None:
    assert not truth_row_of(ours, bad, 1.0).passed
    assert not truth_row_of(ours, 1.1, bad).passed
    assert not truth_row_of(bad, 1.1, 1.0).passed


def test_a_rotated_descriptor_misses() -> None:
    row = row_of({"a": [1.0]}, {"a": [1.0]})
    theirs = np.array([[0.6, 0.8], [1.0, 0.0]])
    loose, strict = (dataclasses.replace(row, tolerance=bound) for bound in (0.11, 0.05))
    # cos(0.1) = 1 - 0.1^2 / 2 + 0.1^4 / 24; a square of 0.0121 passes, 0.0025 does not.
    turned = np.array([[0.6, 0.8], [math.cos(0.1), math.sin(0.1)]])
    found = cosine_row(strict, turned, theirs)
    assert found.relative == pytest.approx(0.0049958, rel=1e-4)
    assert found.tolerance == pytest.approx(0.0025)
    assert not found.passed
    assert cosine_row(loose, turned, theirs).passed
    assert cosine_row(strict, 3 * theirs, theirs).passed  # only the direction counts
    # In float64 a square of 1e-28 is below the resolution of a sum of 1, as the reason says.
    exact = dataclasses.replace(row, tolerance=1e-14)
    found = cosine_row(exact, theirs, theirs)
    assert (found.tolerance, found.passed) == (1e-15, True)
    assert "squared:" not in found.why
    assert not cosine_row(exact, turned, theirs).passed
    assert not cosine_row(exact, np.full((2, 2), math.nan), theirs).passed


def test_files(tmp_path: pathlib.Path) -> None:
    rows = [row_of({"a": [1.0]}, {"a": [1.0]}), row_of({"a": [math.nan]}, {"a": [1.0]})]
    write_report(tmp_path / "new", rows, {"seed": 7})
    document = json.loads((tmp_path / "new/parity.json").read_text())
    assert document["passed"] is False
    assert document["settings"] == {"seed": 7}
    assert [row["passed"] for row in document["rows"]] == [True, False]
    assert document["rows"][1]["relative"] is None
    text = (tmp_path / "new/parity.md").read_text()
    assert "2 rows, 1 missed" in text
    assert "| layer | forward | a | 1 | 0.0e+00 | 0.0e+00 | 5.0e-01 | pass |" in text
    assert "| layer | forward | a | 1 | nan | inf | 5.0e-01 | MISS |" in text
    assert "- **5.0e-01**: for a test." in text
    assert terminal_table(rows, "float32").row_count == 2
    assert terminal_table(rows, "float64").row_count == 0
    unheld = dataclasses.replace(rows[0], tolerance=math.inf)
    write_report(tmp_path, [unheld], {})
    (found,) = json.loads((tmp_path / "parity.json").read_text())["rows"]
    assert (found["tolerance"], found["passed"]) == (None, False)


def test_the_command_passes_and_misses(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["--only", "MINER", "--precision", "float32", "--out", str(tmp_path)]
    assert main(command) == 0
    assert "1 rows, none missed" in capsys.readouterr().out
    real = parity.cases.parts.mine
    monkeypatch.setattr(parity.cases.parts, "mine", lambda *x, margin: real(*x, margin=10 * margin))
    assert main(command) == 1
    assert not json.loads((tmp_path / "parity.json").read_text())["passed"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--precision", "float16"], "--precision: found 'float16'"),
        (["--only", "no such layer"], "--only: found 'no such layer'"),
        (["--only", "pixels", "--precision", "bfloat16"], "nothing that is compared in bfloat16"),
        (["--seed", "-1"], "--seed: found -1"),
        (["--out", __file__], "test_report.py"),
        (["--seed", "one"], "seed"),
        (["--colour"], "colour"),
    ],
)
def test_bad_arguments(
    arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    shown = capsys.readouterr()
    assert complaint in shown.err
    assert not shown.out


def test_only_what_has_something_to_say_is_offered() -> None:
    bfloat16, others = checks("bfloat16", 0), [checks(x, 0) for x in ("float32", "float64")]
    assert [list(found) for found in others] == [[what.name for what in (*CASES, *RUNS)]] * 2
    assert bfloat16.keys() == others[0].keys() - {c.name for c in CASES if not c.bfloat16}
    assert "pixels to numbers" not in bfloat16


def test_a_precision_without_the_layer_is_left_out(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["--only", "pixels", "--precision", "bfloat16,float32", "--out", str(tmp_path)]
    assert main(command) == 0
    assert "1 rows, none missed" in capsys.readouterr().out
    document = json.loads((tmp_path / "parity.json").read_text())
    assert [row["precision"] for row in document["rows"]] == ["float32"]
