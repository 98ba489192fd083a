"""Errors, verdicts, the files and the exit codes."""

import json
import math
import pathlib

import numpy as np
import pytest

import parity.cases.parts
from parity.__main__ import main
from parity.compare import Row, Tolerance, compare, relative_error
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


def test_noise_is_measured_by_what_cancels() -> None:
    ours, theirs = {"dead": [2e-3], "alive": [4.0]}, {"dead": [-1e-3], "alive": [4.0]}
    assert not row_of(ours, theirs).passed
    row = row_of(ours, theirs, {"dead": "alive"})
    assert row.passed
    # The larger of the two against what cancels, not their difference.
    assert row.relative == pytest.approx(2e-3 / 4)
    assert not row_of({**ours, "dead": [3.0]}, theirs, {"dead": "alive"}).passed


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


def test_the_command_passes_and_misses(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["--only", "MINER", "--precision", "float32", "--out", str(tmp_path)]
    assert main(command) == 0
    assert "1 rows, none missed" in capsys.readouterr().out
    real = parity.cases.parts.mine
    monkeypatch.setattr(
        parity.cases.parts, "mine", lambda *x, epsilon: real(*x, epsilon=10 * epsilon)
    )
    assert main(command) == 1
    assert not json.loads((tmp_path / "parity.json").read_text())["passed"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--precision", "float16"], "--precision: found 'float16'"),
        (["--only", "no such layer"], "--only: found 'no such layer'"),
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
    assert complaint in capsys.readouterr().err
