"""SuperVLAD, as Lu-Feng/SuperVLAD trains it (Lu et al., NeurIPS 2024)."""

import dataclasses

from crisalad_jax.nn.adapter import AdapterConfig
from crisalad_jax.nn.aggregators import AGGREGATORS
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.recipes.base import register_recipe, validated_at, with_resizing
from crisalad_jax.training.recipes.crisalad import without_encoder


@register_recipe("supervlad")
def supervlad(model: ModelConfig, preset: str) -> TrainConfig:
    """Make SuperVLAD's recipe without its cross-image encoder; the last four blocks train.

    Scores start from k-means centroids of 5,000 training images. The code takes images of MSLS for
    these, at 322 x 322. (Its encoder of the cross-image model has an
    optimiser of its own, which after the first step finds no gradient.)
    """
    backbone = dataclasses.replace(model.backbone, adapter=AdapterConfig(kind="none"))
    aggregator = AGGREGATORS.make("supervlad", preset)
    config = TrainConfig(
        model=without_encoder(model, backbone=backbone, aggregator=aggregator),
        optimiser=OptimiserConfig(
            kind="adam", learning_rate=5e-5, schedule="step", weight_decay=0.0
        ),
        trainable="last-4-blocks+no-norm+head",
        places_per_batch=120,
        epochs=20,
        select_by="R@1+R@5",
        patience=3,
    )
    return validated_at(
        with_resizing(config, pixels="floats", round_to_patch=True), preset, (322, 322)
    )
