"""Two plain folders: a table of matches or of positions, frames, or nothing."""

from pathlib import Path

import numpy as np
import pytest

from crisalad_jax.data.benchmarks import open_benchmark, read_folders
from tests.data.benchmarks.trees import lists_of, refused, touch, write_sides

DATABASE = ("a.jpg", "street/b.png", "street/c d.jpg")
QUERIES = ("deep/q3.jpg", "q1.jpg", "q2.jpg")
LINES = "q2.jpg,street/c d.jpg\nq1.jpg,a.jpg\nq2.jpg,a.jpg\n deep/q3.jpg ,\n"


@pytest.fixture
def hall(tmp_path):
    return write_sides(tmp_path / "hall", DATABASE, QUERIES)


@pytest.mark.parametrize("header", ["", "query,database\n", "\ufeffquery,database\r\n", "\n"])
def test_a_table_of_matches(hall, header):
    table = header + LINES + "\nq2.jpg,a.jpg\n"
    (hall / "ground_truth.csv").write_text(table, encoding="utf-8")
    benchmark = read_folders(hall)
    assert benchmark.name == "hall (two folders, ground_truth.csv)"
    assert benchmark.rule == "the database images that ground_truth.csv lists"
    assert benchmark.queries == tuple(hall / "queries" / name for name in QUERIES)
    assert benchmark.database == tuple(hall / "database" / name for name in DATABASE)
    assert lists_of(benchmark.positives) == [[], [0], [0, 2]]
    assert benchmark.database_positions is None


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (LINES + "q9.jpg,a.jpg\n", r"line 5: found 'q9.jpg','a.jpg', expected .*below queries/"),
        (LINES + "q1.jpg,b.png\n", r"line 5: found 'q1.jpg','b.png', expected .* and database/"),
        (LINES + "q1.jpg\n", "line 5: found 1 fields, expected 2"),
        (LINES + "deep/q3.jpg,a.jpg\n", "found 1 of 3 queries .* first is deep/q3.jpg"),
        ("q1.jpg,a.jpg\n", r"found 2 of 3 queries without .* 'deep/q3.jpg,' means no match"),
        ("", "line 1: found , expected query,database"),
        ("database,query\n" + LINES, "line 1: found 'database'"),
    ],
)
def test_bad_tables(hall, table, message):
    (hall / "ground_truth.csv").write_text(table)
    with refused(rf"hall/ground_truth\.csv: {message}"):
        read_folders(hall)


def test_nothing_tells(hall):
    benchmark = read_folders(hall)
    assert benchmark.name == "hall (two folders, no ground truth)"
    assert benchmark.positives is None
    with refused(r"found --radius, expected .* with positions"):
        open_benchmark(hall, radius=5)


@pytest.mark.parametrize("frames", [0, 1, 4, 50])
def test_frames(tmp_path, frames):
    # Numbers without zeros in front: sorted as text, frame 10 would stand before frame 9.
    names = [f"frame{i}.png" for i in range(12)]
    benchmark = read_folders(write_sides(tmp_path / "train ride", names, names), frames=frames)
    words = "1 frame" if frames == 1 else f"{frames} frames"
    assert benchmark.name == f"train ride (two folders, +-{words})"
    for paths in (benchmark.database, benchmark.queries):
        assert [path.name for path in paths] == names
    expected = [[j for j in range(12) if abs(i - j) <= frames] for i in range(12)]
    assert lists_of(benchmark.positives) == expected


def test_selavprs_nordland_is_told_by_its_size(tmp_path):
    names = [f"{i:05d}.jpg" for i in range(3450)]
    benchmark = read_folders(write_sides(tmp_path, names, names), frames=2)
    assert benchmark.name == "Nordland-test (SelaVPR: 3450 + 3450 images, +-2 frames)"
    assert "by its number of images" in benchmark.rule
    positives = lists_of(benchmark.positives)
    assert positives[:4] == [[0, 1, 2], [0, 1, 2, 3], [0, 1, 2, 3, 4], [1, 2, 3, 4, 5]]
    assert positives[-1] == [3447, 3448, 3449]
    assert "Nordland" not in read_folders(tmp_path, frames=3).name


def test_bad_frames(hall):
    with refused(r"found -1 frames, .* expected at least 0 frames"):
        read_folders(hall, frames=-1)
    (hall / "ground_truth.csv").write_text(LINES)
    with refused(r"found --frames and ground_truth.csv, expected one of"):
        read_folders(hall, frames=1)
    (hall / "ground_truth.csv").unlink()
    touch(hall / "queries" / "3.jpg")
    with refused("found 1 frames, 3 database images and 4 queries"):
        read_folders(hall, frames=1)


