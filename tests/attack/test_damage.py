"""No changed byte passes in silence: a few changes of each kind of file, and many (slow)."""

import pathlib

import pytest

from tests.attack.scripts import rows_of


@pytest.mark.parametrize("changes", [2, pytest.param(300, marks=pytest.mark.slow)])
def test_no_changed_byte_is_silent(tmp_path: pathlib.Path, changes: int):
    rows = rows_of("damage", tmp_path, "--changes", changes, "--seed", 1)
    assert [row["tries"] for row in rows] == [changes] * 16
    assert [line for row in rows for line in row["failures"]] == []
