"""Commands that are signalled: a handful of signals, and all of them (slow); memory (slow)."""

import pathlib

import pytest

from tests.attack.scripts import rows_of


@pytest.mark.parametrize(
    ("script", "attacks", "scale"),
    [
        ("interruptions", ["some"], 0),
        *(
            pytest.param("interruptions", [name], 1, marks=pytest.mark.slow)
            for name in ("forks", "programs", "training", "busy", "closed output", "long")
        ),
        *(
            pytest.param("memory", [name], 1, marks=pytest.mark.slow)
            for name in ("training", "queries", "cache")
        ),
    ],
)
def test_signalled_commands_end_in_one_line_and_the_same_command_finishes(
    tmp_path: pathlib.Path, script: str, attacks: list[str], scale: float
):
    rows = rows_of(script, tmp_path, "--scale", scale, "--only", *attacks)
    assert all(row["tries"] for row in rows if "before" not in row["attack"])
    assert [line for row in rows for line in row["failures"]] == []
