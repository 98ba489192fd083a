"""Triplet margin loss (Schroff et al., CVPR 2015)."""

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp

from crisalad_jax.config.checks import require_positive
from crisalad_jax.losses.base import LOSSES, Loss, LossBatch, LossValue


@LOSSES.register("triplet")
@dataclasses.dataclass(frozen=True)
class TripletConfig(Loss):
    """Triplet margin loss (Schroff et al., CVPR 2015), the margin of GSV-Cities."""

    margin: float = 0.1
    """Distance by which a positive must be nearer than a negative."""
    average: Literal["violating", "all"] = "violating"
    """Triplets that the mean is over: those that violate the margin, or all (NetVLAD's code)."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "margin")

    def apply(self, params: Any, batch: LossBatch) -> LossValue:
        """Average the violations of the margin over triplets of distances.

        No cubic array of triplets is made. With an anchor's negatives sorted, those that violate
        the margin with a positive come first, so that their sum is a prefix sum.
        """
        distances = batch.distances
        ordered = jnp.sort(jnp.where(batch.pairs.negatives, distances, jnp.inf), axis=1)
        sums = jnp.cumsum(jnp.where(jnp.isfinite(ordered), ordered, 0), axis=1)
        sums = jnp.pad(sums, ((0, 0), (1, 0)))
        limits = distances + self.margin
        counts = jax.vmap(jnp.searchsorted)(
            jax.lax.stop_gradient(ordered), jax.lax.stop_gradient(limits)
        )
        counts = jnp.where(batch.pairs.positives, counts, 0)
        violations = counts * limits - jnp.take_along_axis(sums, counts, axis=1)
        if self.average == "all":
            negatives = batch.pairs.negatives.sum(axis=1, keepdims=True)
            counts = jnp.where(batch.pairs.positives, negatives, 0)
        return LossValue(violations.sum() / jnp.maximum(counts.sum(), 1))
