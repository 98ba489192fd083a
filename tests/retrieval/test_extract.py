"""`extract`: folders and lists, into files and into memory; what is refused before any work."""

import dataclasses
import json
import pathlib

import jax
import numpy as np
import pytest

from crisalad_jax.data.images import list_images
from crisalad_jax.retrieval.describe import group, read_tokens
from crisalad_jax.retrieval.descriptor_files import read_descriptors
from crisalad_jax.retrieval.extract import check_extraction, extract
from crisalad_jax.retrieval.pca import PcaConfig, fit_pca
from crisalad_jax.utils.errors import InputError
from tests.conftest import BATCH, MODEL


@pytest.fixture(scope="module")
def town(shared) -> pathlib.Path:
    return shared / "town"


@pytest.fixture(scope="module")
def expected(params, town) -> np.ndarray:
    """Each alone, by the functions that other tests compare with batches of one."""
    paths = list_images(town)
    tokens = read_tokens(params, MODEL, paths, batch_size=BATCH, label="", quiet=True)
    return group(params, MODEL, tokens, "single", batch_size=BATCH)


def run(params, images, *out, **options):
    return extract(params, MODEL, images, *out, **{"batch_size": BATCH, "quiet": True} | options)


def test_into_memory(params, town, expected, tmp_path, monkeypatch):
    """A folder's names are relative to it, a list's are as given, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    paths = list_images(town)
    found = run(params, town)
    assert found.names == [path.relative_to(town).as_posix() for path in paths]
    np.testing.assert_array_equal(found.descriptors, expected)
    assert (found.skipped, found.pairs) == ([], None)
    listed = run(params, [str(path) for path in reversed(paths)])
    assert listed.names == [path.as_posix() for path in reversed(paths)]
    np.testing.assert_allclose(listed.descriptors, expected[::-1], atol=2e-6)
    below = run(params, paths, root=town.parent)
    assert below.names == [f"town/{name}" for name in found.names]
    assert list(tmp_path.iterdir()) == []


def test_into_a_file(params, town, expected, tmp_path):
    out = tmp_path / "new" / "d.npy"
    found = run(params, town, out, weights="w.safetensors", seed=3)
    names, descriptors = read_descriptors(out)
    assert names == found.names
    np.testing.assert_array_equal(descriptors, expected)
    record = json.loads((tmp_path / "new" / "d.npy.json").read_text())
    assert (record["weights"], record["images"]) == ("w.safetensors", str(town))
    assert (record["seed"], record["grouping"], record["pca"]) == (3, "single", None)


def test_pairs_without_a_file_of_descriptors(params, town, tmp_path):
    found = run(params, town, pairs=tmp_path / "pairs.txt", k=1)
    lines = (tmp_path / "pairs.txt").read_text().splitlines()
    assert lines == [f"{a} {b}" for a, b in found.pairs]
    assert [a for a, _ in found.pairs] == found.names
    assert [path.name for path in tmp_path.iterdir()] == ["pairs.txt"]


def test_components_in_memory(params, town, expected, tmp_path):
    fitted = fit_pca(expected, 3)
    found = run(params, town, tmp_path / "d.npy", pca=fitted)
    np.testing.assert_array_equal(found.descriptors, fitted.apply(expected))
    assert json.loads((tmp_path / "d.npy.json").read_text())["pca"] == "3 components"
    loose = fit_pca(expected, 3, PcaConfig(renormalise=False))
    with pytest.raises(InputError, match="--pairs: found components, which leaves lengths"):
        run(params, town, pca=loose, pairs=tmp_path / "pairs.txt")


def test_unreadable_images_of_a_list(params, town, tmp_path):
    bad = tmp_path / "bad.jpg"
    bad.write_bytes(b"no image")
    paths = [bad, *list_images(town)[:2]]
    found = run(params, paths, on_bad_image="skip")
    assert (found.names, found.skipped) == ([p.as_posix() for p in paths[1:]], [bad.as_posix()])
    assert len(found.descriptors) == 2
    with pytest.raises(InputError, match="images: found 1 images, none of them readable"):
        run(params, [bad], on_bad_image="skip")


@pytest.mark.parametrize(
    ("images", "options", "words"),
    [
        ([], {}, "images: found none, expected at least one"),
        (["a\nb.jpg"], {}, "images: found a line break in the name"),
        (["a.jpg"], {"root": "/elsewhere"}, "--root: found /elsewhere, expected a folder that"),
        (["a.jpg"], {"grouping": "all"}, "grouping: found 'all'"),
    ],
)
def test_what_is_refused(params, images, options, words):
    with pytest.raises(InputError, match=words):
        run(params, images, **options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"out": "d.txt"}, "d.txt: suffix of the descriptors' file"),
        ({"batch_size": 0}, "batch size: found 0"),
        ({"database": "d.h5"}, "--database: found without --pairs"),
        ({"pairs": "d.names.txt"}, "--pairs: found d.names.txt, which --out writes"),
        ({"pairs": "p.txt", "k": 0}, "k: found 0, expected at least 1"),
    ],
)
def test_what_is_known_before_there_is_a_model(options, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=words):
        check_extraction(**{"out": "d.npy"} | options)


def test_a_descriptor_that_is_not_finite_is_not_written(params, town, tmp_path):
    encoder = jax.tree.map(lambda leaf: leaf * np.nan, params.cross_image)
    broken = dataclasses.replace(params, cross_image=encoder)
    out = tmp_path / "d.npy"
    with pytest.raises(InputError, match=r"descriptors: row 0 is not finite, expected finite unit"):
        run(broken, town, out)
    assert not out.exists()
