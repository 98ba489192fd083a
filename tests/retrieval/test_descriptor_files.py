"""Files of descriptors, read back as their users read them."""

import pathlib

import h5py
import ml_dtypes
import numpy as np
import pytest

from crisalad_jax.retrieval.descriptor_files import (
    open_npy,
    read_descriptors,
    write_descriptors,
)
from crisalad_jax.utils.errors import InputError

NAMES = ["a.jpg", "summer/a.jpg", "summer/noon/with space.jpg", "Straße.jpg"]
DESCRIPTORS = np.random.default_rng(0).standard_normal((4, 6)).astype(np.float32)


def names_in(folder: pathlib.Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_npy_rows_follow_the_list_of_names(tmp_path):
    path = tmp_path / "new" / "map.npy"
    write_descriptors(path, DESCRIPTORS, NAMES)
    found = np.load(path)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, DESCRIPTORS)
    listed = (tmp_path / "new" / "map.names.txt").read_text(encoding="utf-8")
    assert listed == "a.jpg\nsummer/a.jpg\nsummer/noon/with space.jpg\nStraße.jpg\n"
    assert names_in(tmp_path / "new") == {"map.npy", "map.names.txt", "map.npy.json"}


def test_h5_has_a_group_an_image_as_hloc_wants(tmp_path):
    path = tmp_path / "features.h5"
    write_descriptors(path, DESCRIPTORS, NAMES)
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
    assert names_in(tmp_path) == {"features.h5", "features.h5.json"}


def test_h5_with_a_name_twice_is_not_written(tmp_path):
    path = tmp_path / "features.h5"
    with pytest.raises(InputError, match=r"features\.h5: found the image name 'a\.jpg' twice"):
        write_descriptors(path, DESCRIPTORS, ["a.jpg", "b.jpg", "c.jpg", "a.jpg"])
    assert names_in(tmp_path) == set()


@pytest.mark.parametrize("name", ["map.csv", "map", "map.npy.gz", "map.NPY"])
def test_another_suffix_is_refused_before_any_work(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=rf"{name}: suffix.*expected one of \.h5, \.npy"):
        write_descriptors(name, DESCRIPTORS, NAMES)
    assert names_in(tmp_path) == set()


def write_h5(path: pathlib.Path, **arrays: np.ndarray) -> None:
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file.create_dataset(f"{name}.jpg/global_descriptor", data=array)
            file.create_dataset(f"{name}.jpg/keypoints", data=np.zeros((3, 2)))


def test_hlocs_own_files_are_read_in_half_precision_beside_other_features(tmp_path):
    write_h5(tmp_path / "f.h5", a=np.ones(4, np.float16), b=np.zeros(4, np.float16))
    names, descriptors = read_descriptors(tmp_path / "f.h5")
    assert names == ["a.jpg", "b.jpg"]
    np.testing.assert_array_equal(descriptors, np.float16([[1] * 4, [0] * 4]))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda h5: h5.unlink(), "found no such file, expected a file of descriptors"),
        (lambda h5: h5.write_bytes(h5.read_bytes()[:100]), "not a whole HDF5 file"),
        (lambda h5: write_h5(h5), "not a whole HDF5 file of descriptors: need at least one array"),
        (
            lambda h5: write_h5(h5, a=np.ones(4), b=np.ones(5)),
            "not a whole HDF5 file of descriptors: all input arrays must have the same shape",
        ),
        (lambda h5: write_h5(h5, a=np.ones((1, 4))), r"found shape \(1, 1, 4\), expected \(images"),
    ],
)
def test_an_h5_that_is_no_file_of_descriptors_is_one_line(tmp_path, spoil, words):
    path = tmp_path / "f.h5"
    write_h5(path, a=np.ones(4))
    spoil(path)
    with pytest.raises(InputError, match=rf"f\.h5: {words}"):
        read_descriptors(path)


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (None, r"map\.names\.txt: found no such file, expected the names of"),
        (
            NAMES[1:],
            r"map\.npy: found 4 descriptors, expected 3, one for each name in map\.n",
        ),
    ],
)
def test_an_npy_without_its_names_is_one_line(tmp_path, names, words):
    path = tmp_path / "map.npy"
    np.save(path, DESCRIPTORS)
    if names is not None:
        path.with_suffix(".names.txt").write_text("\n".join(names))
    with pytest.raises(InputError, match=words):
        read_descriptors(path)


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
    for save, array, words in (
        (np.savez, DESCRIPTORS, r"not a whole \.npy file: the magic string is not correct"),
        (np.save, DESCRIPTORS[0], r"found shape \(6,\), expected \(images, descriptor\)"),
        (np.save, DESCRIPTORS[:0], r"found shape \(0, 6\), expected"),
        (np.save, np.array(["a"]), "found <U1, expected an array of floating-point numbers"),
    ):
        with path.open("wb") as file:
            save(file, array)
        with pytest.raises(InputError, match=rf"map\.npy: {words}"):
            open_npy(path)
