"""Recipes over ResNet and VGG: MixVPR, Conv-AP, BoQ, CosPlace and EigenPlaces.

Their sizes are the published ones for every preset but `tiny`, whose backbone is smaller.
"""

import dataclasses
from typing import Any

from crisalad_jax.config.classes import ClassesConfig
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.data.augmentations.colour_crop import ColourCropConfig
from crisalad_jax.losses import LossConfig
from crisalad_jax.losses.large_margin_cosine import LargeMarginCosineConfig
from crisalad_jax.nn.aggregators import AGGREGATORS, Aggregator
from crisalad_jax.nn.backbones import BACKBONES, Backbone
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.recipes.base import register_recipe, validated_at
from crisalad_jax.training.recipes.boq import trained_as_boq
from crisalad_jax.training.recipes.mixvpr import MIXVPR_OPTIMISER

_TINY = "tiny"
_ADAM = OptimiserConfig(kind="adam", learning_rate=1e-5, end_lr_fraction=1.0, weight_decay=0.0)


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
    small = preset == _TINY
    return ModelConfig(
        image_size=tiny.image_size if small else size,
        preprocessing=tiny.preprocessing if small else PreprocessingConfig(**preprocessing),
        backbone=BACKBONES.make("resnet", _TINY) if small else backbone,
        aggregator=aggregator,
        cross_image=CrossImageConfig(layers=0),
        compute_dtype=compute_dtype,
    )


@register_recipe("mixvpr")
def mixvpr(model: ModelConfig, preset: str) -> TrainConfig:
    """Make MixVPR's recipe, of amaralibey/MixVPR: ResNet-50, whose third stage trains, and SGD."""
    return TrainConfig(
        model=model_over(
            preset,
            model,
            ResNetConfig(stages=3),
            AGGREGATORS.make("mixvpr", preset),
            (320, 320),
        ),
        optimiser=MIXVPR_OPTIMISER,
        trainable="last-1-blocks+head",
        places_per_batch=120,
        epochs=80,
        select_by="R@1",
        patience=None,
    )


@register_recipe("conv-ap")
def conv_ap(model: ModelConfig, preset: str) -> TrainConfig:
    """Make Conv-AP's recipe, of amaralibey/gsv-cities: ResNet-50, whose last two stages train.

    The head and the filter, bicubic, are those of its model of 4,096 numbers. Its optimiser is
    called Adam there, and is AdamW.
    """
    return TrainConfig(
        model=model_over(
            preset,
            model,
            ResNetConfig(),
            AGGREGATORS.make("conv-ap", preset),
            (320, 320),
            filter="bicubic",
        ),
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
        select_by="R@1",
        patience=None,
    )


@register_recipe("boq-resnet50")
def boq_resnet50(model: ModelConfig, preset: str) -> TrainConfig:
    """Make the recipe of BoQ over ResNet-50, whose second and third stages train.

    The head is that of the published weights, of 16,384 numbers.
    """
    queries: Any = AGGREGATORS.make("boq", preset)
    if preset != _TINY:
        queries = dataclasses.replace(queries, channels=512)
    config = trained_as_boq(
        model_over(preset, model, ResNetConfig(stages=3), queries, (320, 320)),
        trainable="last-2-blocks+head",
    )
    return validated_at(config, preset, (384, 384))


@register_recipe("cosplace")
def cosplace(model: ModelConfig, preset: str) -> TrainConfig:
    """Make CosPlace's recipe, of gmberton/CosPlace: ResNet-18 and 512 numbers, its code's defaults.

    Classes are cells of position and heading, which ask for the headings of `northdeg`, and for
    many images of a spot, as in San Francisco XL. Images are described at their own sizes.
    """
    loss = LargeMarginCosineConfig(classes=ClassesConfig(kind="cells", steps=10_000))
    return _classified(model, preset, loss, min_images=10, epochs=50, compute_dtype="float32")


@register_recipe("eigenplaces-turns")
def eigenplaces_turns(model: ModelConfig, preset: str) -> TrainConfig:
    """Make EigenPlaces' recipe, of gmberton/EigenPlaces, with two differences.

    A step of its code takes a batch of lateral and one of frontal classes, here they take turns by
    epochs, of which there are twice as many. It cuts images out of panoramas, towards the focal
    point; here photographs have the headings that they have.
    """
    classes = ClassesConfig(kind="viewpoints", groups=9, steps=5000, cell=15.0, spacing=3)
    loss = LargeMarginCosineConfig(scale=100.0, classes=classes)
    return _classified(model, preset, loss, min_images=5, epochs=80, compute_dtype="bfloat16")


def _classified(
    model: ModelConfig,
    preset: str,
    loss: LargeMarginCosineConfig,
    *,
    min_images: int,
    epochs: int,
    compute_dtype: Any,
) -> TrainConfig:
    aggregator: Aggregator = AGGREGATORS.make("cosplace", preset)
    return TrainConfig(
        model=model_over(
            preset,
            model,
            ResNetConfig(layers=18),
            aggregator,
            (512, 512),
            compute_dtype=compute_dtype,
            size_rule="native",
        ),
        loss=LossConfig(kind=loss),
        optimiser=_ADAM,
        trainable="last-2-blocks+head",
        augmentation=ColourCropConfig(),
        places_per_batch=32,
        images_per_place=1,
        min_images=min_images,
        batch_order="shuffled",
        epochs=epochs,
        select_by="R@1",
        patience=None,
    )
