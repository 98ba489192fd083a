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
    """Make the recipe of `starter`'s last run, of 24,000 places (`render --scenes 6000`).

    Its weights started from a first run of smaller images, which docs/starter.md tells.
    """
    config = from_scratch(
        TrainConfig(
            model=model_over(
                preset,
                model,
                ResNetConfig(layers=18, stages=3, width=32),
                ConvApConfig(channels=64, side=6),
                (144, 192),
                compute_dtype="float32",
                normalisation="local-contrast",
            ),
            trainable="all",
        )
    )
    return dataclasses.replace(
        config,
        optimiser=dataclasses.replace(config.optimiser, learning_rate=7e-4),
        augmentation=CameraAugmentConfig(flip=0.5, gamma=0.3, illumination=0.3),
        epochs=4,
        validate_every=1,
    )
