"""FastAP (Cakir et al., CVPR 2019)."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from crisalad_jax.config.checks import require_positive
from crisalad_jax.losses.base import LOSSES, Loss, LossBatch, LossValue


@LOSSES.register("fast-ap")
@dataclasses.dataclass(frozen=True)
class FastAPConfig(Loss):
    """FastAP (Cakir et al., CVPR 2019), GSV-Cities' number of bins."""

    ranks_all: ClassVar[bool] = True
    bins: int = 30
    """Number of bins of the histogram of squared distances, from 0 to 4."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "bins")

    def apply(self, params: Any, batch: LossBatch) -> LossValue:
        """Compute 1 - average precision from soft histograms of squared distances."""
        bins = self.bins
        squared, width = jnp.maximum(2 - 2 * batch.similarities, 0), 4 / bins
        edges = width * jnp.arange(bins + 1, dtype=squared.dtype)

        def histogram(edge: Float[Array, ""]) -> tuple[Float[Array, " anchor"], ...]:
            pulse = jax.nn.relu(1 - jnp.abs(squared - edge) / width)
            return tuple(jnp.where(chosen, pulse, 0).sum(axis=1) for chosen in batch.pairs)

        positives, negatives = jax.lax.map(histogram, edges)
        hits, retrieved = jnp.cumsum(positives, axis=0), jnp.cumsum(positives + negatives, axis=0)
        some = (positives * hits > 0) & (retrieved > 0)
        precision = jnp.where(some, positives * hits / jnp.where(some, retrieved, 1), 0).sum(axis=0)
        counts = batch.pairs.positives.sum(axis=1)
        missing = jnp.where(counts > 0, 1 - precision / jnp.maximum(counts, 1), 0)
        return LossValue(
            jnp.where(some.any(), missing.sum() / jnp.maximum((counts > 0).sum(), 1), 0.0)
        )
