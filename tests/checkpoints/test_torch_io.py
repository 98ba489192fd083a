"""Torch's files where the disk refuses them, in a zip archive, and with a whitening."""

import os
import pathlib
import resource
import zipfile
from typing import Any

import numpy as np
import pytest
import sklearn.decomposition
import torch

from crisalad_jax.checkpoints.torch_io import read_torch, write_torch
from crisalad_jax.utils.errors import InputError

NAMES = ("mean_", "components_", "explained_variance_")
STATE = {"fc.weight": torch.arange(6.0).reshape(2, 3)}


class Opens:
    """What an attacker puts into a pickle: loading it runs a call."""

    def __reduce__(self) -> tuple[Any, ...]:
        return eval, ("__import__('pathlib').Path('made').mkdir()",)


def whitening(kind: type = np.float64) -> sklearn.decomposition.PCA:
    rows = np.random.default_rng(0).standard_normal((20, 4)).astype(kind)
    pca = sklearn.decomposition.PCA().fit(rows)
    pca.components_ = np.asfortranarray(pca.components_)  # as LAPACK may leave it
    return pca


def saved(folder: pathlib.Path, content: dict[str, Any], *, new: bool = True) -> pathlib.Path:
    path = folder / "file.pt"
    torch.save(content, path, _use_new_zipfile_serialization=new)
    return path


def zipped(path: pathlib.Path) -> pathlib.Path:
    """In an archive as a Mac makes it."""
    with zipfile.ZipFile(path.with_suffix(".zip"), "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(path, "folder/Resnet-101-AP-GeM.pt")
        archive.writestr("__MACOSX/folder/._Resnet-101-AP-GeM.pt", b"of a Mac")
    return path.with_suffix(".zip")


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("form", ["new", "old", "old path", "zip", "old zip", "tensors"])
def test_a_pickled_whitening_is_read_without_running_it(
    tmp_path: pathlib.Path, form: str, kind: type
) -> None:
    pca = whitening(kind)
    held: Any = {name: torch.tensor(getattr(pca, name)) for name in NAMES}
    held = held if form == "tensors" else pca
    content = {"model_options": {"gemp": 3}, "state_dict": STATE, "pca": {"Landmarks_clean": held}}
    path = saved(tmp_path, content, new="old" not in form)
    if form == "old path":  # before scikit-learn 0.22, and NumPy 2
        old = path.read_bytes().replace(b"decomposition._pca", b"decomposition.pca")
        path.write_bytes(old.replace(b"numpy._core", b"numpy.core"))
    found = read_torch(zipped(path) if "zip" in form else path).state
    assert list(found) == ["fc.weight", *NAMES]
    for name in NAMES:
        np.testing.assert_array_equal(found[name], getattr(pca, name).astype(found[name].dtype))
    assert found["components_"].dtype == (kind if form == "tensors" else np.float32)


def test_a_whitening_is_written_as_tensors(tmp_path: pathlib.Path) -> None:
    arrays = {"fc.weight": np.ones((2, 3), np.float32)} | {n: np.ones(2, np.float32) for n in NAMES}
    write_torch(tmp_path / "w.pt", arrays, under="state_dict", bare=False, declared=None)
    content = torch.load(tmp_path / "w.pt")
    assert content.keys() == {"state_dict", "pca"}
    assert content["pca"]["Landmarks_clean"].keys() == set(NAMES)
    found = read_torch(tmp_path / "w.pt").state
    assert list(found) == list(arrays)


def of_objects() -> sklearn.decomposition.PCA:
    pca = whitening()
    pca.mean_ = np.array([Opens()])
    return pca


BAD = {
    "code": (lambda: {"pca": {"a": Opens()}}, "pca: found builtins.eval, expected scikit-learn's"),
    "another class": (
        lambda: {"pca": {"a": sklearn.decomposition.TruncatedSVD()}},
        "pca: found sklearn.decomposition._truncated_svd.TruncatedSVD, expected",
    ),
    "code in an array": (lambda: {"pca": {"a": of_objects()}}, "expected arrays of floats mean_"),
    "not fitted": (
        lambda: {"pca": {"a": sklearn.decomposition.PCA()}},
        "expected arrays of floats mean_, .*: KeyError",
    ),
    "several": (
        lambda: {"pca": {"a": whitening(), "b": whitening()}},
        "pca: found a; b, expected Landmarks_clean",
    ),
    "other options": (
        lambda: {"pca": {"a": whitening()}, "model_options": {"center_bias": 0.1}},
        "model_options: found center_bias, expected it to be off",
    ),
}


@pytest.mark.parametrize("new", [True, False])
@pytest.mark.parametrize("kind", BAD)
def test_another_whitening_is_refused(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, kind: str, new: bool
) -> None:
    monkeypatch.chdir(tmp_path)  # where an attack would make its folder
    content, words = BAD[kind]
    path = saved(tmp_path, {"state_dict": STATE, **content()}, new=new)
    if not new and "code" in kind:
        words = "refused: it asks for [a-z_.]*eval"
    if not new and kind == "another class":
        words = "refused: it asks for sklearn.*TruncatedSVD"
    with pytest.raises(InputError, match=words) as error:
        read_torch(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)
    assert os.listdir(tmp_path) == ["file.pt"]


def test_an_archive_that_unpacks_to_far_more_is_not_read(tmp_path: pathlib.Path) -> None:
    path = saved(tmp_path, {"w": torch.zeros(2**22)})
    words = r"file\.zip: found an archive of \d+ bytes that unpacks to 167\d+, expected a checkp"
    with pytest.raises(InputError, match=words):
        read_torch(zipped(path))


def test_what_the_disk_says_is_told(tmp_path):
    """Torch's own error has lines of C++ and none of the reason."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**16, limits[1]))
    try:
        with pytest.raises(InputError, match=r"w\.pth: cannot be written: .*File too large"):
            write_torch(
                tmp_path / "w.pth",
                {"w": np.ones(2**16, np.float32)},
                under="",
                bare=False,
                declared=None,
            )
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert os.listdir(tmp_path) == []
