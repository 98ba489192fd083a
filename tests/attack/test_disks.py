"""On a full disk every verb says one line and leaves nothing half written; all of them (slow)."""

import pathlib

import pytest

from tests.attack.disks import ALL
from tests.attack.scripts import rows_of


@pytest.mark.parametrize(
    ("verbs", "ways", "sizes"),
    [
        ("convert", None, 1),
        pytest.param(",".join(ALL), None, 5, marks=pytest.mark.slow),
        pytest.param("train,evaluate,extract .h5,index", "limit", 3, marks=pytest.mark.slow),
    ],
)
def test_full_disks_end_in_one_line(tmp_path: pathlib.Path, verbs: str, ways: str, sizes: int):
    chosen = [] if ways is None else ["--ways", ways]
    rows = rows_of("disks", tmp_path, "--verbs", verbs, "--sizes", sizes, *chosen)
    assert {row["attack"].rpartition(": ")[2] for row in rows} == set(verbs.split(","))
    assert all(row["tries"] for row in rows)
    assert [line for row in rows for line in row["failures"]] == []
