"""Recipes for visual words of hand-crafted features; only `with_vocabulary` fits the words."""

from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators import AGGREGATORS
from crisalad_jax.nn.backbones import BACKBONES
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.recipes.base import register_recipe


@register_recipe("sift-vlad")
def sift_vlad(model: ModelConfig, preset: str) -> TrainConfig:
    """Make the recipe of SIFT with VLAD (Jegou et al., CVPR 2010): 64 words, 8,192 dimensions."""
    return _words("sift", "vlad", preset)


@register_recipe("sift-bow")
def sift_bow(model: ModelConfig, preset: str) -> TrainConfig:
    """Make the recipe of SIFT with a tf-idf bag of 1,000 words (Sivic and Zisserman, ICCV 2003)."""
    return _words("sift", "bow", preset)


@register_recipe("orb-bow")
def orb_bow(model: ModelConfig, preset: str) -> TrainConfig:
    """Make the recipe of ORB with 1,000 binary words (Galvez-Lopez and Tardos, T-RO 2012)."""
    return _words("orb", "bow", preset)


def _words(backbone: str, aggregator: str, preset: str) -> TrainConfig:
    """Make a recipe, for any preset, that shrinks images to a longer side of at most 640."""
    unit = 1 / 255
    model = ModelConfig(
        image_size=(480, 640),
        preprocessing=PreprocessingConfig(
            size_rule="longer-side", mean=(0.0, 0.0, 0.0), deviation=(unit, unit, unit)
        ),
        backbone=BACKBONES.make(backbone, preset),
        aggregator=AGGREGATORS.make(aggregator, preset),
        cross_image="none",
    )
    return TrainConfig(model=model, trainable="head")
