"""DINO-Mix, MixVPR over DINOv2, as GaoShuang98/DINO-Mix trains it (Huang et al. 2024)."""

import dataclasses
from typing import Any

from crisalad_jax.nn.adapter import AdapterConfig
from crisalad_jax.nn.aggregators import AGGREGATORS
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.recipes.base import register_recipe, with_resizing
from crisalad_jax.training.recipes.crisalad import without_encoder

MIXVPR_OPTIMISER = OptimiserConfig(
    kind="sgd",
    learning_rate=0.05,
    schedule="milestones",
    milestones=(5, 10, 15, 25, 45),
    step_gamma=0.3,
    warmup_steps=650,
    weight_decay=1e-3,
)
"""That of amaralibey/MixVPR, for 120 places."""


@register_recipe("dino-mix")
def dino_mix(model: ModelConfig, preset: str) -> TrainConfig:
    """Make DINO-Mix's recipe: two mixers over DINOv2, whose last four blocks train.

    The class token and the positions train as well, for its code freezes all else before them.
    Its code validates on Pitts30k's test set, by which it chooses the best weights; here they are
    chosen on `--val`.
    """
    backbone = dataclasses.replace(model.backbone, adapter=AdapterConfig(kind="none"))
    mixers: Any = AGGREGATORS.make("mixvpr", preset)
    config = TrainConfig(
        model=without_encoder(
            model,
            backbone=backbone,
            aggregator=dataclasses.replace(mixers, depth=2, last_norm=False),
            compute_dtype="bfloat16",
        ),
        optimiser=dataclasses.replace(
            MIXVPR_OPTIMISER, learning_rate=0.005, accumulate=4, clip_value=0.5
        ),
        trainable="last-4-blocks+positions+head",
        places_per_batch=80,
        epochs=60,
        select_by="R@1",
        patience=None,
    )
    return with_resizing(config, antialias=False, pixels="floats")
