"""Evaluation sets: positives against brute force, and ground truth files that try to run code."""

import os
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest

from crisalad_jax.data.benchmarks import open_benchmark, read_utm, read_vpr_bench
from crisalad_jax.errors import InputError

REAL = Path(__file__).parents[2].parent / "shared" / "data"


def write_image(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((8, 8, 3), 90, np.uint8))


def utm_name(east: float, north: float, note: str = "") -> str:
    return f"@{east:.2f}@{north:.2f}@10@S@@@{note}@@@@@@@@.jpg"


def write_utm(folder: Path, database: np.ndarray, queries: np.ndarray) -> None:
    for part, points in (("database", database), ("queries", queries)):
        for i, (east, north) in enumerate(points):
            write_image(folder / part / utm_name(east, north, f"{part}{i:04d}"))


def write_vpr_bench(root: Path, truth: object, references: int = 4, queries: int = 3) -> Path:
    for i in range(references):
        write_image(root / "ref" / f"{i:07d}.jpg")
    for i in range(queries):
        write_image(root / "query" / f"{i:07d}.jpg")
    np.save(root / "ground_truth_new.npy", truth, allow_pickle=True)
    return root


def truth_rows(*rows: tuple[object, object]) -> np.ndarray:
    truth = np.empty((len(rows), 2), object)
    for i, row in enumerate(rows):
        truth[i, 0], truth[i, 1] = row
    return truth


def coordinates(paths) -> np.ndarray:
    return np.array([[float(text) for text in path.name.split("@")[1:3]] for path in paths])


@pytest.mark.parametrize("scale", [(200, 30), (30, 200), (0, 200)])
def test_utm_positives_equal_brute_force(tmp_path, scale):
    generator = np.random.default_rng(0)
    database = generator.integers(0, 100, (60, 2)) / 100 * scale
    queries = generator.integers(0, 100, (25, 2)) / 100 * scale
    write_utm(tmp_path / "town" / "images" / "test", database, queries)
    benchmark = read_utm(tmp_path / "town", "test", radius=20.0)
    assert benchmark.name == "town/test (@UTM, 20 m)"
    assert "20 m" in benchmark.rule
    assert len(benchmark.database) == 60
    assert list(benchmark.database) == sorted(benchmark.database)
    there, here = coordinates(benchmark.database), coordinates(benchmark.queries)
    sizes = set()
    for query, positives in zip(here, benchmark.positives, strict=True):
        expected = [i for i in range(60) if ((there[i] - query) ** 2).sum() <= 20 * 20]
        assert positives.tolist() == expected
        sizes.add(len(expected))
    assert len(sizes) > 2


def test_the_radius_is_inclusive(tmp_path):
    # (15, 20) lies exactly 25 m away; the nearest coordinates beyond it do not count
    write_utm(tmp_path, np.array([[15, 20], [15, 20.01], [-25, 0], [90, 90]]), np.zeros((1, 2)))
    benchmark = read_utm(tmp_path)
    found = {
        path.name.split("@")[7] for path in np.array(benchmark.database)[benchmark.positives[0]]
    }
    assert found == {"database0000", "database0002"}
    none = read_utm(tmp_path, radius=3.0)
    assert none.positives[0].shape == (0,)
    assert none.positives[0].dtype == np.int64


def test_utm_finds_its_split(tmp_path):
    root = tmp_path / "town"
    point = np.zeros((1, 2))
    write_utm(root / "images" / "train", point, point)
    with pytest.raises(InputError, match=r"splits train, expected images/test"):
        read_utm(root)
    write_utm(root / "images" / "val", point, point)
    assert read_utm(root).name == "town/val (@UTM, 25 m)"
    write_utm(root / "images" / "test", point, point)
    assert read_utm(root).name == "town/test (@UTM, 25 m)"
    assert read_utm(root, "train").name == "town/train (@UTM, 25 m)"
    assert read_utm(root / "images" / "val", radius=7.5).name == "town/val (@UTM, 7.5 m)"
    with pytest.raises(InputError, match=r"splits test, val, train, expected images/night"):
        read_utm(root, "night")


def test_utm_bad_folders(tmp_path):
    write_image(tmp_path / "images" / "test" / "database" / utm_name(1, 2))
    with pytest.raises(InputError, match="found database/, expected a folder queries"):
        read_utm(tmp_path)
    (tmp_path / "images" / "test" / "queries").mkdir()
    with pytest.raises(InputError, match="queries"):
        read_utm(tmp_path)
    with pytest.raises(InputError, match="radius: found nan"):
        read_utm(tmp_path, radius=float("nan"))


