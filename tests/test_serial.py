"""Configurations there and back through JSON, and what of a file is refused."""

import dataclasses
import json
import pathlib
from typing import Any

import pytest

from crisalad_jax.config import PRESETS, ModelConfig, TrainConfig, recipe
from crisalad_jax.errors import InputError
from crisalad_jax.files import write_json
from crisalad_jax.serial import differences, from_plain, read_config, to_plain

CHANGED = dataclasses.replace(
    recipe("tiny"), cities=("Aston", "Brill"), patience=4, rand_augment=recipe("b14").rand_augment
)


@pytest.mark.parametrize("config", [*map(recipe, PRESETS), CHANGED], ids=[*PRESETS, "changed"])
def test_every_recipe_survives_a_file(tmp_path: pathlib.Path, config: TrainConfig):
    write_json(tmp_path / "config.json", to_plain(config))
    found = read_config(TrainConfig, tmp_path / "config.json")
    assert found == config
    assert hash(found) == hash(config)  # tuples have not become lists


def test_plain_values_are_json_and_complete():
    plain = to_plain(recipe("tiny"))
    assert json.loads(json.dumps(plain)) == plain
    assert plain["model"]["image_size"] == [98, 98]
    assert plain["model"]["backbone"]["adapter"]["kind"] == "depthwise"
    assert plain["model"]["salad"]["sinkhorn"]["iterations"] == 3
    assert plain.keys() == {field.name for field in dataclasses.fields(TrainConfig)}


def test_fields_left_out_take_their_defaults():
    assert from_plain(TrainConfig, {}, source="here") == TrainConfig()
    found = from_plain(TrainConfig, {"optimiser": {"learning_rate": 1}}, source="here")
    assert found.optimiser.learning_rate == 1.0
    assert type(found.optimiser.learning_rate) is float


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"model": {"imag_size": [98, 98]}}, ["imag_size", "config.model"]),
        ({"model": {"image_size": [100, 98]}}, ["found 100 x 98", "nearest: 98 x 98"]),
        ({"model": {"image_size": [98]}}, ["config.model.image_size"]),
        ({"model": {"backbone": {"dim": "32"}}}, ["'32'", "expected int", "config.model.backbone"]),
        ({"model": {"backbone": {"ffn": "relu"}}}, ["relu", "swiglu", "config.model.backbone.ffn"]),
        ({"model": 3}, ["config.model"]),
        ({"model": None}, ["config.model"]),
        ({"epochs": 3.7}, ["3.7", "expected int", "config.epochs"]),
        ({"epochs": 0}, ["epochs", "expected more than 0"]),
        ({"seed": True}, ["True", "expected int", "config.seed"]),
        ({"patience": "x"}, ["'x'", "config.patience"]),
        ({"cities": "Rome"}, ["'Rome'", "list of names", "config.cities"]),
        ({"loss": {"library_quirk": "no"}}, ["'no'", "expected bool", "library_quirk"]),
        ({"epochs": 0.5, "seed": "1"}, ["config.epochs", "config.seed"]),
        ([], ["list"]),
        (None, ["NoneType"]),
        ("b14", ["str"]),
    ],
)
def test_what_does_not_fit_is_named_in_one_line(value: Any, words: list[str]):
    with pytest.raises(InputError) as caught:
        from_plain(TrainConfig, value, source="some/config.json")
    message = str(caught.value)
    assert message.startswith("some/config.json: ")
    assert "\n" not in message
    for word in words:
        assert word in message


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe\x00", b"[]", b'{"model": {'])
def test_a_file_that_is_no_configuration_is_named(tmp_path: pathlib.Path, content: bytes):
    path = tmp_path / "config.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=f"^{path}: ") as caught:
        read_config(ModelConfig, path)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path: pathlib.Path):
    for path in (tmp_path / "none.json", tmp_path):
        with pytest.raises(InputError, match=f"^{path}: cannot read"):
            read_config(ModelConfig, path)


def test_differences_name_the_fields_in_full():
    b14 = recipe("b14")
    other = dataclasses.replace(
        b14,
        seed=3,
        model=dataclasses.replace(
            b14.model, salad=dataclasses.replace(b14.model.salad, clusters=32)
        ),
    )
    assert differences(b14, b14) == []
    assert differences(other, b14) == [
        "model.salad.clusters: found 32, expected 64",
        "seed: found 3, expected 0",
    ]
