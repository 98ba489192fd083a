"""BoQ over DINOv2, as amaralibey/Bag-of-Queries trains it (Ali-bey et al., CVPR 2024)."""

import dataclasses

from crisalad_jax.data.augmentations.rand_augment import RandAugmentConfig
from crisalad_jax.nn.adapter import AdapterConfig
from crisalad_jax.nn.aggregators import AGGREGATORS
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.recipes.base import register_recipe, validated_at, with_resizing
from crisalad_jax.training.recipes.crisalad import without_encoder


@register_recipe("boq")
def boq(model: ModelConfig, preset: str) -> TrainConfig:
    """Make the recipe of BoQ over DINOv2, whose last two blocks train.

    The head is that of the published weights, of 12,288 numbers; the code's own default is wider
    and has 8,192.
    """
    backbone = dataclasses.replace(model.backbone, adapter=AdapterConfig(kind="none"))
    config = trained_as_boq(
        without_encoder(
            model,
            backbone=backbone,
            aggregator=AGGREGATORS.make("boq", preset),
            compute_dtype="bfloat16",
        ),
        trainable="last-2-blocks+head",
    )
    return validated_at(config, preset, (322, 322))


def trained_as_boq(model: ModelConfig, *, trainable: str) -> TrainConfig:
    """Make the training that BoQ's code has for all its backbones."""
    config = TrainConfig(
        model=model,
        optimiser=OptimiserConfig(
            learning_rate=1e-4,
            schedule="milestones",
            milestones=(10, 20),
            step_gamma=0.1,
            warmup_epochs=10,
            weight_decay=1e-4,
        ),
        trainable=trainable,
        augmentation=RandAugmentConfig(magnitude=15),
        places_per_batch=128,
        epochs=40,
        select_by="R@1",
        patience=None,
    )
    return with_resizing(config, filter="bicubic", pixels="floats")
