"""Recipes over ResNet: MixVPR, Conv-AP, BoQ, and the `starter` of this package.

Their sizes are the published ones for every preset but `tiny`, whose backbone is smaller.
"""

import dataclasses
from typing import Any

from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.data.augmentations.camera import CameraAugmentConfig
from crisalad_jax.nn.aggregators import AGGREGATORS
from crisalad_jax.nn.aggregators.conv_ap import ConvApConfig
from crisalad_jax.nn.backbones import BACKBONES, Backbone
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.recipes.base import (
    from_scratch,
    register_recipe,
    resized,
    validation_size,
)
from crisalad_jax.training.recipes.dinov2 import BOQ_TRAINING, MIXVPR_OPTIMISER


def model_over(
    preset: str,
    tiny: ModelConfig,
    backbone: Backbone,
    aggregator: Any,
    size: tuple[int, int],
    *,
    compute_dtype: Any = "bfloat16",
    **preprocessing: Any,
) -> ModelConfig:
    """Make a model without an encoder; of preset tiny over a small ResNet, with its images."""
    small = preset == "tiny"
    chain = PreprocessingConfig(**preprocessing)
    return ModelConfig(
        image_size=tiny.image_size if small else size,
        preprocessing=tiny.preprocessing if small else chain,
        backbone=BACKBONES.make("resnet", preset) if small else backbone,
        aggregator=aggregator,
        cross_image=CrossImageConfig(layers=0),
        compute_dtype=compute_dtype,
    )


@register_recipe("mixvpr")
def mixvpr(model: ModelConfig, preset: str) -> TrainConfig:
    """Make MixVPR's recipe, of amaralibey/MixVPR: ResNet-50, whose third stage trains, and SGD."""
    head = AGGREGATORS.make("mixvpr", preset)
    return TrainConfig(
        model=model_over(preset, model, ResNetConfig(stages=3), head, (320, 320)),
        optimiser=MIXVPR_OPTIMISER,
        trainable="last-1-blocks+head",
        places_per_batch=120,
        epochs=80,
        monitor="R@1",
        patience=None,
    )


@register_recipe("conv-ap")
def conv_ap(model: ModelConfig, preset: str) -> TrainConfig:
    """Make Conv-AP's recipe, of amaralibey/gsv-cities: ResNet-50, whose last two stages train.

    The head and the filter, bicubic, are those of its model of 4,096 numbers. Its optimiser is
    called Adam there, and is AdamW.
    """
    head = AGGREGATORS.make("conv-ap", preset)
    return TrainConfig(
        model=model_over(preset, model, ResNetConfig(), head, (320, 320), filter="bicubic"),
        optimiser=OptimiserConfig(
            learning_rate=2e-4,
            schedule="milestones",
            milestones=(5, 10, 15, 25),
            step_gamma=0.3,
            warmup_steps=600,
            weight_decay=0.0,
        ),
        trainable="last-2-blocks+head",
        places_per_batch=100,
        epochs=30,
        monitor="R@1",
        patience=None,
    )


@register_recipe("boq-resnet50")
def boq_resnet50(model: ModelConfig, preset: str) -> TrainConfig:
    """Make the recipe of BoQ over ResNet-50, whose second and third stages train.

    The head is that of the published weights, of 16,384 numbers.
    """
    queries: Any = AGGREGATORS.make("boq", preset)
    if preset != "tiny":
        queries = dataclasses.replace(queries, channels=512)
    whole = model_over(preset, model, ResNetConfig(stages=3), queries, (320, 320))
    chain = resized(whole.preprocessing, filter="bicubic", pixels="floats")
    return TrainConfig(
        model=dataclasses.replace(whole, preprocessing=chain),
        validation_size=validation_size(preset, 384),
        **BOQ_TRAINING,
    )


@register_recipe("starter")
def starter(model: ModelConfig, preset: str) -> TrainConfig:
    """Make the recipe of `starter`'s last run, of 24,000 places (`render --scenes 6000`).

    Its weights started from a first run of smaller images, which docs/starter.md describes.
    """
    whole = model_over(
        *(preset, model, ResNetConfig(layers=18, stages=3, width=32)),
        *(ConvApConfig(channels=64, side=6), (144, 192)),
        compute_dtype="float32",
        normalisation="local-contrast",
    )
    config = from_scratch(TrainConfig(model=whole, trainable="all"))
    return dataclasses.replace(
        config,
        optimiser=dataclasses.replace(config.optimiser, learning_rate=7e-4),
        augmentation=CameraAugmentConfig(flip=0.5, gamma=0.3, illumination=0.3),
        epochs=4,
        validate_every=1,
    )
