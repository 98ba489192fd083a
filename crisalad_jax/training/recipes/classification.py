"""CosPlace (Berton et al., CVPR 2022) and EigenPlaces (ICCV 2023): classification of places.

The recipes over ResNet follow the published code; those over a ViT, our paper's comparison.
"""

import dataclasses
from typing import Any

from crisalad_jax.config.classes import ClassesConfig
from crisalad_jax.data.augmentations.colour_crop import ColourCropConfig
from crisalad_jax.nn.aggregators import AGGREGATORS
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.losses import LossConfig
from crisalad_jax.training.losses.large_margin_cosine import LargeMarginCosineConfig
from crisalad_jax.training.recipes.base import model_of, register_recipe, with_head

_VIEWPOINTS = LargeMarginCosineConfig(
    scale=100.0,
    classes=ClassesConfig(kind="viewpoints", groups=9, steps=5000, cell=15.0, spacing=3),
)


def _classified(model: ModelConfig, loss: LargeMarginCosineConfig, **fields: Any) -> TrainConfig:
    """Make the recipe that both methods share: Adam at 1e-5, 32 classes with one image of each."""
    return TrainConfig(
        model=model,
        loss=LossConfig(kind=loss),
        optimiser=OptimiserConfig(
            kind="adam", learning_rate=1e-5, schedule="constant", weight_decay=0.0
        ),
        places_per_batch=32,
        images_per_place=1,
        sampler="shuffled",
        patience=None,
        **fields,
    )


def _over_resnet(
    model: ModelConfig, preset: str, loss: LargeMarginCosineConfig, dtype: str, **fields: Any
) -> TrainConfig:
    """Make a recipe over ResNet-18, whose last two stages train, for images at native sizes."""
    return _classified(
        model_of(
            *(model, preset, ResNetConfig(layers=18), "cosplace"),
            image_size=(512, 512),
            compute_dtype=dtype,
            size_rule="native",
        ),
        loss,
        trainable="last-2-blocks,head",
        augmentation=ColourCropConfig(),
        monitor="R@1",
        **fields,
    )


@register_recipe("cosplace")
def cosplace(model: ModelConfig, preset: str) -> TrainConfig:
    """Make CosPlace's recipe, from gmberton/CosPlace: its defaults, ResNet-18 and 512 dimensions.

    Classes are cells of position and heading, so the data need headings (column `northdeg`) and
    many images of a spot, as in San Francisco XL. Images are described at their native sizes.
    """
    loss = LargeMarginCosineConfig(classes=ClassesConfig(kind="cells", steps=10_000))
    return _over_resnet(model, preset, loss, "float32", min_images=10, epochs=50)


@register_recipe("eigenplaces-turns")
def eigenplaces_turns(model: ModelConfig, preset: str) -> TrainConfig:
    """Make EigenPlaces' recipe, from gmberton/EigenPlaces, with two differences.

    A step of that code takes a batch of lateral and a batch of frontal classes; here the two kinds
    alternate by epoch, over twice as many epochs. That code crops images from panoramas, towards
    the focal point of a class; here photographs keep their own headings.
    """
    return _over_resnet(model, preset, _VIEWPOINTS, "bfloat16", min_images=5, epochs=80)


@register_recipe("cosplace-vit")
def cosplace_vit(model: ModelConfig, preset: str) -> TrainConfig:
    """Make CosPlace's recipe for the preset's ViT, whose adapters and head train.

    Images are resized to the ViT's input size and augmented by RandAugment. The classes are
    GSV-Cities' places, because each of them is one spot in one direction.
    """
    loss = LargeMarginCosineConfig(classes=ClassesConfig(steps=10_000))
    head = AGGREGATORS.make("cosplace", preset)
    return _classified(with_head(model, head), loss, epochs=50)


@register_recipe("eigenplaces-vit")
def eigenplaces_vit(model: ModelConfig, preset: str) -> TrainConfig:
    """Make EigenPlaces' recipe for the preset's ViT: like CosPlace's, with viewpoint classes.

    Lateral and frontal classes alternate by epoch; descriptors are 4 times as long as CosPlace's.
    """
    head: Any = AGGREGATORS.make("cosplace", preset)
    head = dataclasses.replace(head, dim=4 * head.dim)
    return _classified(with_head(model, head), _VIEWPOINTS, epochs=80, min_images=5)
