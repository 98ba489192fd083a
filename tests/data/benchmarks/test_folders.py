"""Two plain folders: a table of matches, frames, or nothing."""

from pathlib import Path

import pytest

from crisalad_jax.data.benchmarks import read_folders
from crisalad_jax.utils.errors import InputError
from tests.data.benchmarks.trees import lists_of, touch, touch_all


def write(root: Path, table: str | None = None) -> Path:
    for name in ("a.jpg", "street/b.png", "street/c d.jpg"):
        touch(root / "database" / name)
    for name in ("q1.jpg", "q2.jpg", "deep/q3.jpg"):
        touch(root / "queries" / name)
    if table is not None:
        (root / "ground_truth.csv").write_text(table, encoding="utf-8")
    return root


LINES = "q2.jpg,street/c d.jpg\nq1.jpg,a.jpg\nq2.jpg,a.jpg\n deep/q3.jpg ,\n"


@pytest.mark.parametrize("header", ["", "query,database\n", "\ufeffquery,database\r\n", "\n"])
def test_a_table_of_matches(tmp_path, header):
    benchmark = read_folders(write(tmp_path / "hall", header + LINES + "\nq2.jpg,a.jpg\n"))
    assert benchmark.name == "hall (two folders, ground_truth.csv)"
    assert benchmark.rule == "the database images that ground_truth.csv lists"
    names = [path.relative_to(tmp_path / "hall").as_posix() for path in benchmark.queries]
    assert names == ["queries/deep/q3.jpg", "queries/q1.jpg", "queries/q2.jpg"]
    assert [path.name for path in benchmark.database] == ["a.jpg", "b.png", "c d.jpg"]
    assert lists_of(benchmark.positives) == [[], [0], [0, 2]]
    assert benchmark.database_positions is None


def test_a_split(tmp_path):
    write(tmp_path / "hall" / "images" / "val", LINES)
    assert read_folders(tmp_path / "hall").name == "hall/val (two folders, ground_truth.csv)"
    with pytest.raises(InputError, match="splits val, expected images/test"):
        read_folders(tmp_path / "hall", "test")


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (LINES + "q9.jpg,a.jpg\n", r"line 5: found query 'q9.jpg', expected .*below .*queries"),
        (LINES + "q1.jpg,b.png\n", r"line 5: found database 'b.png', expected .*below .*database"),
        (LINES + ",a.jpg\n", "line 5: found query '', expected"),
        (LINES + "q1.jpg\n", "line 5: found 1 fields, expected query,database"),
        (LINES + "q1.jpg,a.jpg,street/b.png\n", "line 5: found 3 fields"),
        (LINES + "q1.jpg,\n", "line 5: found 'q1.jpg' with a match and without, expected either"),
        (LINES + "deep/q3.jpg,a.jpg\n", "line 5: found 'deep/q3.jpg' with a match and without"),
        ("q1.jpg,a.jpg\n", r"found 2 of 3 queries without a line, .* \('deep/q3.jpg,' where"),
        ("", "found 3 of 3 queries without a line"),
        ("database,query\n" + LINES, "line 1: found query 'database'"),
    ],
)
def test_bad_tables(tmp_path, table, message):
    with pytest.raises(InputError, match=message) as caught:
        read_folders(write(tmp_path, table))
    assert str(caught.value).startswith(str(tmp_path / "ground_truth.csv"))
    assert "\n" not in str(caught.value)


def test_a_table_that_is_no_text(tmp_path):
    (write(tmp_path) / "ground_truth.csv").write_bytes(b"q1.jpg,\xff\xfe\n")
    with pytest.raises(InputError, match=r"ground_truth.csv: cannot be read as UTF-8 CSV"):
        read_folders(tmp_path)


def test_nothing_tells(tmp_path):
    benchmark = read_folders(write(tmp_path / "hall"))
    assert benchmark.name == "hall (two folders, no ground truth)"
    assert benchmark.positives is None
    with pytest.raises(InputError, match=r"hall: hall \(two.*: no ground truth, nothing to score"):
        benchmark.ground_truth()


def write_frames(root: Path, names: list[str]) -> Path:
    for part in ("database", "queries"):
        touch_all(root / part, names)
    return root


@pytest.mark.parametrize("frames", [0, 1, 4, 50])
def test_frames(tmp_path, frames):
    # Numbers without zeros in front: sorted as text, frame 10 would stand before frame 9.
    root = write_frames(tmp_path / "train ride", [f"frame{i}.png" for i in range(12)])
    benchmark = read_folders(root, frames=frames)
    words = "1 frame" if frames == 1 else f"{frames} frames"
    assert benchmark.name == f"train ride (two folders, +-{words})"
    for paths in (benchmark.database, benchmark.queries):
        assert [path.name for path in paths] == [f"frame{i}.png" for i in range(12)]
    expected = [[j for j in range(12) if abs(i - j) <= frames] for i in range(12)]
    assert lists_of(benchmark.positives) == expected


def test_selavprs_nordland_is_told_by_its_size(tmp_path):
    root = write_frames(tmp_path, [f"{i:05d}.jpg" for i in range(3450)])
    benchmark = read_folders(root, frames=2)
    assert benchmark.name == "Nordland-test (SelaVPR: 3450 + 3450 images, +-2 frames)"
    assert "by its number of images" in benchmark.rule
    positives = lists_of(benchmark.positives)
    assert positives[:4] == [[0, 1, 2], [0, 1, 2, 3], [0, 1, 2, 3, 4], [1, 2, 3, 4, 5]]
    assert positives[-1] == [3447, 3448, 3449]
    assert "Nordland" not in read_folders(root, frames=3).name


def test_bad_frames(tmp_path):
    root = write_frames(tmp_path, ["1.jpg", "2.jpg"])
    with pytest.raises(InputError, match="frames: found -1, expected a number from 0"):
        read_folders(root, frames=-1)
    (root / "ground_truth.csv").write_text("1.jpg,1.jpg\n2.jpg,\n")
    with pytest.raises(InputError, match=r"frames: found 1 beside .*ground_truth.csv, expected"):
        read_folders(root, frames=1)
    (root / "ground_truth.csv").unlink()
    touch(root / "queries" / "3.jpg")
    with pytest.raises(InputError, match="frames: found 2 database images and 3 queries"):
        read_folders(root, frames=1)
