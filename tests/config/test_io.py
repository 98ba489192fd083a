"""Configurations there and back through JSON, and what of a file is refused."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from crisalad_jax.config.io import differences, from_plain, read_config, to_plain
from crisalad_jax.nn.aggregators import AGGREGATORS
from crisalad_jax.nn.config import PRESETS, ModelConfig
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.losses import LOSSES
from crisalad_jax.training.recipes import RECIPES, recipe
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import write_json

CHANGED = dataclasses.replace(
    recipe("tiny"), cities=("Aston", "Brill"), patience=4, augmentation=recipe("b14").augmentation
)
VIT = {"name": "vit"}
CONFIGS = {"changed": CHANGED} | {preset: recipe(preset) for preset in PRESETS}
# One head needs a backbone with two side paths.
NAMES = {*RECIPES, *AGGREGATORS, *LOSSES} - {"selavprpp-hash"}
CONFIGS |= {name: recipe("b14", name) for name in sorted(NAMES)}


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_every_preset_and_every_recipe_survives_a_file(tmp_path, config):
    plain = to_plain(config)
    write_json(tmp_path / "config.json", plain)
    found = read_config(TrainConfig, tmp_path / "config.json")
    assert found == config
    assert hash(found) == hash(config)  # tuples have not become lists
    assert to_plain(found) == plain
    model = from_plain(ModelConfig, plain["model"], source="here")
    assert model == config.model


def test_fields_left_out_take_their_defaults():
    assert from_plain(TrainConfig, {}, source="here") == TrainConfig()
    found = from_plain(TrainConfig, {"optimiser": {"learning_rate": 1}}, source="here")
    assert found.optimiser.learning_rate == 1.0
    assert type(found.optimiser.learning_rate) is float


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"model": {"imag_size": [98, 98]}}, ["imag_size", "config.model"]),
        ({"model": {"image_size": [98]}}, ["config.model.image_size"]),
        ({"model": {"backbone": VIT | {"dim": "32"}}}, ["'32'", "a whole", "backbone.dim"]),
        ({"model": {"backbone": {"dim": 32}}}, ["None", "config.model.backbone"]),
        ({"epochs": 3.7}, ["3.7", "expected a whole number", "config.epochs"]),
        ({"epochs": 0}, ["epochs", "expected a whole number of at least 1"]),
        ({"cities": "Rome"}, ["'Rome'", "tuple, each text", "config.cities"]),
        ({"loss": {"pml_compat": "no"}}, ["'no'", "True or False", "loss.pml_compat"]),
        ({"model": {"aggregator": {"name": ["gem"]}}}, ["['gem']", "config.model.aggregator"]),
        ({"model": {"aggregator": {"name": "gem", "clusters": 2}}}, ["found clusters"]),
        ({"model": {"aggregator": {"name": "gem"}, "gem": {}}}, ["found gem", "config.model"]),
        ([], ["found []", "an object"]),
    ],
)
def test_what_does_not_fit_is_named_in_one_line(value, words):
    with pytest.raises(InputError) as caught:
        from_plain(TrainConfig, value, source="some/config.json")
    message = str(caught.value)
    assert message.startswith("some/config.json: ")
    assert "\n" not in message
    for word in words:
        assert word in message


def test_a_written_configuration_that_was_changed_is_refused(tmp_path):
    path = tmp_path / "config.json"
    write_json(path, to_plain(recipe("tiny")))
    text = path.read_text()
    assert text.count('"seed": 0') == 1
    path.write_text(text.replace('"seed": 0', '"seed": 1'))
    with pytest.raises(InputError, match=f"^{path}: found other bytes than were written"):
        read_config(TrainConfig, path)


def test_a_configuration_that_a_user_wrote_is_read(tmp_path):
    path = tmp_path / "config.json"
    path.write_text('{"seed": 7}')
    assert read_config(TrainConfig, path) == TrainConfig(seed=7)


UNKNOWN_STEP = {"name": "salad", "sinkhorn": {"step": {"name": "x"}}}


@pytest.mark.parametrize(
    ("value", "words", "place"),
    [
        ({"model": {"backbone": "x"}}, "backbone: found 'x', expected one of d", "model.backbone"),
        (
            {"model": {"aggregator": UNKNOWN_STEP}},
            "step: found 'x', expected one of annealing, ",
            "model.aggregator.sinkhorn.step",
        ),
    ],
)
def test_an_unknown_part_is_named_and_may_be_a_plug_ins(value, words, place):
    here = rf"^some/config\.json: {words}.*is a plug-in missing\?.* @ config\.{place}$"
    with pytest.raises(InputError, match=here):
        from_plain(TrainConfig, value, source="some/config.json")


def test_differences_name_the_fields_in_full():
    b14 = recipe("b14")
    head = dataclasses.replace(b14.model.aggregator, clusters=32)
    other = dataclasses.replace(b14, seed=3, model=dataclasses.replace(b14.model, aggregator=head))
    assert differences(b14, b14) == []
    assert differences(other, b14) == [
        "model.aggregator.clusters: found 32, expected 64",
        "seed: found 3, expected 0",
    ]


def test_a_number_of_numpy_is_a_number_and_other_objects_are_refused():
    @dataclasses.dataclass(frozen=True)
    class Some:
        value: Any

    assert to_plain(Some(np.float32(0.5))) == {"value": 0.5}
    with pytest.raises(InputError, match=r"^configuration: found <object .*>, expected numbers"):
        to_plain(Some(object()))
