"""AnyLoc over DINOv2 as it is (Keetha et al., RA-L 2023)."""

import dataclasses

from crisalad_jax.nn.adapter import AdapterConfig
from crisalad_jax.nn.aggregators import AGGREGATORS
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.recipes.base import register_recipe
from crisalad_jax.training.recipes.crisalad import without_encoder


@register_recipe("anyloc")
def anyloc(model: ModelConfig, preset: str) -> TrainConfig:
    """Make AnyLoc's recipe, which is of use for its model alone: nothing of it trains."""
    backbone = dataclasses.replace(model.backbone, adapter=AdapterConfig(kind="none"))
    aggregator = AGGREGATORS.make("anyloc", preset)
    return TrainConfig(
        model=without_encoder(model, backbone=backbone, aggregator=aggregator), trainable="head"
    )
