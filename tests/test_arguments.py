"""Swapped and wrong arguments of public functions: one line that names them, and no traceback."""

import pathlib

import jax
import numpy as np
import pytest

import crisalad_jax as cj
from crisalad_jax.experiments.comparison import compare
from crisalad_jax.nn.model import parameter_shapes

PRESET = cj.PRESETS["tiny"]
PARAMS = parameter_shapes(PRESET)
TRAINING = cj.recipe("tiny")
IMAGES = np.zeros((1, 28, 28, 3), np.uint8)
KEY = jax.random.key(0)
NO_MODEL = "model: found Crisalad, expected a Model(params, config)"
NO_PATH = "found ModelConfig, expected a path"
CALLS = {
    "train a preset": (
        lambda: cj.train(PRESET, "d", "r"),
        "config: found ModelConfig, expected TrainConfig",
    ),
    "train swapped": (
        lambda: cj.train("d", TRAINING, "r"),
        "config: found 'd', expected TrainConfig",
    ),
    "train in a config": (lambda: cj.train(TRAINING, "d", PRESET), f"out: {NO_PATH}"),
    "fit a preset": (
        lambda: cj.fit(PRESET, "d", "r"),
        "config: found ModelConfig, expected TrainConfig",
    ),
    "fit a path": (
        lambda: cj.fit(TRAINING, "d", "r"),
        "places: found 'd', expected Places, or QuerySet",
    ),
    "describe": (
        lambda: cj.describe(PARAMS, PRESET, IMAGES),
        "config: found ndarray, expected Model",
    ),
    "describe_files": (lambda: cj.describe_files(PARAMS, PRESET), NO_MODEL),
    "describe_images": (lambda: cj.describe_images(PARAMS, [IMAGES]), NO_MODEL),
    "evaluate": (lambda: cj.evaluate(PARAMS, PRESET), "benchmark: found ModelConfig, expected B"),
    "evaluate swapped": (
        lambda: cj.describe_files(cj.Model(PRESET, PARAMS), "f"),
        "params: found ModelConfig, expected Crisalad",
    ),
    "load": (lambda: cj.load(PRESET), f"path: {NO_PATH}"),
    "save_weights": (lambda: cj.save_weights("w", PARAMS), "model: found Crisalad, expected Model"),
    "init_crisalad": (
        lambda: cj.init_crisalad(PRESET, KEY),
        "key: found ModelConfig, expected Array",
    ),
    "prepare_image": (
        lambda: cj.prepare_image(PRESET, IMAGES[0]),
        "config: found ndarray, expected",
    ),
    "query": (
        lambda: cj.query(PARAMS, "f"),
        "places: found Crisalad, expected Map",
    ),
    "calibrate": (
        lambda: cj.calibrate("m.map", "s"),
        "places: found 'm.map', expected Map",
    ),
    "open": (lambda: cj.Map.open(PRESET), f"folder: {NO_PATH}"),
    "open_benchmark": (lambda: cj.open_benchmark(PRESET), f"root: {NO_PATH}"),
    "by keyword": (lambda: cj.open_benchmark(root=PRESET), f"root: {NO_PATH}"),
    "read_places": (lambda: cj.read_places(PRESET), f"root: {NO_PATH}"),
    "load_pca": (lambda: cj.load_pca(PRESET), f"path: {NO_PATH}"),
    "read_image": (lambda: cj.read_image(IMAGES), "path: found ndarray, expected a path"),
    "convert": (lambda: cj.convert(PRESET, "w"), f"source: {NO_PATH}"),
    "read_backbone": (
        lambda: cj.read_backbone(PRESET, "w", None),
        f"path: {NO_PATH}",
    ),
    "search": (
        lambda: cj.search(np.eye(3), np.eye(3), np.eye(3)),
        "k: found array([[1., 0., 0.], ..., expected a whole number of at least 1",
    ),
    "recipe": (lambda: cj.recipe(PRESET), "preset: found ModelConfig, expected text"),
    "recipe of a model with its parameters": (
        lambda: cj.recipe(model=cj.Model(PARAMS, PRESET)),
        "model: found Model, expected ModelConfig, or None",
    ),
    "from_scratch": (
        lambda: cj.from_scratch(PRESET),
        "config: found ModelConfig, expected TrainConfig",
    ),
    "step_config": (
        lambda: cj.step_config(PRESET, steps=3),
        "config: found ModelConfig, expected Train",
    ),
    "metric_loss": (
        lambda: cj.metric_loss(IMAGES, IMAGES, PRESET),
        "config: found ModelConfig, expect",
    ),
    "write_export": (lambda: cj.write_export(PRESET, cj.Model(PARAMS, "o")), f"out: {NO_PATH}"),
    "a number for a key": (
        lambda: cj.init_crisalad(0, PRESET),
        "key: found 0, expected Array",
    ),
    "metric_loss swapped": (
        lambda: cj.metric_loss(np.zeros(4, np.int32), np.zeros((4, 8)), cj.LossConfig()),
        "descriptors, labels: found shapes (4,) and (4, 8), expected (image, descriptor) and",
    ),
    "load_plugin": (lambda: cj.load_plugin(PRESET), "plugin: found ModelConfig, expected text"),
    "FolderWatch": (lambda: cj.FolderWatch(3), "folder: found 3, expected a path"),
    "Camera": (
        lambda: cj.Camera(PRESET),
        "camera: found ModelConfig, expected a whole number, or",
    ),
    "compare": (lambda: compare("out", TRAINING), "config: found 'out', expected ComparisonConfig"),
}


@pytest.mark.usefixtures("_unchecked")
@pytest.mark.parametrize("name", CALLS)
def test_a_wrong_argument_is_named(name: str, tmp_path: pathlib.Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    call, words = CALLS[name]
    with pytest.raises(cj.InputError) as caught:
        call()
    assert str(caught.value).startswith(words)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())
