"""EDTformer, as Tong-Jin01/EDTformer trains it (Jin et al. 2025)."""

import dataclasses

from crisalad_jax.nn.adapter import AdapterConfig
from crisalad_jax.nn.aggregators import AGGREGATORS
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.recipes.base import register_recipe, validated_at, with_resizing
from crisalad_jax.training.recipes.crisalad import without_encoder

_ADAPTER_WIDTH = 4


@register_recipe("edtformer")
def edtformer(model: ModelConfig, preset: str) -> TrainConfig:
    """Make EDTformer's recipe: adapters beside the blocks, a decoder, Adam with step decay."""
    adapter = AdapterConfig(kind="side", bottleneck=_ADAPTER_WIDTH / model.backbone.dim, alpha=0.5)
    backbone = dataclasses.replace(model.backbone, adapter=adapter)
    aggregator = AGGREGATORS.make("edtformer", preset)
    config = TrainConfig(
        model=without_encoder(model, backbone=backbone, aggregator=aggregator),
        optimiser=OptimiserConfig(
            kind="adam", learning_rate=1e-4, schedule="step", step_gamma=0.7, weight_decay=0.0
        ),
        places_per_batch=72,
        epochs=15,
        patience=15,
    )
    return validated_at(
        with_resizing(config, pixels="floats", round_to_patch=True), preset, (322, 322)
    )
