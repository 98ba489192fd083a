"""`extract`: folders and lists, into files and into memory; what is refused before any work."""

import dataclasses
import json
import pathlib

import jax
import numpy as np
import pytest

from crisalad_jax.checkpoints.weights import model_hash
from crisalad_jax.data.images import list_images
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval import extract as extract_module
from crisalad_jax.retrieval.descriptor_files import read_descriptors
from crisalad_jax.retrieval.extract import check_extraction, extract
from crisalad_jax.retrieval.pca import fit_pca
from crisalad_jax.retrieval.segments import Segments
from crisalad_jax.utils.errors import InputError
from tests.conftest import BATCH, MODEL, describe_single, read_options


@pytest.fixture(scope="module")
def town(shared) -> pathlib.Path:
    return shared / "town"


@pytest.fixture(scope="module")
def expected(params, town) -> np.ndarray:
    """Each alone, by the functions that other tests compare with batches of one."""
    paths = list_images(town)
    return describe_single(Model(params, MODEL), paths)


def run(params, images, *out, **options):
    return extract(Model(params, MODEL), images, *out, **read_options(options))


def test_into_memory(params, town, expected, tmp_path, monkeypatch):
    """A folder's names are relative to it, a list's are as given, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    paths = list_images(town)
    found = run(params, town)
    assert found.names == [path.relative_to(town).as_posix() for path in paths]
    np.testing.assert_array_equal(found.descriptors, expected)
    assert found.skipped == []
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


def test_components_in_memory(params, town, expected, tmp_path):
    fitted = fit_pca(expected, 3)
    found = run(params, town, tmp_path / "d.npy", pca=fitted)
    np.testing.assert_array_equal(found.descriptors, fitted.apply(expected))
    assert json.loads((tmp_path / "d.npy.json").read_text())["pca"] == "3 components"


def test_only_descriptors_of_the_same_model_are_shortened(params, town, tmp_path):
    """Others of the same length would give components that mean nothing."""
    other = jax.tree.map(lambda leaf: leaf * 1.01, params)
    out = tmp_path / "d.npy"
    found = run(params, town, out)
    digest = model_hash(params, MODEL)
    assert json.loads((tmp_path / "d.npy.json").read_text())["model_sha256"] == digest
    fitted = fit_pca(found.descriptors, 2, model=digest)
    with pytest.raises(InputError, match=f"fitted to descriptors of model {digest[:12]}"):
        run(other, town, tmp_path / "e.npy", pca=fitted)
    assert not list(tmp_path.glob("e.*"))


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
        (["none.jpg"], {}, "none.jpg: found no such file, expected a folder of images, an image"),
        (["a\nb.jpg"], {}, "found a line break in the name"),
        (["a.jpg"], {"root": "/elsewhere"}, "--root: found /elsewhere, expected a folder that"),
        (["a.jpg"], {"grouping": "all"}, "grouping: found 'all'"),
    ],
)
def test_what_is_refused(params, images, options, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a.jpg", "a\nb.jpg"):
        (tmp_path / name).write_bytes(b"no image")
    with pytest.raises(InputError, match=words):
        run(params, images, **options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"out": "d.txt"}, "d.txt: suffix of the descriptors' file"),
    ],
)
def test_what_is_known_before_there_is_a_model(options, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    usual = {"out": "d.npy", "grouping": "single", "seed": 0, "cluster": None}
    with pytest.raises(InputError, match=words):
        check_extraction(**usual | options)


def test_a_descriptor_that_is_not_finite_is_not_written(params, town, tmp_path):
    encoder = jax.tree.map(lambda leaf: leaf * np.nan, params.cross_image)
    broken = dataclasses.replace(params, cross_image=encoder)
    out = tmp_path / "d.npy"
    with pytest.raises(InputError, match=r"descriptors: row 0 is not finite, expected finite unit"):
        run(broken, town, out)
    assert not out.exists()


def test_memory_does_not_grow_with_the_images(params, town, expected, tmp_path, monkeypatch):
    """Of a set in a file no more than one segment's rows are held, and the rest is mapped."""
    held = []
    real = Segments.append

    def append(self, record, rows):
        held.append(len(rows))
        real(self, record, rows)

    monkeypatch.setattr(extract_module, "SEGMENT", 1)
    monkeypatch.setattr(Segments, "append", append)
    found = run(params, town, tmp_path / "d.npy")
    assert held == [BATCH] * (len(expected) // BATCH)
    assert isinstance(found.descriptors, np.memmap)
    np.testing.assert_array_equal(found.descriptors, expected)


def test_a_part_without_a_readable_image_is_left_out(params, town, tmp_path, monkeypatch):
    """Its tokens are in no file; the others' descriptors are those of a set in memory."""
    monkeypatch.setattr(extract_module, "SEGMENT", 1)
    bad = [tmp_path / f"{i}.jpg" for i in range(BATCH)]
    for path in bad:
        path.write_bytes(b"no image")
    listed = list_images(town)
    paths = [*listed[:BATCH], *bad, *listed[BATCH:]]
    for grouping in ("single", "window"):
        options = {"on_bad_image": "skip", "grouping": grouping}
        found = run(params, paths, tmp_path / "d.npy", **options)
        expected = run(params, paths, **options)
        assert found.skipped == [path.as_posix() for path in bad]
        np.testing.assert_array_equal(found.descriptors, expected.descriptors)
