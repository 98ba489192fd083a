"""NetVLAD's .mat files, as scipy writes them."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io

from crisalad_jax.data.benchmarks import open_benchmark, read_netvlad
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.mat_files import load_mat
from tests.data.benchmarks.trees import lists_of, refused, touch_all

GENERATOR = np.random.default_rng(0)
# Millimetres, so that none lies on the edge of the radius but those that are put there.
DATABASE = GENERATOR.integers(0, 100_000, (30, 2)) / 1000 + np.array([585000, 4477000])
QUERIES = GENERATOR.integers(0, 100_000, (9, 2)) / 1000 + np.array([585000, 4477000])
DATABASE_NAMES = [f"{i // 10:03d}/{i:06d}_pitch1_yaw{1 + i % 12}.jpg" for i in range(30)]
QUERY_NAMES = [f"00{i % 2}/{i:06d}_pitch2_yaw3.jpg" for i in range(9)]


def cells(names: list[str], *, row: bool = False) -> np.ndarray:
    """A cell array, which MATLAB may hold as a column or as a row."""
    array = np.empty((len(names), 1), object)
    array[:, 0] = names
    return array.T if row else array


def struct(**changes: object) -> dict[str, object]:
    """In the order of the published files; Tokyo's have more fields in between."""
    return {
        "whichSet": "test",
        "dbImage": cells(DATABASE_NAMES),
        "utmDb": DATABASE.T,
        "dbTimeStamp": np.zeros((1, 30)),
        "qImage": cells(QUERY_NAMES),
        "utmQ": QUERIES.T,
        "numDb": 30.0,
        "numQ": 9.0,
        "posDistThr": 25.0,
        "posDistSqThr": 625.0,
        "nonTrivPosDistSqThr": 100.0,
    } | changes