@pytest.mark.parametrize("name", ["street.jpg", "@12.5@.jpg", "@east@2@.jpg", "@1@nan@.jpg"])
def test_utm_names_the_file_without_coordinates(tmp_path, name):
    write_utm(tmp_path, np.zeros((1, 2)), np.zeros((1, 2)))
    write_image(tmp_path / "queries" / name)
    with pytest.raises(InputError, match=f"queries/{name}: found no coordinates"):
        read_utm(tmp_path)


@pytest.mark.parametrize("as_array", [False, True])
def test_vpr_bench(tmp_path, as_array):
    wrap = np.array if as_array else list
    truth = truth_rows((2, wrap([3, 1])), (0, wrap([-1])), (1, wrap([0])))
    benchmark = read_vpr_bench(write_vpr_bench(tmp_path / "hall", truth))
    assert benchmark.name == "hall (VPR-Bench)"
    assert [path.name for path in benchmark.queries] == [f"{i:07d}.jpg" for i in range(3)]
    assert [positives.tolist() for positives in benchmark.positives] == [[], [0], [1, 3]]


@pytest.mark.parametrize("protocol", range(2, 6))
def test_vpr_bench_reads_pickles_of_every_age(tmp_path, protocol):
    rows = truth_rows((np.int64(0), np.array([1, 3])), (1, [np.int32(0)]), (2, 2))
    root = write_vpr_bench(tmp_path, rows)
    # An array saved by Python 3 at protocol 2 spells its bytes through _codecs.encode.
    with (root / "ground_truth_new.npy").open("wb") as file:
        header = {"descr": "|O", "fortran_order": False, "shape": (3, 2)}
        np.lib.format.write_array_header_1_0(file, header)
        pickle.dump(rows, file, protocol=protocol)
    assert [p.tolist() for p in read_vpr_bench(root).positives] == [[1, 3], [0], [2]]


def test_vpr_bench_reads_plain_integers(tmp_path):
    root = write_vpr_bench(tmp_path, np.array([[0, 3], [1, -1], [2, 0]]))
    assert [p.tolist() for p in read_vpr_bench(root).positives] == [[3], [], [0]]


def test_vpr_bench_sorts_by_number(tmp_path):
    truth = truth_rows((0, [10]), (1, [9]), (2, [2]))
    root = write_vpr_bench(tmp_path, truth, references=0)
    for i in range(12):
        write_image(root / "ref" / f"{i}.jpg")
    benchmark = read_vpr_bench(root)
    matched = [benchmark.database[p[0]].name for p in benchmark.positives]
    assert matched == ["10.jpg", "9.jpg", "2.jpg"]


def test_vpr_bench_refuses_a_gap_in_the_numbers(tmp_path):
    root = write_vpr_bench(tmp_path, truth_rows((0, [0]), (1, [1]), (2, [2])))
    (root / "ref" / "0000001.jpg").unlink()
    with pytest.raises(
        InputError, match=r"ref/0000002.jpg: found after number 0, expected number 1"
    ):
        read_vpr_bench(root)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(0, [0]), (1, [4]), (2, [0])], "row 1: found reference indices 4 to 4, expected 0 to 3"),
        ([(0, [-2]), (1, [1]), (2, [0])], "row 0: found reference indices -2 to -2"),
        ([(0, [0]), (3, [1]), (2, [0])], "row 1: found query .3., expected one from 0 to 2"),
        ([(0, [0]), (0, [1]), (2, [0])], "row 1: found query .0., .* no other row has"),
        ([(0, [0]), (1, [1])], r"found shape \(2, 2\), expected \(3, 2\)"),
        ([(0, [0]), (1, ["a"]), (2, [0])], "row 1: .*expected indices"),
        ([(0, [0]), (1, [0.5]), (2, [0])], "row 1: .*float64, expected indices"),
        ([(0, [0]), (1, [[1], [2, 3]]), (2, [0])], "row 1: .*expected indices"),
        ([(0, [0]), (1, None), (2, [0])], "row 1: .*expected indices"),
    ],
)
def test_vpr_bench_bad_indices(tmp_path, rows, message):
    root = write_vpr_bench(tmp_path, truth_rows(*rows))
    with pytest.raises(InputError, match=message) as caught:
        read_vpr_bench(root)
    assert "ground_truth_new.npy" in str(caught.value)
    assert "\n" not in str(caught.value)


