"""The words of --resize at the verbs, and what these say of images."""

import json

import numpy as np

from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.data.reading import Reading
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.extract import extract
from tests.cli.test_cli import fails, succeeds


def test_words_change_what_is_extracted_and_are_told(shared, tmp_path, capfd, database):
    weights, out = shared / "weights.safetensors", tmp_path / "out.npy"
    said = succeeds(
        capfd,
        *("extract", "--weights", weights, "--images", database, "--out", out, "--batch-size", 4),
        *("--resize", "bicubic", "floats", "--quiet"),
    )
    assert "images at 42 x 56, bicubic, antialiased, on floats" in said
    record = json.loads((tmp_path / "out.npy.json").read_text())
    assert record["model"]["preprocessing"]["filter"] == "bicubic"
    params, config = load_weights(weights)
    config = config.resized(None, ["bicubic", "floats"])
    expected = extract(
        Model(params, config), database, reading=Reading(batch_size=4, quiet=True)
    ).descriptors
    # The same program on the same numbers.
    np.testing.assert_allclose(np.load(out), expected, atol=1e-6)


def test_info_tells_how_images_are_resized(shared, tmp_path, capfd):
    weights, out = shared / "weights.safetensors", tmp_path / "info.json"
    words = "longer side at most 56, area, on bytes, rounded to multiples of 14"
    flags = ("--json", out, "--resize", "longer-side", "area")
    assert words in succeeds(capfd, "info", "--weights", weights, *flags)
    told = json.loads(out.read_text())
    assert told["images"] == words
    assert told["preprocessing"]["size_rule"] == "longer-side"


def test_wrong_words_are_one_line(capfd, weights):
    info = ("info", "--weights", weights, "--resize")
    fails(capfd, *info, "cubic", words=("--resize: found 'cubic', expected some of fixed",))
