"""Files of descriptors, read back as their users read them."""

import pathlib

import h5py
import ml_dtypes
import numpy as np
import pytest

from crisalad_jax.descriptors import open_npy, writer_for
from crisalad_jax.errors import InputError

NAMES = ["a.jpg", "summer/a.jpg", "summer/noon/with space.jpg", "Straße.jpg"]
DESCRIPTORS = np.random.default_rng(0).standard_normal((4, 6)).astype(np.float32)


def names_in(folder: pathlib.Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_npy_rows_follow_the_list_of_names(tmp_path):
    path = tmp_path / "new" / "map.npy"
    writer_for(path)(path, DESCRIPTORS, NAMES)
    found = np.load(path)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, DESCRIPTORS)
    listed = (tmp_path / "new" / "map.names.txt").read_text(encoding="utf-8")
    assert listed == "a.jpg\nsummer/a.jpg\nsummer/noon/with space.jpg\nStraße.jpg\n"
    assert names_in(tmp_path / "new") == {"map.npy", "map.names.txt"}


def test_h5_has_a_group_an_image_as_hloc_wants(tmp_path):
    path = tmp_path / "features.h5"
    writer_for(path)(path, DESCRIPTORS, NAMES)
    with h5py.File(path, "r") as file:
        # hloc finds the images by walking to the datasets and taking the name of their group.
        found = []
        file.visititems(
            lambda name, item: found.append(name) if isinstance(item, h5py.Dataset) else None
        )
        assert sorted(found) == sorted(f"{name}/global_descriptor" for name in NAMES)
        for name, expected in zip(NAMES, DESCRIPTORS, strict=True):
            dataset = file[name]["global_descriptor"]
            assert (dataset.shape, dataset.dtype) == ((6,), np.float32)
            np.testing.assert_array_equal(dataset[()], expected)
    assert names_in(tmp_path) == {"features.h5"}


def test_h5_with_a_name_twice_is_not_written(tmp_path):
    path = tmp_path / "features.h5"
    with pytest.raises(InputError, match=r"features\.h5: found the image name 'a\.jpg' twice"):
        writer_for(path)(path, DESCRIPTORS, ["a.jpg", "b.jpg", "c.jpg", "a.jpg"])
    assert names_in(tmp_path) == set()


@pytest.mark.parametrize("suffix", ["npy", "h5"])
def test_an_older_file_is_replaced(tmp_path, suffix):
    path = tmp_path / f"map.{suffix}"
    writer_for(path)(path, DESCRIPTORS, NAMES)
    first = path.read_bytes()
    writer_for(path)(path, DESCRIPTORS[:1], NAMES[:1])
    assert path.read_bytes() != first
    writer_for(path)(path, DESCRIPTORS, NAMES)
    assert len(path.read_bytes()) == len(first)


@pytest.mark.parametrize("name", ["map.csv", "map", "map.npy.gz", "map.NPY"])
def test_another_suffix_is_refused_before_any_work(name):
    with pytest.raises(InputError, match=rf"{name}: suffix.*expected one of \.h5, \.npy"):
        writer_for(name)


@pytest.mark.parametrize("kind", [np.float32, np.float16, np.float64, ml_dtypes.bfloat16])
def test_a_npy_file_is_mapped_with_its_type(tmp_path, kind):
    path = tmp_path / "map.npy"
    np.save(path, DESCRIPTORS.astype(kind))
    found = open_npy(path)
    assert isinstance(found, np.memmap)
    assert found.dtype == kind
    np.testing.assert_array_equal(found, DESCRIPTORS.astype(kind))


def test_files_that_are_no_descriptors_are_named(tmp_path):
    path = tmp_path / "map.npy"
    with path.open("wb") as file:
        np.savez(file, DESCRIPTORS)
    with pytest.raises(InputError, match=r"map\.npy: found an archive, expected an array of float"):
        open_npy(path)
    for array, words in (
        (DESCRIPTORS[0], r"map\.npy: found shape \(6,\), expected \(images, descriptor\)"),
        (DESCRIPTORS[:0], r"map\.npy: found shape \(0, 6\), expected"),
        (np.array(["a"]), r"map\.npy: found <U1, expected an array of floating-point numbers"),
    ):
        np.save(path, array)
        with pytest.raises(InputError, match=words):
            open_npy(path)