class Payload:
    """Makes a folder when unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self):
        return os.mkdir, (str(self.target),)


def test_vpr_bench_runs_no_code_from_the_file(tmp_path):
    target = tmp_path / "ran"
    truth = truth_rows((0, [0]), (1, Payload(target)), (2, [0]))
    root = write_vpr_bench(tmp_path / "set", truth)
    with pytest.raises(
        InputError, match=r"ground_truth_new.npy: .*the file asks for (posix|nt)\.mkdir"
    ):
        read_vpr_bench(root)
    assert not target.exists()
    # The payload is a real one: an ordinary load runs it.
    np.load(root / "ground_truth_new.npy", allow_pickle=True)
    assert target.exists()


@pytest.mark.parametrize("name", ["os system", "builtins eval", "numpy load", "_codecs decode"])
def test_vpr_bench_refuses_any_other_name(tmp_path, name):
    root = write_vpr_bench(tmp_path, truth_rows((0, [0])), queries=1)
    with (root / "ground_truth_new.npy").open("wb") as file:
        header = {"descr": "|O", "fortran_order": False, "shape": (1, 2)}
        np.lib.format.write_array_header_1_0(file, header)
        file.write(b"c" + name.replace(" ", "\n").encode() + b"\n(S'1'\ntR.")
    with pytest.raises(InputError, match=f"the file asks for {name.replace(' ', '.')}"):
        read_vpr_bench(root)


@pytest.mark.parametrize("damage", ["missing", "empty", "truncated", "text", "another object"])
def test_vpr_bench_damaged_ground_truth(tmp_path, damage):
    root = write_vpr_bench(tmp_path, truth_rows((0, [0]), (1, [1]), (2, [2])))
    path = root / "ground_truth_new.npy"
    content = path.read_bytes()
    path.unlink()
    if damage != "missing":
        replacement = {
            "empty": b"",
            "truncated": content[:-20],
            "text": b"0 1\n1 2\n",
            "another object": content[:128] + pickle.dumps({"a": 1}),
        }
        path.write_bytes(replacement[damage])
    with pytest.raises(InputError, match=r"ground_truth_new\.npy: cannot be read") as caught:
        read_vpr_bench(root)
    assert "\n" not in str(caught.value)


def test_vpr_bench_missing_folder(tmp_path):
    write_image(tmp_path / "ref" / "0000000.jpg")
    with pytest.raises(InputError, match="found ref/, expected a folder query"):
        read_vpr_bench(tmp_path)


def test_open_benchmark_finds_the_layout(tmp_path):
    write_utm(tmp_path / "a" / "images" / "val", np.zeros((2, 2)), np.zeros((1, 2)))
    assert open_benchmark(tmp_path / "a", radius=5.0).name == "a/val (@UTM, 5 m)"
    write_utm(tmp_path / "b", np.zeros((2, 2)), np.zeros((1, 2)))
    assert open_benchmark(tmp_path / "b").name == "b (@UTM, 25 m)"
    write_vpr_bench(tmp_path / "c", truth_rows((0, [0]), (1, [1]), (2, [2])))
    assert open_benchmark(tmp_path / "c").name == "c (VPR-Bench)"
    with pytest.raises(InputError, match="split: found 'val'"):
        open_benchmark(tmp_path / "c", "val")


def test_open_benchmark_says_what_it_found(tmp_path):
    (tmp_path / "pictures").mkdir()
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(InputError, match=r"found notes.txt, pictures/; expected images/.* ref/"):
        open_benchmark(tmp_path)
    with pytest.raises(InputError, match="nowhere: found no such folder"):
        open_benchmark(tmp_path / "nowhere")


@pytest.mark.skipif(not REAL.is_dir(), reason="needs the real photographs")
def test_real_sets():
    sped = open_benchmark(REAL / "sped_val")
    assert sped.name == "sped_val/test (@UTM, 25 m)"
    assert [len(p) for p in sped.positives] == [1] * 147
    for path, positives in zip(sped.queries, sped.positives, strict=True):
        # the file names carry the place as well as its placeholder coordinates
        assert path.name.split("@")[1] == sped.database[positives[0]].name.split("@")[1]

    corridor = open_benchmark(REAL / "corridor")
    assert corridor.name == "corridor (VPR-Bench)"
    assert len(corridor.database) == len(corridor.queries) == 111
    for i, positives in enumerate(corridor.positives):
        assert positives.tolist() == list(range(max(0, i - 2), min(110, i + 2) + 1))

    with pytest.raises(InputError, match=r"toy_streets/database/.*: found no coordinates"):
        open_benchmark(REAL / "toy_streets")
