"""Which layout is found, and which options it takes."""

import re
from pathlib import Path

import numpy as np
import pytest

from crisalad_jax.data.benchmarks import LAYOUTS, open_benchmark
from tests.conftest import PHOTOGRAPHS
from tests.data.benchmarks.test_msls import write_msls
from tests.data.benchmarks.test_netvlad import write as write_mat
from tests.data.benchmarks.test_netvlad import write_images as write_mat_images
from tests.data.benchmarks.test_npy_lists import write_lists, write_set
from tests.data.benchmarks.trees import (
    lists_of,
    ragged,
    refused,
    touch,
    truth_rows,
    write_sides,
    write_utm,
    write_vpr_bench,
)

FLAGS = Path(__file__).parents[3] / "crisalad_jax" / "cli" / "flags.py"


def test_open_benchmark_finds_the_layout(tmp_path):
    write_utm(tmp_path / "a" / "images" / "val", np.zeros((2, 2)), np.zeros((1, 2)))
    assert open_benchmark(tmp_path / "a", radius=5.0).name == "a/val (@UTM, 5 m)"
    write_utm(tmp_path / "b", np.zeros((2, 2)), np.zeros((1, 2)))
    assert open_benchmark(tmp_path / "b").name == "b (@UTM, 25 m)"
    write_vpr_bench(tmp_path / "c", truth_rows((0, [0]), (1, [1]), (2, [2])))
    assert open_benchmark(tmp_path / "c").name == "c (VPR-Bench)"
    with refused("c: found split for the layout vpr-bench"):
        open_benchmark(tmp_path / "c", "val")


def test_svox_is_found_with_the_queries_that_are_asked(tmp_path):
    folder = tmp_path / "svox" / "images" / "test"
    write_utm(folder, np.array([[0, 0], [100, 0]]), np.array([[0, 5]]))
    (folder / "database").rename(folder / "gallery")
    touch(folder / "queries_night" / "@0100.00@0007.00@.jpg")
    touch(folder / "queries_rain" / "@0900.00@0007.00@.jpg")
    for root in (tmp_path / "svox", folder):
        benchmark = open_benchmark(root)
        assert benchmark.name == "svox/test (@UTM, 25 m)"
        assert lists_of(benchmark.positives) == [[0]]
        night = open_benchmark(root, queries="queries_night")
        assert night.name == "svox/test, queries_night (@UTM, 25 m)"
        assert lists_of(night.positives) == [[1]]
        assert night.queries == (folder / "queries_night" / "@0100.00@0007.00@.jpg",)
        assert night.database == benchmark.database
        there = "gallery/, queries/, queries_night/, queries_rain/"
        with refused(f"found {there}, expected a folder queries_fog"):
            open_benchmark(root, queries="queries_fog")
        for unknown in ("gallery", ""):
            with refused(f"queries: found '{unknown}', expected"):
                open_benchmark(root, queries=unknown)


def test_open_benchmark_says_what_it_found(tmp_path):
    (tmp_path / "pictures").mkdir()
    (tmp_path / "notes.txt").write_text("")
    with refused(r"found notes.txt, pictures/; expected images/.* ref/"):
        open_benchmark(tmp_path)


def test_two_folders_are_plain_without_utm_names(tmp_path):
    write_sides(tmp_path / "hall", ["1.jpg"], ["1.jpg"])
    assert open_benchmark(tmp_path / "hall").name == "hall (two folders, no ground truth)"
    assert open_benchmark(tmp_path / "hall", frames=1).name == "hall (two folders, +-1 frame)"
    # One @ name says that the others should have one.
    touch(tmp_path / "hall" / "queries" / "@1@2@.jpg")
    with refused(r"hall/database/1.jpg: found no coordinates"):
        open_benchmark(tmp_path / "hall")
    named = open_benchmark(tmp_path / "hall", layout="folders")
    assert named.name == "hall (two folders, no ground truth)"
    table = "query,database\n1.jpg,1.jpg\n@1@2@.jpg,\n"
    (tmp_path / "hall" / "ground_truth.csv").write_text(table)
    assert lists_of(open_benchmark(tmp_path / "hall").positives) == [[0], []]


