"""Recipes over ResNet: MixVPR, Conv-AP, BoQ, and the `starter` of this package.

Their sizes are the published ones for every preset except `tiny`, whose backbone is smaller.
"""

import dataclasses

from crisalad_jax.data.augmentations.camera import CameraAugmentConfig
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.recipes.base import (
    from_scratch,
    model_of,
    register_recipe,
    validation_size,
)
from crisalad_jax.training.recipes.dinov2 import BOQ_TRAINING, MIXVPR_OPTIMISER
from crisalad_jax.training.schedules import MilestonesSchedule


@register_recipe("mixvpr")
def mixvpr(model: ModelConfig, preset: str) -> TrainConfig:
    """Make MixVPR's recipe, from amaralibey/MixVPR: SGD and ResNet-50, whose third stage trains."""
    return TrainConfig(
        model=model_of(
            *(model, preset, ResNetConfig(stages=3), "mixvpr"),
            image_size=(320, 320),
            compute_dtype="bfloat16",
        ),
        optimiser=MIXVPR_OPTIMISER,
        trainable="last-1-blocks,head",
        places_per_batch=120,
        epochs=80,
        monitor="R@1",
        patience=None,
    )


@register_recipe("conv-ap")
def conv_ap(model: ModelConfig, preset: str) -> TrainConfig:
    """Make Conv-AP's recipe, from amaralibey/gsv-cities: ResNet-50, whose last two stages train.

    The head and the bicubic filter are those of the published model with 4,096 dimensions. The
    optimiser that the code calls Adam is AdamW.
    """
    return TrainConfig(
        model=model_of(
            *(model, preset, ResNetConfig(), "conv-ap"),
            image_size=(320, 320),
            compute_dtype="bfloat16",
            filter="bilinear" if preset == "tiny" else "bicubic",
        ),
        optimiser=OptimiserConfig(
            learning_rate=2e-4,
            schedule=MilestonesSchedule((5, 10, 15, 25), gamma=0.3),
            warmup_steps=600,
            weight_decay=0.0,
        ),
        trainable="last-2-blocks,head",
        places_per_batch=100,
        epochs=30,
        monitor="R@1",
        patience=None,
    )


@register_recipe("boq-resnet50")
def boq_resnet50(model: ModelConfig, preset: str) -> TrainConfig:
    """Make the recipe of BoQ over ResNet-50, whose second and third stages train.

    The head is that of the published weights, with 16,384 dimensions.
    """
    return TrainConfig(
        model=model_of(
            *(model, preset, ResNetConfig(stages=3), "boq"),
            image_size=(320, 320),
            compute_dtype="bfloat16",
            head={} if preset == "tiny" else {"channels": 512},
            filter="bicubic",
            pixels="floats",
        ),
        validation_size=validation_size(preset, 384),
        **BOQ_TRAINING,
    )


@register_recipe("starter")
def starter(model: ModelConfig, preset: str) -> TrainConfig:
    """Make the recipe of the second run of model `starter`: 24,000 places (`render --scenes 6000`).

    That run started from the weights of an earlier one on smaller images; see docs/starter.md.
    """
    whole = model_of(
        *(model, preset, ResNetConfig(layers=18, stages=3, width=48), "conv-ap"),
        image_size=(144, 192),
        head={"channels": 64, "side": 6},
        normalisation="local-contrast",
    )
    config = from_scratch(TrainConfig(model=whole, trainable="all"))
    return dataclasses.replace(
        config,
        optimiser=dataclasses.replace(config.optimiser, learning_rate=7e-4),
        augmentation=CameraAugmentConfig(
            crop=0.15, rotation=5.0, flip=0.5, gamma=0.3, illumination=0.3
        ),
        epochs=3,
        validate_every=1,
    )
