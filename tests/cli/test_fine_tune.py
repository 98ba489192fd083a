"""`crisalad train --weights`: flags come before the file, and the file before recipes."""

import dataclasses
import pathlib

import pytest

import crisalad_jax as cj
from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.checkpoints.weights import load_weights, save_weights
from crisalad_jax.cli import train
from crisalad_jax.config.io import differences
from crisalad_jax.nn.adapters.bottleneck import MlpConfig
from crisalad_jax.nn.model import Model
from crisalad_jax.nn.projection import ProjectionConfig
from crisalad_jax.training.config import MiningConfig
from crisalad_jax.utils.output import Note
from tests.cli.test_cli import fails
from tests.conftest import MODEL, RECIPE

STARTER = cj.load("starter").config


def _settings(*flags):
    given = ("--data", "x", "--out", "y", "--weights", "starter", *map(str, flags))
    return train.parse("crisalad train", train.prepare(given)).settings


@pytest.mark.parametrize(
    ("flags", "trainable", "learning_rate"),
    [
        ((), "head", 6e-5),  # the paper's, whose adapters it has not
        (("--recipe", "starter"), "all", 7e-4),
        (("--preset", "tiny"), "all", 1e-3),
        (("--recipe", "salad"), "last-4-blocks,norm,head", 6e-5),
    ],
)
def test_the_model_is_the_files_and_the_training_the_recipes(flags, trainable, learning_rate):
    config = _settings(*flags)
    assert config.model == STARTER
    assert config.model.image_size == (192, 256)
    assert config.model.preprocessing.normalisation == "local-contrast"
    assert config.validation_size is None  # and not the size that the recipe's code takes
    assert (config.trainable, config.optimiser.learning_rate) == (trainable, learning_rate)


def test_flags_come_before_the_file():
    config = _settings("--image-size", 96, 128, "--model.preprocessing.filter", "area")
    chain = dataclasses.replace(STARTER.preprocessing, filter="area")
    assert config.model == dataclasses.replace(STARTER, image_size=(96, 128), preprocessing=chain)


def test_a_configuration_comes_before_the_file():
    # The model's first run was at 96 x 128, and its second one at 144 x 192 (docs/starter.md).
    config = _settings("--config", pathlib.Path(__file__).parents[2] / "docs/starter/config.json")
    assert config.model.image_size == (144, 192)


def test_a_part_that_the_recipe_puts_in_place_is_told_not_ignored(shared, tmp_path, capfd):
    flags = ("--weights", "starter", "--recipe", "crisalad+gem", "--out", tmp_path / "run")
    words = ("aggregator: found conv-ap, expected gem",)
    fails(capfd, "train", "--data", shared / "city", *flags, words=words)


@pytest.mark.slow
def test_python_tells_of_weights_for_other_images(shared, tmp_path, weights):
    params, _ = load_weights(weights)
    file, city = tmp_path / "w.safetensors", shared / "city"
    save_weights(file, Model(params, dataclasses.replace(MODEL, image_size=(28, 42))))
    config = dataclasses.replace(RECIPE, epochs=1)
    words = r"found weights for images at 28 x 42, .* this run trains and is saved with 42 x 56,"
    with pytest.warns(Note, match=words):
        cj.train(config, city, tmp_path / "a", weights=file, quiet=True)
    own = dataclasses.replace(config, model=cj.load(file).config)
    cj.train(own, city, tmp_path / "b", weights=file, quiet=True)
    assert cj.load(tmp_path / "b" / "last.safetensors").config.image_size == (28, 42)


def test_several_processes_do_not_download(monkeypatch):
    arguments = ("--weights", "megaloc", "--coordinator-address", "localhost:1")
    with pytest.raises(cj.InputError, match=r"^--weights: found megaloc, which is not in the cach"):
        train.prepare(arguments)
    assert train.prepare(("--weights", "megaloc", "--help")) == ("--weights", "megaloc", "--help")


LOCAL = cj.PRESETS["tiny"].preprocessing


@pytest.mark.parametrize(
    ("found", "expected", "count"),
    [
        (ProjectionConfig(dim=4), ProjectionConfig(renormalise=False), 1),  # the width alone
        (MlpConfig(alpha=0.5), MlpConfig(), 1),
        (LOCAL, dataclasses.replace(LOCAL, mean=(0.0, 0.0, 0.0), deviation=(1.0, 1.0, 1.0)), 0),
        (MiningConfig(), MiningConfig(negatives=3, positive_radius=5.0), 0),
    ],
)
def test_fields_that_nothing_uses_are_not_compared(found, expected, count):
    assert len(differences(found, expected)) == len(differences(expected, found)) == count


def test_fields_that_nothing_uses_are_not_checked():
    dataclasses.replace(LOCAL, deviation=(0.0, 0.0, 0.0))


def test_weights_without_a_projection_fit_whatever_it_would_renormalise():
    other = dataclasses.replace(STARTER, projection=ProjectionConfig(renormalise=False))
    _, config = load_weights(find_weights("starter"), expected=other)
    assert config == STARTER
