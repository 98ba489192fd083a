"""VPR-Bench: positives as its file lists them, and files that try to run code."""

import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from crisalad_jax.data.benchmarks import read_vpr_bench
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note
from tests.data.benchmarks.trees import (
    every_tenth,
    lists_of,
    touch,
    truth_rows,
    write_vpr_bench,
)


@pytest.mark.parametrize("as_array", [False, True])
def test_vpr_bench(tmp_path, as_array):
    wrap = np.array if as_array else list
    truth = truth_rows((2, wrap([3, 1])), (0, wrap([-1])), (1, wrap([0])))
    benchmark = read_vpr_bench(write_vpr_bench(tmp_path / "hall", truth))
    assert benchmark.name == "hall (VPR-Bench)"
    assert [path.name for path in benchmark.queries] == [f"{i:07d}.jpg" for i in range(3)]
    assert lists_of(benchmark.positives) == [[], [0], [1, 3]]


@pytest.mark.parametrize("protocol", range(2, 6))
def test_vpr_bench_reads_pickles_of_every_age(tmp_path, protocol):
    rows = truth_rows((np.int64(0), np.array([1, 3])), (1, [np.int32(0)]), (2, 2))
    root = write_vpr_bench(tmp_path, rows)
    # An array saved by Python 3 at protocol 2 spells its bytes through _codecs.encode.
    with (root / "ground_truth_new.npy").open("wb") as file:
        header = {"descr": "|O", "fortran_order": False, "shape": (3, 2)}
        np.lib.format.write_array_header_1_0(file, header)
        pickle.dump(rows, file, protocol=protocol)
    assert lists_of(read_vpr_bench(root).positives) == [[1, 3], [0], [2]]


def test_vpr_bench_reads_plain_integers(tmp_path):
    root = write_vpr_bench(tmp_path, np.array([[0, 3], [1, -1], [2, 0]]))
    assert lists_of(read_vpr_bench(root).positives) == [[3], [], [0]]


def test_vpr_bench_sorts_by_number(tmp_path):
    truth = truth_rows((0, [10]), (1, [9]), (2, [2]))
    root = write_vpr_bench(tmp_path, truth, references=0)
    for i in range(12):
        touch(root / "ref" / f"{i}.jpg")
    benchmark = read_vpr_bench(root)
    matched = [benchmark.database[p[0]].name for p in benchmark.ground_truth()]
    assert matched == ["10.jpg", "9.jpg", "2.jpg"]


def test_vpr_bench_refuses_a_gap_in_the_numbers(tmp_path):
    root = write_vpr_bench(tmp_path, truth_rows((0, [0]), (1, [1]), (2, [2])))
    (root / "ref" / "0000001.jpg").unlink()
    with pytest.raises(
        InputError, match=r"ref/0000002.jpg: found after number 0, expected number 1"
    ):
        read_vpr_bench(root)


def test_vpr_bench_leaves_out_references_after_the_last_image(tmp_path):
    """As published for GardensPointWalking, whose query 199 has 197 to 201 of 200 references."""
    rows = truth_rows((0, [0, 1]), (1, [2, 3, 4]), (2, [3, 4, 5]))
    root = write_vpr_bench(tmp_path, rows)
    with pytest.warns(Note, match=r"found 3 references after the last of 4 images, .* left out"):
        benchmark = read_vpr_bench(root)
    assert lists_of(benchmark.positives) == [[0, 1], [2, 3], [3]]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(0, [0]), (1, [4]), (2, [0])], "row 1: found reference indices 4 to 4, expected 0 to 3"),
        ([(0, [-2]), (1, [1]), (2, [0])], "row 0: found reference indices -2 to -2"),
        ([(0, [0]), (3, [1]), (2, [0])], "row 1: found query .3., expected one from 0 to 2"),
        ([(0, [0]), (0, [1]), (2, [0])], "row 1: found query .0., .* no other row has"),
        ([(0, [0]), (1, [1])], r"found shape \(2, 2\), expected \(3, 2\)"),
        ([(0, [0]), (1, ["a"]), (2, [0])], "row 1: .*expected indices"),
        ([(0, [0]), (1, [0.5]), (2, [0])], "row 1: found values of type float, expected indices"),
        ([(0, [0]), (1, [True]), (2, [0])], "row 1: found values of type bool, expected indices"),
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
    words = "found no such file" if damage == "missing" else "cannot be read"
    with pytest.raises(InputError, match=rf"ground_truth_new\.npy: {words}") as caught:
        read_vpr_bench(root)
    assert "\n" not in str(caught.value)


def test_vpr_bench_missing_folder(tmp_path):
    touch(tmp_path / "ref" / "0000000.jpg")
    with pytest.raises(InputError, match="found ref/, expected a folder query"):
        read_vpr_bench(tmp_path)


@pytest.mark.parametrize(("queries", "database"), [(3, 22), (3, 21), (12, 120)])
def test_nordland_star_is_told_by_its_ground_truth(tmp_path, queries, database):
    truth = truth_rows(*enumerate(every_tenth(queries, database)))
    # As published: the first query has a -1, which is no index.
    truth[0, 1] = [-1, 0, 1]
    benchmark = read_vpr_bench(write_vpr_bench(tmp_path / "any", truth, database, queries))
    assert benchmark.name == "Nordland*, winter database, summer queries (VPR-Bench)"
    assert "10i - 1, 10i and 10i + 1" in benchmark.rule
    assert (len(benchmark.database), len(benchmark.queries)) == (database, queries)
    assert lists_of(benchmark.positives) == every_tenth(queries, database)
    assert benchmark.database_positions is None


def test_what_only_resembles_nordland_star_is_not_called_so(tmp_path):
    matches = every_tenth(3, 30)
    matches[2] = [19, 20, 21, 22]
    truth = truth_rows(*enumerate(matches))
    assert read_vpr_bench(write_vpr_bench(tmp_path / "hall", truth, 30)).name == "hall (VPR-Bench)"


def test_vpr_bench_flattens_no_lists_in_lists(tmp_path):
    """Forty lists of the one before, twice each, are a few hundred bytes and 2**40 numbers."""
    bomb: list = [0]
    for _ in range(40):
        bomb = [bomb, bomb]
    root = write_vpr_bench(tmp_path, truth_rows((0, bomb)), queries=1)
    assert (root / "ground_truth_new.npy").stat().st_size < 1000
    with pytest.raises(InputError, match="row 0: found values of type list, expected indices"):
        read_vpr_bench(root)
