"""Supervised contrastive loss (Khosla et al., NeurIPS 2020)."""

import dataclasses
from typing import Any

import jax.numpy as jnp

from crisalad_jax.config.checks import require_positive
from crisalad_jax.losses.base import (
    LOSSES,
    Loss,
    LossBatch,
    LossValue,
    log_sum_exp,
    mean_of_positive,
)


@LOSSES.register("supcon")
@dataclasses.dataclass(frozen=True)
class SupConConfig(Loss):
    """Supervised contrastive loss (Khosla et al., NeurIPS 2020), GSV-Cities' temperature."""

    temperature: float = 0.07

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "temperature")

    def apply(self, params: Any, batch: LossBatch) -> LossValue:
        """Compute the cross entropy of each positive among all pairs (L_out of the paper)."""
        logits = batch.similarities / self.temperature
        positives, negatives = batch.pairs
        log_share = logits - log_sum_exp(logits, positives | negatives)[:, None]
        counts = positives.sum(axis=1)
        per_anchor = -jnp.where(positives, log_share, 0).sum(axis=1) / jnp.maximum(counts, 1)
        return LossValue(
            jnp.where(positives.any() & negatives.any(), mean_of_positive(per_anchor), 0.0)
        )
