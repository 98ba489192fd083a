"""The recipe for adaptation: a few small steps on the images of one map."""

from crisalad_jax.data.augmentations.light import LightAugmentConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import OptimiserConfig, TrainConfig, has_adapters
from crisalad_jax.training.recipes.base import register_recipe
from crisalad_jax.training.trainable import ADAPTERS_AND_HEAD, HEAD

CHANGES = LightAugmentConfig(
    crop=0.3, shift=0.1, rotation=5, blur=1.5, colour=0.4, gamma=0.4, illumination=0.6
)
"""Augmentation that simulates another day: a map's images show each place in one light only."""


@register_recipe("adapt")
def adapt(model: ModelConfig, preset: str) -> TrainConfig:
    """Make the recipe of `crisalad adapt`: batches of two views of each of 32 places.

    The adapters and the head train, or only the head if the model has no adapters.
    """
    return TrainConfig(
        model=model,
        trainable=ADAPTERS_AND_HEAD if has_adapters(model) else HEAD,
        augmentation=CHANGES,
        batch_norm="stored",
        optimiser=OptimiserConfig(learning_rate=1e-4, schedule="constant"),
        places_per_batch=32,
        images_per_place=2,
        min_images=2,
        epochs=10,
        monitor="R@1",
        patience=3,
    )
