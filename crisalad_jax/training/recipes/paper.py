"""CriSALAD as the paper trains it (section 4.2), rows of its Table 2, and `scratch`."""

import dataclasses

from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.recipes.base import from_scratch, register_recipe


@register_recipe("crisalad")
def crisalad(model: ModelConfig, preset: str) -> TrainConfig:
    """Make the recipe of the paper's section 4.2."""
    return TrainConfig(model=model)


@register_recipe("crisalad-1e-4")
def crisalad_1e_4(model: ModelConfig, preset: str) -> TrainConfig:
    """Make the recipe of the row of Table 2 with a higher learning rate, 1e-4."""
    return TrainConfig(
        model=model, optimiser=dataclasses.replace(TrainConfig.optimiser, learning_rate=1e-4)
    )


@register_recipe("crisalad-step")
def crisalad_step(model: ModelConfig, preset: str) -> TrainConfig:
    """Make the recipe of the row of Table 2 with the step schedule."""
    return TrainConfig(
        model=model, optimiser=dataclasses.replace(TrainConfig.optimiser, schedule="step")
    )


@register_recipe("scratch")
def scratch(model: ModelConfig, preset: str) -> TrainConfig:
    """Make our recipe for training a whole model from random weights, the default for `tiny`."""
    return from_scratch(TrainConfig(model=model))
