"""Contrastive loss (Hadsell et al., CVPR 2006)."""

import dataclasses
from typing import Any

import jax.numpy as jnp

from crisalad_jax.config.checks import require
from crisalad_jax.losses.base import LOSSES, Loss, LossBatch, LossValue, mean_of_positive


@LOSSES.register("contrastive")
@dataclasses.dataclass(frozen=True)
class ContrastiveConfig(Loss):
    """Contrastive loss (Hadsell et al., CVPR 2006), the margins of GSV-Cities."""

    positive_margin: float = 0.0
    """Distance up to which a pair of one place costs nothing; unit vectors are at most 2 apart."""
    negative_margin: float = 1.0
    """Distance from which a pair of two places costs nothing."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in ("positive_margin", "negative_margin"):
            value = getattr(self, name)
            require(0 <= value <= 2, f"ContrastiveConfig.{name}: found {value}, expected 0 to 2")

    def apply(self, params: Any, batch: LossBatch) -> LossValue:
        """Average the violations of each margin, without the squares of the paper."""
        distances = batch.distances
        near = jnp.where(batch.pairs.positives, distances - self.positive_margin, 0)
        far = jnp.where(batch.pairs.negatives, self.negative_margin - distances, 0)
        return LossValue(mean_of_positive(near) + mean_of_positive(far))