def write(path: Path, **changes: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    scipy.io.savemat(path, {"dbStruct": struct(**changes)})
    return path


def write_images(root: Path, database: str = ".", queries: str = "queries_real") -> None:
    touch_all(root / database, DATABASE_NAMES)
    touch_all(root / queries, QUERY_NAMES)


def brute_force(radius: float) -> list[list[int]]:
    return [
        [i for i, place in enumerate(DATABASE) if np.hypot(*(place - query)) <= radius]
        for query in QUERIES
    ]


def test_positives_equal_brute_force(tmp_path):
    write_images(tmp_path)
    benchmark = read_netvlad(write(tmp_path / "datasets" / "pitts30k_test.mat"))
    assert benchmark.name == "pitts30k_test (NetVLAD .mat, test set, 25 m)"
    assert benchmark.rule == "UTM distance of at most 25 m"
    names = [path.relative_to(tmp_path).as_posix() for path in benchmark.database]
    assert names == DATABASE_NAMES
    names = [path.relative_to(tmp_path / "queries_real").as_posix() for path in benchmark.queries]
    assert names == QUERY_NAMES
    assert lists_of(benchmark.positives) == brute_force(25)
    np.testing.assert_array_equal(benchmark.database_positions, DATABASE)
    np.testing.assert_array_equal(benchmark.query_positions, QUERIES)


def test_the_files_radius_holds_unless_another_is_given(tmp_path):
    write_images(tmp_path)
    path = write(tmp_path / "a.mat", posDistThr=12.0)
    assert read_netvlad(path).name == "a (NetVLAD .mat, test set, 12 m)"
    assert lists_of(read_netvlad(path).positives) == brute_force(12)
    assert lists_of(read_netvlad(path, 40.0).positives) == brute_force(40)


@pytest.mark.parametrize(
    ("database", "queries"),
    [(".", "queries_real"), ("images", "queries"), ("images", "query"), (".", "."), (".", "query")],
)
def test_images_are_found_where_the_tools_have_them(tmp_path, database, queries):
    path = write(tmp_path / "specs" / "a.mat", dbImage=cells(DATABASE_NAMES, row=True))
    write_images(tmp_path / "far" / "away", database, queries)
    benchmark = read_netvlad(path, images=tmp_path / "far" / "away")
    assert all(image.is_file() for image in (*benchmark.database, *benchmark.queries))
    assert benchmark.queries[3] == tmp_path / "far" / "away" / queries / QUERY_NAMES[3]
    with refused(r"30 of 30 images missing, .* \(--images\); the first is 000/"):
        read_netvlad(path)


def test_queries_with_the_names_of_database_images_are_not_taken_for_these(tmp_path):
    write_images(tmp_path)
    path = write(tmp_path / "a.mat", qImage=cells(DATABASE_NAMES[:9]))
    touch_all(tmp_path / "queries_real", DATABASE_NAMES[:9])
    expected = tuple(tmp_path / "queries_real" / name for name in DATABASE_NAMES[:9])
    assert read_netvlad(path).queries == expected


def test_missing_images_are_counted(tmp_path):
    write_images(tmp_path)
    path = write(tmp_path / "a.mat")
    for name in DATABASE_NAMES[4:7]:
        (tmp_path / name).unlink()
    with refused(rf"found 3 of 30 images missing.*{DATABASE_NAMES[4]}"):
        read_netvlad(path)
    # Under "skip" they stay in the set, for the reader of images; also the first, by which the
    # folder is found.
    whole = read_netvlad(path, on_bad_image="skip")
    (tmp_path / DATABASE_NAMES[0]).unlink()
    skipped = open_benchmark(path, on_bad_image="skip")
    assert skipped.database == whole.database
    assert skipped.database == tuple(tmp_path / name for name in DATABASE_NAMES)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"numDb": 30.5}, "found .*30 names, a count of 30.5 and positions"),
        ({"numQ": 8.0}, "9 names, a count of 8"),
        ({"utmDb": DATABASE}, r"30 names, .* positions of shape \(30, 2\)"),
        ({"utmQ": np.full((2, 9), np.nan)}, "positions of shape .*, which must be finite"),
        ({"utmQ": "here"}, "a.mat: found .*, expected a struct dbStruct of NetVLAD"),
        ({"posDistThr": -1.0}, "radius: found -1.0"),
    ],
)
def test_bad_structs(tmp_path, changes, message):
    write_images(tmp_path)
    path = write(tmp_path / "a.mat", **changes)
    with refused(message):
        read_netvlad(path)


def test_bad_files(tmp_path):
    path = tmp_path / "a.mat"
    with refused(r"a.mat: found no such file, expected a .mat file"):
        read_netvlad(path)
    path.write_bytes(b"not a mat file at all" * 20)
    with refused(r"a.mat: cannot be read as a .mat file"):
        read_netvlad(path)
    scipy.io.savemat(path, {"other": np.zeros(3)})
    with refused(r"a.mat: found .*other.*, expected a struct dbStruct"):
        read_netvlad(path)
    scipy.io.savemat(path, {"dbStruct": {"whichSet": "val", "numDb": 3.0}})
    with refused(r"a.mat: found .*posDistThr.*, expected a struct"):
        read_netvlad(path)
    # What such a file begins with; the rest is HDF5.
    header = b"MATLAB 7.3 MAT-file".ljust(124) + bytes([0, 2]) + b"IM"
    path.write_bytes(header + bytes(512))
    with refused(r"a.mat: found MATLAB's format 7.3, expected 7"):
        read_netvlad(path)


def test_a_small_file_that_unpacks_to_much_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"dbStruct": np.zeros(3_000_000, np.uint8)}, do_compression=True)
    assert path.stat().st_size < 10_000
    expected = {"expected": "a set", "damaged": "damaged"}
    assert load_mat(path, **expected, largest=3_001_000)["dbStruct"].size == 3_000_000
    monkeypatch.setattr(scipy.io, "loadmat", None)
    with pytest.raises(InputError, match=r"a.mat: found more than 2999999 bytes once it is unp"):
        load_mat(path, **expected, largest=2_999_999)
