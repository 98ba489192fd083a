"""Configurations as they print."""

import dataclasses

import pytest

import crisalad_jax as cj
from crisalad_jax.config.classes import ClassesConfig
from crisalad_jax.config.parts import REGISTRIES
from crisalad_jax.training.recipes import RECIPES

NAMES = {
    kind.__name__: kind
    for kind in (
        *(cj.ModelConfig, cj.TrainConfig, cj.OptimiserConfig, cj.MiningConfig, cj.LossConfig),
        *(cj.AdapterConfig, cj.CrossImageConfig, cj.ProjectionConfig, cj.PreprocessingConfig),
        *(cj.SinkhornConfig, ClassesConfig),
        *(type(registry.make(name)) for registry in REGISTRIES.values() for name in registry),
    )
}


def test_a_preset_is_printed_by_what_differs():
    assert repr(cj.PRESETS["b14"]) == "ModelConfig(backbone='vit', aggregator='salad')"
    # ViT-S is 384 wide with 6 heads (DINOv2's table of sizes).
    assert repr(cj.PRESETS["s14"]) == (
        "ModelConfig(backbone=ViTConfig(dim=384, heads=6), aggregator='salad')"
    )


def test_long_calls_take_a_line_for_each_field():
    assert repr(cj.PRESETS["g14"]).splitlines() == [
        "ModelConfig(",
        "    backbone=ViTConfig(dim=1536, depth=40, heads=24, ffn='swiglu'),",
        "    aggregator='salad',",
        ")",
    ]


@pytest.mark.parametrize("name", RECIPES)
def test_what_is_printed_makes_the_configuration_again(name):
    config = cj.recipe("l14" if name == "selavpr" else "b14", name)
    made = eval(repr(config), NAMES)
    # Fields that are not in use are left out, so the two print alike.
    assert repr(made) == repr(config)
    assert dataclasses.replace(config, model=made.model, mining=made.mining) == made
    assert max(map(len, repr(config).splitlines())) <= 89  # a comma may follow


def test_what_is_not_in_use_is_left_out():
    alone = cj.CrossImageConfig(layers=0, heads=4, dropout=0.0)
    assert repr(alone) == "CrossImageConfig(layers=0)"
    assert repr(cj.AdapterConfig(kind="none", alpha=0.5)) == "AdapterConfig(kind='none')"
    assert repr(cj.AdapterConfig(alpha=0.5)) == "AdapterConfig(alpha=0.5)"


def test_a_message_with_a_configuration_is_one_line():
    with pytest.raises(cj.InputError) as caught:
        cj.PreprocessingConfig(antialias=cj.PRESETS["tiny"])
    assert "\n" not in str(caught.value)
    assert "found ModelConfig(image_size=(98, 98), " in str(caught.value)
