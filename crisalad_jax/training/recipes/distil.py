"""The recipe of distillation: a student trains on a teacher's descriptors of unlabelled images."""

import dataclasses

from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.losses import LossConfig
from crisalad_jax.training.recipes.base import from_scratch, register_recipe


@register_recipe("distil")
def distil(model: ModelConfig, preset: str) -> TrainConfig:
    """Make the recipe of `crisalad distil`: that of `scratch`, with one image of each place.

    The student has no cross-image encoder, so that its descriptors are single-image.
    """
    alone = dataclasses.replace(model, cross_image="none")
    config = from_scratch(TrainConfig(model=alone, loss=LossConfig(kind="distil")))
    return dataclasses.replace(
        config, places_per_batch=64, images_per_place=1, min_images=1, epochs=30, validate_every=5
    )
