"""Pairs as hloc reads them, against brute force and hloc's published format."""

import pathlib

import h5py
import numpy as np
import pytest

from crisalad_jax.retrieval.descriptor_files import read_descriptors, write_descriptors
from crisalad_jax.retrieval.hloc_pairs import check_names, nearest_pairs, write_pairs
from crisalad_jax.utils.errors import InputError
from tests.retrieval.maps.test_stores import unit_rows


def pairs_as_hloc_reads_them(pairs: pathlib.Path, *features: pathlib.Path) -> dict[str, list[str]]:
    """Query to its database images, checked against hloc's format.

    A pair a line, two names with one space, no header; each name is that of a group of the features
    that has a dataset `global_descriptor`: one vector, float16 or float32, all of one length.
    """
    text = pairs.read_text(encoding="utf-8")
    assert text.endswith("\n")
    found: dict[str, list[str]] = {}
    for line in text[:-1].split("\n"):
        query, image = line.split(" ")  # more or fewer than two is an error
        found.setdefault(query, []).append(image)
    images = {name for paired in found.values() for name in paired}
    lengths = set()
    for path, names in ((features[0], set(found)), (features[-1], images)):
        with h5py.File(path) as file:
            for name in names:
                dataset = file[name]["global_descriptor"]
                assert dataset.ndim == 1
                assert dataset.dtype in (np.float16, np.float32)
                lengths.add(dataset.shape)
    assert len(lengths) == 1
    return found


def brute_force(queries: dict, database: dict, k: int) -> dict[str, list[str]]:
    """In float64, a Python loop for each pair; names to vectors; of equals the earlier first."""
    found = {}
    for query, vector in queries.items():
        others = [name for name in database if name != query]
        closeness = [float(np.dot(np.float64(vector), np.float64(database[n]))) for n in others]
        order = np.argsort(-np.array(closeness), kind="stable")
        found[query] = [others[i] for i in order[:k]]
    return found


def by_name(names, rows) -> dict:
    return dict(zip(names, rows, strict=True))


@pytest.mark.parametrize("k", [1, 3, 4, 50])
def test_no_image_is_paired_with_itself(k):
    """Among themselves; a k beyond what there is gives all others."""
    rows = unit_rows(5)
    found = nearest_pairs("abcde", rows, "abcde", rows, k=k)
    expected = brute_force(by_name("abcde", rows), by_name("abcde", rows), k)
    assert found == [(query, name) for query in "abcde" for name in expected[query]]
    assert len(found) == 5 * min(k, 4)


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_files_of_pairs_and_features_are_as_hloc_has_them(tmp_path, dtype):
    rows = unit_rows(7).astype(dtype)
    listed = ["q/1.jpg", "q/2.jpg", "db/a/1.jpg", "db/a/2.jpg", "db/é.jpg", "db/b.png", "db/c.jpg"]
    for name, part in (("q", slice(2)), ("db", slice(2, None))):
        write_descriptors(tmp_path / f"{name}.h5", rows[part], listed[part])
    sides = [read_descriptors(tmp_path / f"{name}.h5") for name in ("q", "db")]
    write_pairs(tmp_path / "pairs.txt", nearest_pairs(*sides[0], *sides[1], k=3))
    found = pairs_as_hloc_reads_them(tmp_path / "pairs.txt", tmp_path / "q.h5", tmp_path / "db.h5")
    assert found == brute_force(by_name(*sides[0]), by_name(*sides[1]), 3)
    assert set(sides[1][0]) == set(listed[2:])


@pytest.mark.parametrize("name", ["a b.jpg", "a\nb.jpg", " a.jpg", "a.jpg\t", ""])
def test_a_name_that_a_line_cannot_hold_is_an_error(name):
    with pytest.raises(
        InputError, match=r"pairs\.txt: found the image name .* expected names with"
    ):
        check_names("pairs.txt", ["fine.jpg", name])
    check_names("pairs.txt", ["fine.jpg", "nested/é.jpg"])