def write_positions(folder: Path, axes: str, rows: dict[str, tuple[float, float]]) -> None:
    """A table of both sides, or of the one that the columns begin with."""
    side, _, axes = axes.rpartition(":")
    lines = [f"name,{axes}", *(f"{image},{x},{y}" for image, (x, y) in rows.items())]
    (folder / f"{side or 'positions'}.csv").write_text("\n".join(lines), encoding="utf-8")


def both(there, asked) -> dict[str, tuple[float, float]]:
    names = [*(f"database/{name}" for name in DATABASE), *(f"queries/{name}" for name in QUERIES)]
    return dict(zip(names, [*there, *asked], strict=True))


def test_metres_in_one_table(hall):
    # The last query is exactly 25 m from the second image (15, 20), and 25.02 m from the first.
    rows = both([(0, 0), (30, 40), (500, 0)], [(0, 24), (0, 24), (15, 20.02)])
    write_positions(hall, "east,north", rows | {"another.jpg": (1, 2)})
    benchmark = open_benchmark(hall)
    assert benchmark.name == "hall (two folders, 25 m)"
    assert benchmark.rule == "a distance of at most 25 m"
    assert lists_of(benchmark.positives) == [[0], [0], [1]]
    assert benchmark.database_positions.tolist() == [[0, 0], [30, 40], [500, 0]]
    assert lists_of(open_benchmark(hall, radius=34.1).positives) == [[0, 1]] * 3
    # A table of matches goes first; the positions are for maps.
    (hall / "ground_truth.csv").write_text(LINES)
    benchmark = open_benchmark(hall)
    assert lists_of(benchmark.positives) == [[], [0], [0, 2]]
    assert benchmark.query_positions.shape == (3, 2)
    with refused(r"found ground_truth\.csv and --radius, expected one of"):
        open_benchmark(hall, radius=5)


def test_degrees_in_a_table_a_side(hall):
    # A thousandth of a degree is 111.2 m of latitude on a sphere, and half of that of longitude at
    # 60 degrees. On the ellipsoid they are 111.4 m and 55.8 m; UTM's scale is 0.9996 to 1.0010.
    there = dict(zip(DATABASE, [(60, 5), (60.001, 5), (60, 5.001)], strict=True))
    asked = dict(zip(QUERIES, [(60, 5), (60.001, 5.001), (61, 5)], strict=True))
    write_positions(hall, "database:lat,lon", there)
    write_positions(hall, "queries:lat,lon", asked)
    benchmark = open_benchmark(hall, radius=60)
    assert lists_of(benchmark.positives) == [[0, 2], [1], []]
    apart = np.linalg.norm(benchmark.database_positions - benchmark.query_positions[0], axis=1)
    np.testing.assert_allclose(apart, [0, 111.4, 55.8], rtol=1e-3, atol=1e-6)
    assert benchmark.radius == 60


def test_the_whole_world_in_one_table(hall):
    """22.3 m apart across 180 degrees, and 24.4 m of latitude in Melbourne, by pyproj's Geod."""
    there = [(0, 179.9999), (-37.81, 144.96), (48.85, 2.35)]
    rows = both(there, [(-37.81022, 144.96), (0, -179.9999), (0, 0)])
    write_positions(hall, "lat,lon", rows)
    for radius, expected in ((24.45, [[1], [0], []]), (24.4, [[], [0], []]), (22.2, [[]] * 3)):
        assert lists_of(open_benchmark(hall, radius=radius).positives) == expected


def test_tables_that_do_not_fit(hall):
    rows = both([(0, 0)] * 3, [(0, 0)] * 3)
    del rows["queries/q2.jpg"]
    write_positions(hall, "lat,lon", rows)
    with refused(r"positions\.csv: found .* 1 of 3 images without a line \(queries/q2\.jpg\)"):
        open_benchmark(hall)
    (hall / "positions.csv").unlink()
    write_positions(hall, "database:lat,lon", dict.fromkeys(DATABASE, (0, 0)))
    with refused(r"queries\.csv: found no such file, expected a table"):
        open_benchmark(hall)
    write_positions(hall, "queries:east,north", dict.fromkeys(QUERIES, (0, 0)))
    with refused(r"queries\.csv: found columns east,north, .*expected lat,lon"):
        open_benchmark(hall)
