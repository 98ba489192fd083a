"""Multi-similarity loss (Wang et al., CVPR 2019)."""

import dataclasses
from typing import Any

from crisalad_jax.config.checks import require_positive
from crisalad_jax.losses.base import LOSSES, Loss, LossBatch, LossValue, log1p_sum_exp


@LOSSES.register("multi-similarity")
@dataclasses.dataclass(frozen=True)
class MultiSimilarityConfig(Loss):
    """Multi-similarity loss (Wang et al., CVPR 2019), the constants of GSV-Cities."""

    alpha: float = 1.0
    beta: float = 50.0
    base: float = 0.0
    """Similarity around which pairs are weighted. From random weights 0.5 learns where 0 fails."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "alpha", "beta")

    def from_scratch(self) -> Loss:
        """Return base 0.5: from random weights base 0 drives all similarities to 0 together."""
        return MultiSimilarityConfig(base=0.5)

    def apply(self, params: Any, batch: LossBatch) -> LossValue:
        """Average the loss over all anchors; those without a mined pair count as 0."""
        alpha, beta = self.alpha, self.beta
        centred = batch.similarities - self.base
        per_anchor = (
            log1p_sum_exp(-alpha * centred, batch.pairs.positives) / alpha
            + log1p_sum_exp(beta * centred, batch.pairs.negatives) / beta
        )
        return LossValue(per_anchor.sum() / batch.anchors)
