"""HOG against a pixel-by-pixel writing of its definition, and on real photographs."""

import dataclasses
import json
import math
import pathlib

import cv2
import jax
import numpy as np
import pytest

import crisalad_jax as cj
from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.checkpoints.runtime import read_header
from crisalad_jax.checkpoints.weights import model_hash
from crisalad_jax.data import benchmarks
from crisalad_jax.nn.backbones.hog import HogConfig
from crisalad_jax.training.step import init_train_state, step_config
from crisalad_jax.utils.errors import InputError
from tests.cli.test_cli import Capture, fails, succeeds
from tests.conftest import PHOTOGRAPHS, RECIPE

CONFIG = cj.ModelConfig(
    image_size=(128, 128),
    preprocessing=cj.PreprocessingConfig(mean=(0.0, 0.0, 0.0), deviation=(1 / 255,) * 3),
    backbone="hog",
    aggregator="class-token",
    cross_image="none",
)


def hog(pictures):
    """The descriptors of pictures of 128 x 128."""
    params, config = cj.load("hog")
    return np.asarray(cj.describe(params, np.asarray(pictures), config))


def test_its_file_is_its_configuration():
    params, config = cj.load("hog")
    assert config == CONFIG
    header = read_header(find_weights("hog"))
    assert header["model_sha256"] == model_hash(params, config)
    parts = {"backbone": "hog", "aggregator": "class-token", "cross_image": "none"}
    assert header["parts"] == {field: [name, None] for field, name in parts.items()}


def _grey_picture(grey):
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=-1)


def _naive_hog(grey):
    """The definition in loops, for a 128 x 128 picture."""
    padded = np.pad(grey.astype(np.float64), 1, mode="reflect")
    cells = np.zeros((16, 16, 9))
    for y in range(128):
        for x in range(128):
            (a, b, c), (d, _, f), (g, h, i) = padded[y : y + 3, x : x + 3]
            across = c + 2 * f + i - a - 2 * d - g
            down = g + 2 * h + i - a - 2 * b - c
            angle = math.degrees(math.atan2(down, across)) % 180
            # Bins are 20 degrees wide with centres at 10, 30, ... 170; 170 and 10 are neighbours.
            position = (angle - 10) / 20
            low = math.floor(position)
            strength = math.hypot(across, down)
            cells[y // 8, x // 8, low % 9] += strength * (low + 1 - position)
            cells[y // 8, x // 8, (low + 1) % 9] += strength * (position - low)
    parts = []
    for row in range(15):
        for column in range(15):
            block = cells[row : row + 2, column : column + 2].ravel()
            parts.append(block / np.linalg.norm(block))
    descriptor = np.concatenate(parts)
    return descriptor / np.linalg.norm(descriptor)


def test_hog_is_its_definition():
    grey = np.random.default_rng(0).integers(0, 256, (128, 128))
    found = hog(_grey_picture(grey)[None])
    assert found.shape == (1, 8100)
    assert found.dtype == np.float32
    # 1e-5 of entries near 0.01 to 0.03: gradients and angles are float32.
    np.testing.assert_allclose(found[0], _naive_hog(grey), atol=1e-6, rtol=1e-5)


def test_every_picture_gets_a_unit_descriptor():
    pictures = np.random.default_rng(2).integers(0, 256, (3, 128, 128, 3)).astype(np.uint8)
    pictures[1] = 90  # one colour
    found = hog(pictures)
    # 1e-5: 8,100 float32 squares.
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    assert np.ptp(found[1]) == 0


def test_colours_are_grey_as_opencv_has_them():
    colours = np.random.default_rng(3).integers(0, 256, (128, 128, 3)).astype(np.uint8)
    grey = _grey_picture(cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY))
    np.testing.assert_array_equal(*hog(np.stack([colours, grey])))


@pytest.mark.parametrize(
    ("name", "expected"), [("sped_val", (59.2, 76.9, 85.0)), ("corridor", (43.2, 71.2, 82.9))]
)
def test_recall_on_photographs(name, expected):
    if not (PHOTOGRAPHS / name).is_dir():
        pytest.skip(f"no photographs in {PHOTOGRAPHS / name}")
    benchmark = benchmarks.open_benchmark(PHOTOGRAPHS / name)
    (result,) = cj.evaluate(cj.load("hog"), benchmark, reading=cj.Reading(quiet=True))
    for k, recall in zip((1, 5, 10), expected, strict=True):
        # 2 points, two or three queries: another JPEG decoder changes grey levels by one.
        assert 100 * result.recalls[k] == pytest.approx(recall, abs=2)


@pytest.mark.slow
def test_its_name_is_taken_by_every_verb_that_describes(
    shared: pathlib.Path, tmp_path: pathlib.Path, capfd: Capture
):
    town = shared / "town"
    images, out = town / "images" / "test" / "database", tmp_path / "map"
    words = succeeds(capfd, "evaluate", "--data", town, "--weights", "hog", "--quiet")
    assert "hog images at 128 x 128" in " ".join(words.split())
    given = ("--test", town, "--weights", "hog", "starter", "--seeds", 1, "--quiet")
    words = succeeds(capfd, "compare", *given, "--out", tmp_path / "compared")
    assert "hog" in words
    succeeds(capfd, "index", "--images", images, "--weights", "hog", "--out", out, "--quiet")
    assert json.loads((out / "map.json").read_text())["weights"] == "hog"
    first = sorted(images.iterdir())[0]
    succeeds(capfd, "query", first, "--map", out, "--quiet")
    npy = tmp_path / "hog.npy"
    succeeds(capfd, "extract", "--images", images, "--weights", "hog", "--out", npy, "--quiet")
    assert np.load(npy).shape[1] == 8100
    assert "baseline" in succeeds(capfd, "models")
    assert "baseline" in succeeds(capfd, "models", "hog")


def test_what_it_cannot_do_is_one_line(
    shared: pathlib.Path, tmp_path: pathlib.Path, capfd: Capture
):
    size = ("--image-size", 224, 224)
    data = ("--data", shared / "town", "--weights", "hog")
    fails(capfd, "evaluate", *data, *size, words=("found 224 x 224, expected 128 x 128",))
    recipe = dataclasses.replace(RECIPE, model=CONFIG)
    with pytest.raises(InputError, match=r"found all, of which backbone hog with .* nothing"):
        init_train_state(
            cj.init_crisalad(jax.random.key(0), CONFIG), "all", step_config(recipe, steps=1)
        )
    with pytest.raises(InputError, match="dim: found 9, expected 8100 to 8100"):
        HogConfig(dim=9)
