"""Triplet loss of Sinkhorn divergences between the local tokens of images."""

import dataclasses
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp

from crisalad_jax.config.checks import PositiveFloat
from crisalad_jax.nn.layers import l2_normalise
from crisalad_jax.nn.transport.divergence import entropic_cost, log_masses
from crisalad_jax.training.losses.base import LOSSES, Loss, LossBatch, LossValue
from crisalad_jax.training.losses.pairwise import MultiSimilarityConfig


@LOSSES.register("sinkhorn-divergence")
class SinkhornDivergenceLoss(MultiSimilarityConfig):
    """Multi-similarity loss of the descriptors plus a triplet loss of the images' local tokens.

    Distances in a triplet are Sinkhorn divergences (Feydy et al., AISTATS 2019) between two images'
    local tokens: unit vectors of equal mass, with squared Euclidean costs. From the pairs that the
    miner chose, an anchor's triplet takes the positive with the least similar descriptor and the
    negative with the most similar (Hermans et al. 2017). The mean divergences to both are logged.
    """

    reads_tokens: ClassVar[Literal["local", "dense"]] = "local"

    weight: PositiveFloat = 1.0
    """Weight of the triplet loss."""
    margin: PositiveFloat = 0.1
    """Divergence by which a positive must be nearer than a negative."""
    epsilon: PositiveFloat = 0.1
    """Entropic regularisation, in units of the costs, which range from 0 to 4."""

    def from_scratch(self) -> Loss:
        """Return the loss with base 0.5, as for the multi-similarity loss."""
        return dataclasses.replace(self, base=0.5)

    def apply(self, params: Any, batch: LossBatch) -> LossValue:
        """Add the weighted mean loss of anchors with a triplet to the multi-similarity loss."""
        assert batch.tokens is not None
        # Images that take no part may be NaN.
        tokens = l2_normalise(jnp.where(batch.valid[:, None, None], batch.tokens, 0))
        sets = tokens, log_masses(tokens).astype(tokens.dtype)

        def cost_to(other: Any) -> Any:
            return entropic_cost(sets, (tokens[other], sets[1]), epsilon=self.epsilon)

        similarities = jax.lax.stop_gradient(batch.similarities)
        positives, negatives = batch.pairs
        positive = jnp.where(positives, -similarities, -jnp.inf).argmax(axis=1)
        negative = jnp.where(negatives, similarities, -jnp.inf).argmax(axis=1)
        own = cost_to(jnp.arange(len(tokens)))
        near, far = (cost_to(other) - (own + own[other]) / 2 for other in (positive, negative))
        used = positives.any(axis=1) & negatives.any(axis=1)

        def mean(each: Any) -> Any:
            return jnp.where(used, each, 0).sum() / jnp.maximum(used.sum(), 1)

        triplets = mean(jax.nn.relu(self.margin + near - far))
        numbers = {"positive_divergence": mean(near), "negative_divergence": mean(far)}
        total = super().apply(None, batch).loss + self.weight * triplets
        return LossValue(total, numbers=numbers)
