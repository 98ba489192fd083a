"""Commands that are killed: a handful of kills, and all of them (slow)."""

import pathlib

import pytest

from tests.attack.scripts import rows_of


@pytest.mark.parametrize(
    ("attacks", "scale"),
    [
        (["maps", "extract .npy"], 0),
        pytest.param(["training"], 1, marks=pytest.mark.slow),
        pytest.param(["maps", "extract .npy", "extract .h5"], 1, marks=pytest.mark.slow),
        pytest.param(["compare"], 1, marks=pytest.mark.slow),
    ],
)
def test_killed_commands_go_on_and_end_with_the_same_bits(
    tmp_path: pathlib.Path, attacks: list[str], scale: float
):
    rows = rows_of("kills", tmp_path, "--scale", scale, "--only", *attacks)
    assert all(row["tries"] for row in rows)
    assert [line for row in rows for line in row["failures"]] == []
