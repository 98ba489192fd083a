"""ImAge, as Lu-Feng/ImAge trains it (Lu et al., NeurIPS 2025)."""

import dataclasses
from typing import Any

from crisalad_jax.nn.adapter import AdapterConfig
from crisalad_jax.nn.aggregators import AGGREGATORS
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.recipes.base import register_recipe, validated_at, with_resizing
from crisalad_jax.training.recipes.crisalad import without_encoder


@register_recipe("image")
def image(model: ModelConfig, preset: str) -> TrainConfig:
    """Make ImAge's recipe: DINOv2 with registers, whose blocks train from the tokens' on.

    The tokens start from centroids of the last features of 5,000 training images. The code takes
    images of MSLS for these, unless asked otherwise, at 322 x 322.
    """
    tokens: Any = AGGREGATORS.make("aggregation-tokens", preset)
    backbone: Any = dataclasses.replace(
        model.backbone,
        adapter=AdapterConfig(kind="none"),
        registers=4,
        position_resize="plain",
    )
    config = TrainConfig(
        model=without_encoder(
            model, backbone=backbone, aggregator=tokens, compute_dtype="bfloat16"
        ),
        optimiser=OptimiserConfig(
            kind="adam", learning_rate=5e-5, schedule="step", weight_decay=0.0
        ),
        trainable=f"last-{-tokens.insertion}-blocks+no-norm+head",
        places_per_batch=120,
        epochs=20,
        select_by="R@1+R@5",
        patience=20,
    )
    return validated_at(
        with_resizing(config, pixels="floats", round_to_patch=True), preset, (322, 322)
    )
