"""What a folder is: each Nordland, each MSLS, every split, and what differs from the counts."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest

from crisalad_jax.data.sets import SETS, check_set
from crisalad_jax.data.sets.table import SetPart
from crisalad_jax.utils.errors import InputError
from tests.conftest import write_picture
from tests.data.benchmarks.test_msls import CITIES, brute_force, write_msls
from tests.data.benchmarks.test_netvlad import write as write_mat
from tests.data.benchmarks.test_netvlad import write_images as write_mat_images
from tests.data.benchmarks.test_npy_lists import write_set
from tests.data.benchmarks.test_utm import write_nordland
from tests.data.benchmarks.trees import (
    every_tenth,
    truth_rows,
    utm_name,
    write_sides,
    write_utm,
    write_vpr_bench,
)


@pytest.fixture
def counts(monkeypatch):
    """Let a set have other counts, for folders of few images."""

    def change(name: str, *parts: SetPart) -> None:
        monkeypatch.setitem(SETS, name, dataclasses.replace(SETS[name], parts=parts))

    return change


def check(folder: Path, expected: str | None = None):
    return check_set(folder, expected, read=False)


def known(folder: Path, expected: str | None = None) -> list[str | None]:
    checked = check(folder, expected)
    assert checked.problems == ()
    return [part.known for part in checked.parts]


def test_sets_are_named_by_their_published_counts(tmp_path, counts):
    names = [utm_name("0", str(1000 * i), str(i)) for i in range(607)]
    write_sides(tmp_path / "x" / "images" / "test", names, names)
    assert known(tmp_path / "x") == ["sped, test"]
    counts("nordland-selavpr", SetPart("all", 40, 40))
    frames = [f"{i}.jpg" for i in range(40)]
    assert known(write_sides(tmp_path / "any", frames, frames)) == ["nordland-selavpr, all"]


def test_a_number_of_queries_alone_names_no_set(tmp_path, counts):
    """Of a part whose database no source counts, any set has as many queries."""
    counts("pitts250k", SetPart("test", None, 6))
    names = [utm_name("0", str(1000 * i), str(i)) for i in range(6)]
    folder = write_sides(tmp_path / "own" / "images" / "test", names[:4], names)
    assert known(folder) == [None]
    assert known(folder, "pitts250k") == ["pitts250k, test"]


def test_each_nordland_is_told_from_the_others(tmp_path, counts):
    """By the ground truth or the spacing: two of them have the same counts."""
    counts("nordland-star", SetPart("all", 60, 6, r"Nordland\*"))
    counts("nordland-subset", SetPart("test", 60, 6, "Nordland subset"))
    counts("nordland", SetPart("test", 60, 60, "Nordland, Patch-NetVLAD split"))
    truth = truth_rows(*enumerate(every_tenth(6, 60)))
    star = write_vpr_bench(tmp_path / "a", truth, references=60, queries=6)
    assert known(star) == ["nordland-star, all"]
    assert known(write_nordland(tmp_path / "b", 25 / 1.5, 60, 10)) == ["nordland-subset, test"]
    assert known(write_nordland(tmp_path / "c", 25 / 10.5, 60)) == ["nordland, test"]
    for folder, right in ((tmp_path / "a", "nordland-star"), (tmp_path / "c", "nordland")):
        for wrong in {"nordland", "nordland-star", "nordland-subset"} - {right}:
            (problem,) = check(folder, wrong).problems
            assert f"expected those of {wrong}" in problem


def test_raw_msls_is_both_its_official_queries_and_all(tmp_path, counts):
    root = write_msls(tmp_path / "msls")
    official, _, _ = brute_force(subtask=True)[:3], None, None
    database, queries = len(official[0]), len(official[1])
    counts("msls", SetPart("official", database, queries), *SETS["msls"].parts[1:])
    checked = check(root, "msls")
    assert checked.problems == ()
    names = [part.known for part in checked.parts]
    assert names[:2] == ["msls, official", "msls, val, all queries but panoramas"]
    assert [part.queries for part in checked.parts[:2]] == [queries, len(brute_force()[1])]
    assert queries < len(brute_force()[1])
    has_train = any(city not in ("cph", "sf") for city in CITIES)
    assert len(checked.parts) == 2 + has_train


def test_every_split_and_every_folder_of_queries_is_opened(tmp_path, counts):
    counts("pitts30k", SetPart("test", 3, 2), SetPart("val", 2, 1), SetPart("train", 9, 9))
    for split, database, queries in (("test", 3, 2), ("val", 2, 1)):
        folder = tmp_path / "pitts30k" / "images" / split
        write_utm(folder, np.zeros((database, 2)), np.zeros((queries, 2)))
    checked = check(tmp_path / "pitts30k", "pitts30k")
    assert [part.known for part in checked.parts] == ["pitts30k, test", "pitts30k, val"]
    assert checked.absent == ("pitts30k, train",)
    shutil.copytree(folder / "queries", folder / "queries_night")
    names = [part.name for part in check(tmp_path / "pitts30k").parts]
    assert names[1:] == ["pitts30k/val (@UTM, 25 m)", "pitts30k/val, queries_night (@UTM, 25 m)"]


def test_a_folder_named_as_a_set_with_other_counts_does_not_match(tmp_path, counts):
    counts("st-lucia", SetPart("test", 3, 2))
    folder = tmp_path / "st_lucia" / "images" / "test"
    write_utm(folder, np.zeros((2, 2)), np.zeros((2, 2)))
    words = (
        "st_lucia/test (@UTM, 25 m): found 2 database images and 2 queries, expected those of "
        "st-lucia: test: 3 database images and 2 queries"
    )
    assert check(tmp_path / "st_lucia").problems == (words,)
    own = shutil.move(tmp_path / "st_lucia", tmp_path / "mine")
    assert known(Path(own)) == [None]
    (problem,) = check(Path(own), "st-lucia").problems
    assert problem.endswith(words.partition(": ")[2])


def test_mat_files_and_lists_are_opened_each_by_itself(tmp_path):
    write_mat_images(tmp_path / "a")
    for name in ("pitts30k_test", "pitts30k_val", "pitts250k_test"):
        write_mat(tmp_path / "a" / "datasets" / f"{name}.mat")
    names = [part.name.partition(" ")[0] for part in check(tmp_path / "a").parts]
    assert names == ["pitts250k_test", "pitts30k_test", "pitts30k_val"]
    checked = check(tmp_path / "a", "pitts30k")
    assert [part.name.partition(" ")[0] for part in checked.parts] == names[1:]
    assert len(checked.problems) == 2
    for prefix in ("a_", "b_"):
        write_set(tmp_path / "b", prefix)
    names = [part.name for part in check(tmp_path / "b").parts]
    assert names == ["a (SALAD's lists)", "b (SALAD's lists)"]
    (tmp_path / "b" / "b_gt.npy").write_bytes(b"cut")
    (problem,) = check(tmp_path / "b").problems
    assert "b_gt.npy: cannot be read as an array" in problem


def test_missing_and_unreadable_images_are_named(tmp_path):
    for side in ("database", "queries"):
        for number in range(2):
            write_picture(tmp_path / "mine" / side / f"{number}.png", number)
    checked = check_set(tmp_path / "mine", quiet=True)
    (part,) = checked.parts
    assert (part.database, part.queries, part.known, part.problem) == (2, 2, None, None)
    cut = tmp_path / "mine" / "queries" / "1.png"
    cut.write_bytes(cut.read_bytes()[:100])
    (problem,) = check_set(tmp_path / "mine", quiet=True).problems
    assert problem.endswith(f"found 1 unreadable images: {cut}")
    assert check(tmp_path / "mine").problems == ()  # which counts alone


def test_training_places_are_those_of_all_cities_or_not(shared):
    places = shared / "city"
    (part,) = check_set(places, quiet=True).parts
    assert part.name == f"{places.name} (training places; cities: 2)"
    assert (part.database, part.queries, part.known, part.problem) == (24, 8, None, None)
    (problem,) = check_set(places, "gsv-cities", quiet=True).problems
    assert "found 2 cities, expected Bangkok, Barcelona, " in problem
    (problem,) = check_set(places, "sped", quiet=True).problems
    assert "found training places, expected SPED" in problem
    with pytest.raises(InputError, match="found no Dataframes/, expected GSV-Cities"):
        check_set(places / "Images", "gsv-cities")


def test_what_is_no_set_is_one_line(tmp_path):
    with pytest.raises(InputError, match=r"expected images/"):
        check_set(tmp_path)
    with pytest.raises(InputError, match=r"none: found no such folder"):
        check_set(tmp_path / "none")
    with pytest.raises(InputError, match="nearest: pitts30k"):
        check_set(tmp_path, "pits30k")
