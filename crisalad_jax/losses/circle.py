"""Circle loss (Sun et al., CVPR 2020)."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from crisalad_jax.config.checks import require_fraction, require_positive
from crisalad_jax.losses.base import (
    LOSSES,
    Loss,
    LossBatch,
    LossValue,
    log_sum_exp,
    mean_of_positive,
)


@LOSSES.register("circle")
@dataclasses.dataclass(frozen=True)
class CircleConfig(Loss):
    """Circle loss (Sun et al., CVPR 2020), the constants of GSV-Cities."""

    margin: float = 0.4
    """Relaxation margin, the paper's m."""
    scale: float = 80.0
    """Scale of the similarities, the paper's gamma."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "scale")
        require_fraction(self, "margin")

    def apply(self, params: Any, batch: LossBatch) -> LossValue:
        """Weigh each similarity by how far it is from its optimum."""
        margin, scale = self.margin, self.scale
        fixed = jax.lax.stop_gradient(batch.similarities)
        pull = -scale * jax.nn.relu(1 + margin - fixed) * (batch.similarities - (1 - margin))
        push = scale * jax.nn.relu(fixed + margin) * (batch.similarities - margin)
        exponent = log_sum_exp(pull, batch.pairs.positives) + log_sum_exp(
            push, batch.pairs.negatives
        )
        both = batch.pairs.positives.any(axis=1) & batch.pairs.negatives.any(axis=1)
        return LossValue(mean_of_positive(jnp.where(both, jax.nn.softplus(exponent), 0)))
