"""Sizes by each rule, computed by hand as torchvision and hloc do; rounding, and words."""

import dataclasses

import pytest

from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators.mixvpr import MixVprConfig
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.utils.errors import InputError
from tests.conftest import MODEL


@pytest.mark.parametrize(
    ("rule", "image_size", "size", "expected"),
    [
        ("fixed", (322, 280), (480, 640), (322, 280)),
        ("native", (322, 280), (481, 643), (481, 643)),
        # 512 * 517 / 333 is 794.9, of which torchvision cuts off the fraction.
        ("shorter-side", (512, 512), (333, 517), (512, 794)),
        ("shorter-side", (512, 640), (517, 333), (794, 512)),
        ("shorter-side", (512, 512), (1024, 1024), (512, 512)),
        # 700 * 1024 / 1500 is 477.87, which hloc rounds.
        ("longer-side", (1024, 1024), (700, 1500), (478, 1024)),
        ("longer-side", (768, 1024), (1500, 700), (1024, 478)),
        ("longer-side", (1024, 1024), (480, 640), (480, 640)),
        ("longer-side", (1024, 1024), (1, 9000), (1, 1024)),
    ],
)
def test_the_size_of_an_image(rule, image_size, size, expected):
    how = PreprocessingConfig(size_rule=rule)
    assert how.target_size(size, image_size) == expected


def test_sides_are_rounded_to_the_nearest_multiple_and_halves_to_the_even_one():
    native, fixed = PreprocessingConfig(size_rule="native"), PreprocessingConfig()
    rounding = PreprocessingConfig(round_to_patch=True)
    for side, expected in {240: 238, 320: 322, 35: 28, 49: 56, 6: 14, 322: 322}.items():
        assert native.rounded_size((side, 14), 14) == (expected, 14)
        assert rounding.rounded_size((14, side), 14) == (14, expected)
        assert fixed.rounded_size((side, 14), 14) == (side, 14)
        assert native.rounded_size((side, side), 1) == (side, side)


def test_words_set_fields():
    how = PreprocessingConfig(mean=(0.0, 0.0, 0.0))
    words = ("shorter-side", "bicubic", "no-antialias", "floats", "round")
    changes = {"size_rule": "shorter-side", "filter": "bicubic", "antialias": False}
    changes |= {"pixels": "floats", "round_to_patch": True}
    assert how.changed_by(words) == dataclasses.replace(how, **changes)
    assert how.changed_by(()) == how
    with pytest.raises(InputError, match="found area bicubic, expected one of bilinear, bicubic"):
        how.changed_by(["area", "bicubic"])
    for words, of in ((["area", "no-antialias"], how), (["antialias"], how.changed_by(["area"]))):
        with pytest.raises(InputError, match=f"found {' '.join(words)}, expected neither "):
            of.changed_by(words)


def test_a_model_rounds_where_its_backbone_needs_it():
    """And a size that is fixed only where that is asked for."""
    native = MODEL.resized((60, 80), ["native"])
    assert (native.image_size, native.input_size, native.grid) == ((60, 80), (56, 84), (4, 6))
    assert native.images_in_words == (
        "native size, bilinear, antialiased, on bytes, rounded to multiples of 14"
    )
    fixed = MODEL.resized((60, 80), ["round"])
    assert (fixed.input_size, fixed.grid) == ((56, 84), (4, 6))
    assert fixed.resized((42, 56)).images_in_words == "42 x 56, bilinear, antialiased, on bytes"
    with pytest.raises(InputError, match=r"image size: found 60 x 80, expected .* multiples of 14"):
        MODEL.resized((60, 80))


def test_a_backbone_of_any_size_is_not_rounded():
    config = ModelConfig(
        image_size=(500, 512),
        preprocessing=PreprocessingConfig(size_rule="shorter-side"),
        backbone=ResNetConfig(layers=18),
        aggregator="gem",
        cross_image="none",
    )
    assert config.images_in_words == "shorter side 500, bilinear, antialiased, on bytes"
    for each in (config, config.resized(None, ["round"])):
        # ResNet-18 halves sides five times, each time rounded up.
        assert (each.side_multiple, each.input_size, each.grid) == (1, (500, 512), (16, 16))


def test_a_size_beside_a_native_rule_is_told():
    """Unless the same call names a rule."""
    native = MODEL.resized(None, ["native"])
    for words in ([], ["bicubic"]):
        with pytest.raises(InputError, match=r"--image-size: found 56 x 84 .*--resize fixed"):
            native.resized((56, 84), words)
    fixed = native.resized((56, 84), ["fixed"])
    assert fixed == MODEL.resized((56, 84))
    assert native.resized((56, 84), ["native"]).image_size == (56, 84)


def test_parameters_for_every_patch_need_a_fixed_size():
    config = dataclasses.replace(
        MODEL,
        aggregator=MixVprConfig(channels=8, rows=2, depth=1),
        cross_image="none",
    )
    with pytest.raises(InputError, match=r"size_rule: found .native., expected fixed: .* mixvpr"):
        config.resized(None, ["native"])
