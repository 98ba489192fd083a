"""CricaVPR, as Lu-Feng/CricaVPR trains it (CVPR 2024)."""

import dataclasses

from crisalad_jax.nn.adapter import AdapterConfig
from crisalad_jax.nn.config import ModelConfig, with_aggregator
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.recipes.base import register_recipe, with_resizing


@register_recipe("cricavpr")
def cricavpr(model: ModelConfig, preset: str) -> TrainConfig:
    """Make CricaVPR's recipe: multi-resolution adapters, a GeM pyramid, Adam with step decay.

    Its README trains 10 epochs, fewer than its patience of 10 would ever end. The best weights are
    those of the best R@5, as in its code of today; its first version added R@1.
    """
    adapter = AdapterConfig(kind="multi-resolution")
    backbone = dataclasses.replace(model.backbone, adapter=adapter)
    config = TrainConfig(
        model=with_aggregator(model, "gem-pyramid", preset, backbone=backbone),
        optimiser=OptimiserConfig(
            kind="adam", learning_rate=1e-4, schedule="step", weight_decay=0.0
        ),
        places_per_batch=72,
        epochs=10,
        select_by="R@5",
        patience=10,
    )
    return with_resizing(config, antialias=False, pixels="floats")
