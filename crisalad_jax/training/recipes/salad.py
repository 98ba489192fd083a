"""DINO-SALAD, as serizba/salad trains it (Izquierdo and Civera, CVPR 2024)."""

import dataclasses

from crisalad_jax.nn.adapter import AdapterConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.recipes.base import register_recipe
from crisalad_jax.training.recipes.crisalad import without_encoder


@register_recipe("salad")
def salad(model: ModelConfig, preset: str) -> TrainConfig:
    """Make SALAD's recipe: no adapter or encoder, the last four blocks train in mixed precision.

    Its code also moves the schedule on by a step at the end of each epoch, which is left out: a
    learning rate lower by less than 1 part in 1,000.
    """
    backbone = dataclasses.replace(model.backbone, adapter=AdapterConfig(kind="none"))
    return TrainConfig(
        model=without_encoder(model, backbone=backbone, compute_dtype="bfloat16"),
        optimiser=OptimiserConfig(weight_decay=9.5e-9, end_lr_fraction=0.2, decay_steps=4000),
        trainable="last-4-blocks+head",
        places_per_batch=60,
        epochs=4,
        select_by="R@1",
        patience=None,
    )
