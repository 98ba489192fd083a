"""Two plain folders: a table of matches or of positions, frames, or nothing."""

from pathlib import Path

import numpy as np
import pytest

from crisalad_jax.data.benchmarks import open_benchmark, read_folders
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
        (LINES + "q9.jpg,a.jpg\n", r"line 5: found 'q9.jpg','a.jpg', expected .*below queries/"),
        (LINES + "q1.jpg,b.png\n", r"line 5: found 'q1.jpg','b.png', expected .* and database/"),
        (LINES + ",a.jpg\n", "line 5: found '','a.jpg', expected"),
        (LINES + "q1.jpg\n", "line 5: found 1 fields, expected 2"),
        (LINES + "q1.jpg,a.jpg,street/b.png\n", "line 5: found 3 fields"),
        (LINES + "q1.jpg,\n", "found 1 of 3 queries without a line, or with a match and without"),
        (LINES + "deep/q3.jpg,a.jpg\n", "found 1 of 3 queries .* first is deep/q3.jpg"),
        ("q1.jpg,a.jpg\n", r"found 2 of 3 queries without .* \('deep/q3.jpg,' has no match"),
        ("", "found nothing in the first line, expected query,database"),
        ("database,query\n" + LINES, "line 1: found 'database'"),
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
    with pytest.raises(InputError, match=r"found -1 frames, .* expected at least 0 frames"):
        read_folders(root, frames=-1)
    (root / "ground_truth.csv").write_text("1.jpg,1.jpg\n2.jpg,\n")
    with pytest.raises(InputError, match=r"found --frames and ground_truth.csv, expected one of"):
        read_folders(root, frames=1)
    (root / "ground_truth.csv").unlink()
    touch(root / "queries" / "3.jpg")
    with pytest.raises(InputError, match="found 1 frames, 2 database images and 3 queries"):
        read_folders(root, frames=1)


DATABASE, QUERIES = ("a.jpg", "b.jpg", "deep/c.jpg"), ("q.jpg", "r.jpg")


@pytest.fixture
def mine(tmp_path):
    for name in DATABASE:
        touch(tmp_path / "mine" / "database" / name)
    for name in QUERIES:
        touch(tmp_path / "mine" / "queries" / name)
    return tmp_path / "mine"


def _write(folder, name, axes, rows):
    lines = [f"name,{axes}", *(f"{image},{x},{y}" for image, (x, y) in rows.items())]
    (folder / name).write_text("\n".join(lines), encoding="utf-8")


def _both(there, asked):
    rows = {f"database/{name}": xy for name, xy in zip(DATABASE, there, strict=True)}
    return rows | {f"queries/{name}": xy for name, xy in zip(QUERIES, asked, strict=True)}


def test_metres_in_one_table(mine):
    # r is exactly 25 m from b (15, 20), and 25.02 m from a.
    rows = _both([(0, 0), (30, 40), (500, 0)], [(0, 24), (15, 20)])
    rows["queries/r.jpg"] = (15, 20.02)
    _write(mine, "positions.csv", "east,north", rows | {"another.jpg": (1, 2)})
    benchmark = open_benchmark(mine)
    assert benchmark.name == "mine (two folders, 25 m)"
    assert benchmark.rule == "a distance of at most 25 m"
    assert lists_of(benchmark.positives) == [[0], [1]]
    assert benchmark.database_positions.tolist() == [[0, 0], [30, 40], [500, 0]]
    assert lists_of(open_benchmark(mine, radius=34.1).positives) == [[0, 1], [0, 1]]


def test_degrees_in_a_table_a_side(mine):
    # A thousandth of a degree is 111.2 m of latitude on a sphere, and half of that of longitude at
    # 60 degrees. On the ellipsoid they are 111.4 m and 55.8 m; UTM's scale is 0.9996 to 1.0010.
    there = dict(zip(DATABASE, [(60, 5), (60.001, 5), (60, 5.001)], strict=True))
    _write(mine, "database.csv", "lat,lon", there)
    _write(mine, "queries.csv", "lat,lon", {"q.jpg": (60, 5), "r.jpg": (60.001, 5.001)})
    benchmark = open_benchmark(mine, radius=60)
    assert lists_of(benchmark.positives) == [[0, 2], [1]]
    apart = np.linalg.norm(benchmark.database_positions - benchmark.query_positions[0], axis=1)
    np.testing.assert_allclose(apart, [0, 111.4, 55.8], rtol=1e-3, atol=1e-6)
    assert benchmark.radius == 60


def test_the_whole_world_in_one_table(mine):
    """By the haversine formula a thousandth of a degree is 111.2 m on a sphere of 6371 km.

    The first and the last are 22.2 m apart across 180 degrees, and Melbourne's 111.2 m and 25.
    """
    there = [(0, 179.9999), (-37.81, 144.96), (48.85, 2.35)]
    _write(mine, "positions.csv", "lat,lon", _both(there, [(-37.81022, 144.96), (0, -179.9999)]))
    assert lists_of(open_benchmark(mine).positives) == [[1], [0]]
    for radius in (24, 25):
        assert lists_of(open_benchmark(mine, radius=radius).positives)[0] == [1] * (radius > 24)
    benchmark = open_benchmark(mine)
    places, asked = benchmark.database_positions, benchmark.query_positions
    apart = np.linalg.norm(places[:, None] - asked, axis=2)
    for (lat, lon), row in zip(there, apart, strict=True):
        for (a, b), metres in zip([(-37.81022, 144.96), (0, -179.9999)], row, strict=True):
            lats = np.deg2rad([lat, a])
            turn = np.deg2rad(lon - b)
            half = (
                np.sin((lats[0] - lats[1]) / 2) ** 2 + np.prod(np.cos(lats)) * np.sin(turn / 2) ** 2
            )
            # The chord on a sphere; the ellipsoid is within 0.6 % of it.
            assert metres == pytest.approx(2 * 6_371_000 * np.sqrt(half), rel=6e-3)


def test_a_table_of_matches_goes_first(mine):
    _write(mine, "positions.csv", "east,north", _both([(0, 0)] * 3, [(0, 0)] * 2))
    (mine / "ground_truth.csv").write_text("q.jpg,b.jpg\nr.jpg,\n")
    benchmark = open_benchmark(mine)
    assert lists_of(benchmark.positives) == [[1], []]
    assert benchmark.query_positions.shape == (2, 2)  # for maps
    with pytest.raises(InputError, match=r"found ground_truth\.csv and --radius, expected one of"):
        open_benchmark(mine, radius=5)


def test_a_radius_needs_positions(mine):
    with pytest.raises(InputError, match=r"found --radius, expected .* with positions"):
        open_benchmark(mine, radius=5)


def test_tables_that_do_not_fit(mine):
    rows = {f"database/{name}": (0, 0) for name in DATABASE}
    _write(mine, "positions.csv", "lat,lon", rows | {"queries/q.jpg": (0, 0)})
    message = r"positions\.csv: found 1 of 2 images without a line, .* first is queries/r\.jpg"
    with pytest.raises(InputError, match=message):
        open_benchmark(mine)
    (mine / "positions.csv").unlink()
    _write(mine, "database.csv", "lat,lon", dict.fromkeys(DATABASE, (0, 0)))
    with pytest.raises(InputError, match=r"queries\.csv: found no such file, expected a table"):
        open_benchmark(mine)
    _write(mine, "queries.csv", "east,north", dict.fromkeys(QUERIES, (0, 0)))
    with pytest.raises(InputError, match=r"found columns .*'lat'.*, expected .*'east'"):
        open_benchmark(mine)
