"""The recipe of the model in this package, `starter`: trained on the rendered world alone."""

import dataclasses

from crisalad_jax.data.augmentations.camera import CameraAugmentConfig
from crisalad_jax.nn.aggregators.conv_ap import ConvApConfig
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.recipes.base import from_scratch, register_recipe
from crisalad_jax.training.recipes.convolutional import model_over


@register_recipe("starter")
def starter(model: ModelConfig, preset: str) -> TrainConfig:
    """Make the recipe of `starter` (docs/starter.md), from random weights in one run.

    The world is `crisalad render`'s. The weights in the package are of two runs instead: one with
    the schedule of 26 epochs, stopped early, and a short one with a lower rate.
    """
    config = from_scratch(
        TrainConfig(
            model=model_over(
                preset,
                model,
                ResNetConfig(layers=18, stages=3, width=32),
                ConvApConfig(channels=64, side=6),
                (96, 128),
                compute_dtype="float32",
                normalisation="local-contrast",
            ),
            trainable="all",
        )
    )
    return dataclasses.replace(
        config,
        augmentation=CameraAugmentConfig(flip=0.5, gamma=0.3, illumination=0.3),
        epochs=18,
        validate_every=2,
    )
