"""Odd names of files and folders, and outputs that would overwrite each other."""

import os
import shutil

import numpy as np
import pytest

from crisalad_jax.retrieval.pca import PcaConfig, fit_pca, save_pca
from tests.cli.test_cli import extract, fails, files_in, succeeds


@pytest.mark.parametrize("folder", ["x[/b]", "fo[red]x", "a:smile:b"])
def test_brackets_and_colons_in_names_are_printed_as_they_are(capfd, tmp_path, shared, folder):
    out = tmp_path / folder / "d.npy"
    said = succeeds(capfd, *extract(shared, shared / "town", out))
    assert f"{folder}/d.npy: 12 descriptors" in said


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (b"b\nc.jpg", "found a line break in the name 'images/test/queries/b\\nc.jpg'"),
        ("b\u2028c.jpg".encode(), "found a line break in the name"),
        (b"caf\xe9.jpg", "found the name 'images/test/queries/caf\\udce9.jpg', expected UTF-8"),
    ],
)
def test_a_name_that_is_no_line_of_text_is_refused_before_the_work(
    capfd, tmp_path, shared, town, name, words
):
    photograph = next((town / "images" / "test" / "queries").iterdir())
    shutil.copy(photograph, os.path.join(os.fsencode(photograph.parent), name))
    (tmp_path / "out").mkdir()
    fails(capfd, *extract(shared, town, tmp_path / "out" / "d.npy"), words=(words,))
    assert files_in(tmp_path / "out") == set()


@pytest.mark.parametrize("name", ["d.npy", "d.names.txt", "d.npy.json"])
def test_pairs_do_not_overwrite_what_extract_writes(capfd, tmp_path, shared, name):
    start = extract(shared, shared / "town", tmp_path / "d.npy", "--pairs", tmp_path / name)
    fails(capfd, *start, words=(f"--pairs: found {tmp_path / name}, which --out writes",))
    assert files_in(tmp_path) == set()


def test_pairs_of_descriptors_that_are_no_unit_vectors_are_refused_before_the_work(
    capfd, tmp_path, shared
):
    rows = np.random.default_rng(0).standard_normal((60, 48)).astype(np.float32)
    components = tmp_path / "pca.safetensors"
    save_pca(components, fit_pca(rows, 5, PcaConfig(renormalise=False)))
    more = "--pca", components, "--pairs", tmp_path / "pairs.txt"
    start = extract(shared, shared / "town", tmp_path / "d.npy", *more)
    fails(capfd, *start, words=("--pairs: found components that leave lengths",))
    assert files_in(tmp_path) == {"pca.safetensors"}


def test_verify_needs_a_map(capfd):
    fails(capfd, "info", "--verify", words=("--verify: found without --map",))


def test_an_export_does_not_take_the_place_of_the_working_folder(
    capfd, tmp_path, shared, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    start = ("export", "--weights", shared / "weights.safetensors", "--out", ".")
    fails(capfd, *start, words=(".: found the folder that this runs in, expected another",))
