"""Sets with .npy files: VPR-Bench's folders, and the lists of GSV-Cities and SALAD."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from crisalad_jax.data.benchmarks import read_salad_lists, read_vpr_bench
from crisalad_jax.utils.output import Note
from tests.data.benchmarks.trees import (
    every_tenth,
    lists_of,
    ragged,
    refused,
    touch_all,
    truth_rows,
    write_vpr_bench,
)

DATABASE = [f"00{i}/{i:06d}_pitch1_yaw1.jpg" for i in range(5)]
QUERIES = [f"00{i}/{i:06d}_pitch1_yaw2.jpg" for i in range(3)]
TRUTH = ragged(np.array([4, 1]), np.array([0]), np.array([2, 3, 1]))
POSITIVES = [[1, 4], [0], [1, 2, 3]]


def write_lists(folder: Path, prefix: str, **arrays: object) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for kind, array in arrays.items():
        np.save(folder / f"{prefix}{kind}.npy", np.asarray(array), allow_pickle=True)
    return folder


def write_set(root: Path, prefix: str = "a_", **changes: object) -> Path:
    """Images, and the lists of them beside these."""
    touch_all(root, DATABASE + QUERIES)
    arrays = {"dbImages": DATABASE, "qImages": QUERIES, "gt": TRUTH} | changes
    return write_lists(root, prefix, **arrays)


@pytest.mark.parametrize("queries_in", ["", "queries_real/"])
@pytest.mark.parametrize("named_in", ["", "queries_real/"])
def test_pittsburgh(tmp_path, queries_in, named_in):
    """Queries in their own folder, which the list may name or leave out."""
    names = [named_in + name for name in QUERIES]
    lists = write_lists(
        tmp_path / "lists", "pitts30k_test_", dbImages=DATABASE, qImages=names, gt=TRUTH
    )
    stored = [queries_in + name for name in QUERIES]
    images = touch_all(tmp_path / "photos", DATABASE + stored)
    if named_in and not queries_in:
        with refused(r"3 of 3 images missing, .* first is queries_real/"):
            read_salad_lists(lists, images=images)
        return
    benchmark = read_salad_lists(lists, images=images)
    assert benchmark.name == "pitts30k_test (SALAD's lists)"
    assert benchmark.rule == "the database images that pitts30k_test_gt.npy lists"
    assert [path.relative_to(images).as_posix() for path in benchmark.database] == DATABASE
    assert [path.relative_to(images).as_posix() for path in benchmark.queries] == stored
    assert lists_of(benchmark.positives) == POSITIVES
    assert benchmark.database_positions is None


def msls_names(part: str, count: int) -> list[str]:
    return [
        f"train_val/{'cph' if i < count // 2 else 'sf'}/{part}/images/{part[0]}{i}.jpg"
        for i in range(count)
    ]


def test_msls_asks_the_queries_of_its_index(tmp_path):
    images = touch_all(tmp_path, msls_names("database", 6) + msls_names("query", 8))
    lists = write_lists(
        tmp_path / "msls_val",
        "msls_val_",
        dbImages=msls_names("database", 6),
        qImages=msls_names("query", 8),
        qIdx=np.array([6, 0, 3]),
        pIdx=ragged(np.array([5, 4]), np.array([0]), np.array([2, 1])),
    )
    for given in ({}, {"images": images}):
        benchmark = read_salad_lists(lists, **given)
        assert benchmark.name == "MSLS val, 3 queries (SALAD's list)"
        assert [path.name for path in benchmark.queries] == ["q6.jpg", "q0.jpg", "q3.jpg"]
        assert lists_of(benchmark.positives) == [[4, 5], [0], [1, 2]]
        assert all(path.is_file() for path in (*benchmark.database, *benchmark.queries))


def test_without_a_prefix_the_folder_gives_the_name(tmp_path):
    lists = write_set(tmp_path / "hall", "")
    assert read_salad_lists(lists).name == "hall (SALAD's lists)"
    assert lists_of(read_salad_lists(lists / "gt.npy").positives) == POSITIVES


def test_ground_truths_of_one_match_each_are_plain_arrays(tmp_path):
    """What numpy makes of lists of the same length."""
    for truth in (np.array([[4], [0], [-1]]), np.array([4, 0, -1])):
        write_set(tmp_path, gt=truth)
        assert lists_of(read_salad_lists(tmp_path).positives) == [[4], [0], []]


def test_without_ground_truth_there_is_none(tmp_path):
    write_set(tmp_path)
    (tmp_path / "a_gt.npy").unlink()
    benchmark = read_salad_lists(tmp_path)
    assert benchmark.positives is None
    assert "no ground truth" in benchmark.rule


def test_a_folder_of_several_sets(tmp_path):
    for prefix in ("pitts30k_val_", "pitts30k_test_"):
        write_set(tmp_path, prefix)
    # As in SALAD's repository, queries alone.
    write_lists(tmp_path, "pitts250k_test_", qImages=QUERIES)
    with refused("found lists of pitts30k_test, pitts30k_val, expected"):
        read_salad_lists(tmp_path)
    assert read_salad_lists(tmp_path, "val").name == "pitts30k_val (SALAD's lists)"
    chosen = read_salad_lists(tmp_path / "pitts30k_test_dbImages.npy")
    assert chosen.name == "pitts30k_test (SALAD's lists)"
    with refused(r"expected those of one: .*, unlike train"):
        read_salad_lists(tmp_path, "train")
    with refused(r"Images\.npy: found lists of no set, expected"):
        read_salad_lists(tmp_path / "pitts250k_test_qImages.npy")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gt": ragged([0], [1])}, r"a_gt.npy: found shape \(2,\), expected \(3,\): a row"),
        ({"gt": ragged([0], [5], [1])}, "a_gt.npy: row 1: found reference indices 5 to 5"),
        ({"gt": ragged([0], ["x"], [1])}, "a_gt.npy: row 1: found values of type str"),
        ({"qIdx": np.array([0, 3, 1])}, "a_qIdx.npy: found queries .0, 3, 1.*, expected some"),
        ({"qIdx": np.array([0, 0, 1])}, "a_qIdx.npy: found queries .*0, 0, 1"),
        ({"dbImages": np.arange(5)}, "a_dbImages.npy: found int64 of shape .*, expected names"),
        ({"dbImages": np.empty(0, "<U3")}, "a_dbImages.npy: (found|cannot)"),
        ({"qImages": [*QUERIES[:2], "000/none.jpg"]}, "found 1 of 3 images missing.*none.jpg"),
    ],
)
def test_bad_lists(tmp_path, changes, message):
    write_set(tmp_path, **changes)
    with refused(message):
        read_salad_lists(tmp_path)


@pytest.mark.parametrize(
    "truth",
    [
        truth_rows((2, [3, 1]), (0, [-1]), (1, [0])),
        truth_rows(*((i, np.array(found)) for i, found in ((2, [3, 1]), (0, [-1]), (1, [0])))),
        np.array([[2, 3], [0, -1], [1, 0]]),  # plain integers
    ],
)
def test_vpr_bench(tmp_path, truth):
    benchmark = read_vpr_bench(write_vpr_bench(tmp_path / "hall", truth))
    assert benchmark.name == "hall (VPR-Bench)"
    assert [path.name for path in benchmark.queries] == [f"{i:07d}.jpg" for i in range(3)]
    last = [3] if truth.dtype != object else [1, 3]
    assert lists_of(benchmark.positives) == [[], [0], last]


def test_vpr_bench_sorts_by_number_without_a_gap(tmp_path):
    truth = truth_rows((0, [10]), (1, [9]), (2, [2]))
    root = write_vpr_bench(tmp_path, truth, references=0)
    touch_all(root / "ref", [f"{i}.jpg" for i in range(12)])
    benchmark = read_vpr_bench(root)
    matched = [benchmark.database[p[0]].name for p in benchmark.ground_truth()]
    assert matched == ["10.jpg", "9.jpg", "2.jpg"]
    (root / "ref" / "1.jpg").unlink()
    with refused(r"ref/2.jpg: found after number 0, expected number 1"):
        read_vpr_bench(root)
    touch_all(root / "ref", ["1.jpg"])
    shutil.rmtree(root / "query")
    with refused("found ground_truth_new.npy, ref/, expected a folder query"):
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
        ([(0, [0]), (3, [1]), (2, [0])], r"found queries \[0, 3, 2\].*, expected some from 0 to 2"),
        ([(0, [0]), (1, [1])], r"found shape \(2, 2\), expected \(3, 2\)"),
        ([(0, [0]), (1, [0.5]), (2, [0])], "row 1: found values of type float, expected whole"),
        ([(0, [0]), (1, [2**80]), (2, [0])], "row 1: found values of type int, .* of 64 bits"),
    ],
)
def test_vpr_bench_bad_indices(tmp_path, rows, message):
    root = write_vpr_bench(tmp_path, truth_rows(*rows))
    with refused(f"ground_truth_new.npy: .*{message}"):
        read_vpr_bench(root)


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
    with refused("row 0: found values of type list, expected"):
        read_vpr_bench(root)
