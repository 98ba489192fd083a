"""CosPlace (Berton et al., CVPR 2022) and EigenPlaces (ICCV 2023): classification of places."""

import dataclasses
from typing import Any

from crisalad_jax.config.classes import ClassesConfig
from crisalad_jax.losses import LossConfig
from crisalad_jax.losses.large_margin_cosine import LargeMarginCosineConfig
from crisalad_jax.nn.aggregators import AGGREGATORS
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.recipes.base import register_recipe
from crisalad_jax.training.recipes.crisalad import without_encoder


@register_recipe("cosplace-vit")
def cosplace_vit(model: ModelConfig, preset: str) -> TrainConfig:
    """Make gmberton/CosPlace's recipe for our ViT: Adam at 1e-5, 32 classes, an image of each.

    Adapters and head train on images of the ViT's size, with RandAugment. The classes are
    GSV-Cities' places, for each of them is one spot in one direction.
    """
    loss = LargeMarginCosineConfig(classes=ClassesConfig(steps=10_000))
    return _classified(model, AGGREGATORS.make("cosplace", preset), loss, epochs=50)


@register_recipe("eigenplaces-vit")
def eigenplaces_vit(model: ModelConfig, preset: str) -> TrainConfig:
    """Make gmberton/EigenPlaces' recipe for our ViT: viewpoint classes, longer descriptors.

    A step of the public code takes one batch of lateral and one of frontal classes. Here each kind
    has its own epochs, of which there are twice as many.
    """
    head: Any = AGGREGATORS.make("cosplace", preset)
    classes = ClassesConfig(kind="viewpoints", groups=9, steps=5000, cell=15.0, spacing=3)
    config = _classified(
        model,
        dataclasses.replace(head, dim=4 * head.dim),
        LargeMarginCosineConfig(scale=100.0, classes=classes),
        epochs=80,
    )
    return dataclasses.replace(config, min_images=5)


def _classified(
    model: ModelConfig, aggregator: Any, loss: LargeMarginCosineConfig, *, epochs: int
) -> TrainConfig:
    return TrainConfig(
        model=without_encoder(model, aggregator=aggregator),
        loss=LossConfig(kind=loss),
        optimiser=OptimiserConfig(
            kind="adam", learning_rate=1e-5, end_lr_fraction=1.0, weight_decay=0.0
        ),
        places_per_batch=32,
        images_per_place=1,
        batch_order="shuffled",
        epochs=epochs,
        patience=None,
    )
