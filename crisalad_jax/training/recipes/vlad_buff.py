"""VLAD-BuFF, as Ahmedest61/VLAD-BuFF trains it (Khaliq et al., ECCV 2024)."""

import dataclasses

from crisalad_jax.nn.aggregators import AGGREGATORS
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.recipes.base import register_recipe
from crisalad_jax.training.recipes.salad import salad


@register_recipe("vlad-buff")
def vlad_buff(model: ModelConfig, preset: str) -> TrainConfig:
    """Make VLAD-BuFF's recipe: SALAD's training of another head.

    The head starts from principal components and centroids of 500 training images. The code takes
    images of London for these; its published weights are those of the last epoch.
    """
    config = salad(model, preset)
    aggregator = AGGREGATORS.make("vlad-buff", preset)
    return dataclasses.replace(
        config, model=dataclasses.replace(config.model, aggregator=aggregator)
    )