def test_files_of_netvlad_and_salad_are_found(tmp_path):
    write_mat(tmp_path / "a.mat")
    write_mat_images(tmp_path)
    assert open_benchmark(tmp_path / "a.mat").name.startswith("a (NetVLAD .mat, test set")
    write_set(tmp_path / "lists", "hall_")
    assert open_benchmark(tmp_path / "lists").name == "hall (SALAD's lists)"
    # A folder images/ is not yet one of splits.
    touch(tmp_path / "lists" / "images" / "a.jpg")
    assert open_benchmark(tmp_path / "lists").name == "hall (SALAD's lists)"
    name = open_benchmark(tmp_path / "lists" / "hall_dbImages.npy").name
    assert name == "hall (SALAD's lists)"
    with refused(r"notes.txt: found a file; expected .* a .mat file"):
        open_benchmark(touch(tmp_path / "notes.txt"))


def test_lists_beside_vpr_benchs_pictures(tmp_path):
    """SALAD's Nordland: the pictures are VPR-Bench's, the ground truth may be either's."""
    root = write_vpr_bench(tmp_path / "hall", truth_rows((0, [3]), (1, [1]), (2, [2])))
    database, queries = (
        [f"{part}/{i:07d}.jpg" for i in range(count)] for part, count in (("ref", 4), ("query", 3))
    )
    write_lists(root, "Nordland_", dbImages=database, qImages=queries, gt=ragged([0], [1], [2]))
    assert open_benchmark(root).name == "hall (VPR-Bench)"
    assert lists_of(open_benchmark(root, layout="salad").positives) == [[0], [1], [2]]
    (root / "ground_truth_new.npy").unlink()
    assert open_benchmark(root).name == "Nordland (SALAD's lists)"


def test_raw_msls_is_found(tmp_path):
    write_msls(tmp_path)
    count = len(open_benchmark(tmp_path).queries)
    assert open_benchmark(tmp_path).name == f"MSLS val, raw, {count} queries, 25 m"
    named = open_benchmark(tmp_path, layout="msls-subtask", max_heading_difference=40, radius=20)
    assert named.name.startswith("MSLS val, raw, subtask all, ")
    assert named.name.endswith(" queries, 20 m and 40 degrees")
    assert len(named.queries) < count


@pytest.mark.parametrize(
    ("layout", "given", "known"),
    [
        ("utm", {"frames": 2}, "split, radius, queries, ignore_zones"),
        ("vpr-bench", {"radius": 10.0}, "no option"),
        ("netvlad", {"split": "val"}, "radius, images"),
        ("salad", {"queries": "queries_night"}, "split, images"),
        ("msls", {"images": "photos"}, "split, radius, max_heading_difference"),
        ("folders", {"max_heading_difference": 40.0}, "split, radius, frames"),
    ],
)
def test_options_that_a_layout_lacks_are_refused(tmp_path, layout, given, known):
    (option,) = given
    with refused(f"^{tmp_path}: found {option} for the layout {layout}, which takes {known}$"):
        open_benchmark(tmp_path, layout=layout, **given)


def test_the_help_names_every_layout():
    """Its words are written by hand."""
    written = r'layout: str \| None = None\n    """(.*?);'
    (text,) = re.findall(written, FLAGS.read_text(), re.DOTALL)
    assert re.findall(r"[\w-]+", text.replace(" or ", " ")) == [*LAYOUTS]


def test_an_unknown_layout_is_refused(tmp_path):
    with refused(r"layout: found 'gsv', expected one of .*vpr-bench"):
        open_benchmark(tmp_path, layout="gsv")


@pytest.mark.skipif(not PHOTOGRAPHS.is_dir(), reason="needs the real photographs")
def test_real_sets():
    sped = open_benchmark(PHOTOGRAPHS / "sped_val")
    assert sped.name == "sped_val/test (@UTM, 25 m)"
    assert [len(p) for p in sped.ground_truth()] == [1] * 147
    for path, positives in zip(sped.queries, sped.ground_truth(), strict=True):
        # the file names carry the place as well as its placeholder coordinates
        assert path.name.split("@")[1] == sped.database[positives[0]].name.split("@")[1]

    corridor = open_benchmark(PHOTOGRAPHS / "corridor")
    assert corridor.name == "corridor (VPR-Bench)"
    assert len(corridor.database) == len(corridor.queries) == 111
    for i, positives in enumerate(corridor.ground_truth()):
        assert positives.tolist() == list(range(max(0, i - 2), min(110, i + 2) + 1))

    streets = open_benchmark(PHOTOGRAPHS / "toy_streets")
    assert streets.name == "toy_streets (two folders, no ground truth)"
    assert (len(streets.database), len(streets.queries), streets.positives) == (17, 5, None)
