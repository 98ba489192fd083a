"""Bad inputs end in one line: a sample of those that fail early, and all of them (slow)."""

import pathlib

import pytest

from tests.attack.scripts import rows_of


@pytest.mark.parametrize(
    ("chosen", "tries"),
    [
        (("--quick", "--most", 16), 16),
        pytest.param((), 1600, marks=pytest.mark.slow),
    ],
)
def test_bad_inputs_end_in_one_line(tmp_path: pathlib.Path, chosen: tuple, tries: int):
    rows = rows_of("inputs", tmp_path, *chosen)
    assert sum(row["tries"] for row in rows) >= tries
    failures = [f"{row['attack']}: {line}" for row in rows for line in row["failures"]]
    assert failures == []
