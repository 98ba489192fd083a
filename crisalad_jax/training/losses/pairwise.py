"""Losses over the pairs of a batch, with the constants of GSV-Cities."""

from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from crisalad_jax.config.checks import Fraction, PositiveFloat, PositiveInt, limited
from crisalad_jax.training.losses.base import (
    LOSSES,
    Loss,
    LossBatch,
    LossValue,
    log1p_sum_exp,
    log_sum_exp,
    mean_of_positive,
)


@LOSSES.register("multi-similarity")
class MultiSimilarityConfig(Loss):
    """Multi-similarity loss (Wang et al., CVPR 2019) with the constants of GSV-Cities."""

    alpha: PositiveFloat = 1.0
    """Scale of the positives' similarities, the paper's alpha."""
    beta: PositiveFloat = 50.0
    """Scale of the negatives' similarities, the paper's beta."""
    base: float = 0.0
    """Similarity around which pairs are weighted. With random initial weights, 0 fails; use 0.5."""

    def from_scratch(self) -> Loss:
        """Return the default loss with base 0.5: base 0 would drive all similarities to 0."""
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


@LOSSES.register("contrastive")
class ContrastiveConfig(Loss):
    """Contrastive loss (Hadsell et al., CVPR 2006) with the margins of GSV-Cities."""

    positive_margin: Annotated[float, limited(0, 2)] = 0.0
    """Distance up to which a pair of one place costs nothing; unit vectors are at most 2 apart."""
    negative_margin: Annotated[float, limited(0, 2)] = 1.0
    """Distance from which a pair of two places costs nothing."""

    def apply(self, params: Any, batch: LossBatch) -> LossValue:
        """Add the mean violations of the two margins; unlike in the paper, they are not squared."""
        distances = batch.distances
        near = jnp.where(batch.pairs.positives, distances - self.positive_margin, 0)
        far = jnp.where(batch.pairs.negatives, self.negative_margin - distances, 0)
        return LossValue(mean_of_positive(near) + mean_of_positive(far))


@LOSSES.register("triplet")
class TripletConfig(Loss):
    """Triplet margin loss (Schroff et al., CVPR 2015) with the margin of GSV-Cities."""

    margin: PositiveFloat = 0.1
    """Distance by which a positive must be nearer than a negative."""
    average: Literal["violating", "all"] = "violating"
    """Triplets to average over: those that violate the margin, or all (NetVLAD's code)."""

    def apply(self, params: Any, batch: LossBatch) -> LossValue:
        """Average the violations of the margin over triplets, without a cubic array of triplets.

        With an anchor's negatives sorted by distance, those that violate the margin with a positive
        come first, so that their sum is a prefix sum.
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


@LOSSES.register("supcon")
class SupConConfig(Loss):
    """Supervised contrastive loss (Khosla et al., NeurIPS 2020) with GSV-Cities' temperature."""

    temperature: PositiveFloat = 0.07
    """Divisor of the similarities."""

    def apply(self, params: Any, batch: LossBatch) -> LossValue:
        """Compute the cross entropy of positives among their anchor's pairs (the paper's L_out)."""
        logits = batch.similarities / self.temperature
        positives, negatives = batch.pairs
        log_share = logits - log_sum_exp(logits, positives | negatives)[:, None]
        counts = positives.sum(axis=1)
        per_anchor = -jnp.where(positives, log_share, 0).sum(axis=1) / jnp.maximum(counts, 1)
        return LossValue(
            jnp.where(positives.any() & negatives.any(), mean_of_positive(per_anchor), 0.0)
        )


@LOSSES.register("circle")
class CircleConfig(Loss):
    """Circle loss (Sun et al., CVPR 2020) with the constants of GSV-Cities."""

    margin: Fraction = 0.4
    """Relaxation margin, the paper's m."""
    scale: PositiveFloat = 80.0
    """Scale of the similarities, the paper's gamma."""

    def apply(self, params: Any, batch: LossBatch) -> LossValue:
        """Compute the loss, with each similarity weighted by its distance from its optimum."""
        margin, scale = self.margin, self.scale
        fixed = jax.lax.stop_gradient(batch.similarities)
        pull = -scale * jax.nn.relu(1 + margin - fixed) * (batch.similarities - (1 - margin))
        push = scale * jax.nn.relu(fixed + margin) * (batch.similarities - margin)
        exponent = log_sum_exp(pull, batch.pairs.positives) + log_sum_exp(
            push, batch.pairs.negatives
        )
        both = batch.pairs.positives.any(axis=1) & batch.pairs.negatives.any(axis=1)
        return LossValue(mean_of_positive(jnp.where(both, jax.nn.softplus(exponent), 0)))


@LOSSES.register("fast-ap")
class FastAPConfig(Loss):
    """FastAP (Cakir et al., CVPR 2019) with GSV-Cities' number of bins."""

    ranks_all: ClassVar[bool] = True
    bins: PositiveInt = 30
    """Number of bins of the histogram of squared distances, from 0 to 4."""

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


@LOSSES.register("selavpr")
class SelaVprLoss(Loss):
    """SelaVPR's loss (Lu et al., ICLR 2024), with a margin of 0 for local features."""

    of_tuples: ClassVar[bool] = True
    reads_tokens: ClassVar[Literal["local", "dense"]] = "dense"

    margin: PositiveFloat = 0.1
    """Distance by which a positive's descriptor must be nearer than a negative's."""

    def apply(self, params: Any, batch: LossBatch) -> LossValue:
        """Compute the sum of the mean triplet losses of descriptors and of local similarities."""
        assert batch.tokens is not None
        dense = batch.tokens
        positives, negatives = batch.pairs
        # Each image except a query is in a single pair.
        anchor = (positives | negatives).argmax(axis=0)
        similarities = jax.lax.map(
            lambda pair: mutual_similarity(dense[pair[0]], dense[pair[1]]),
            (anchor, jnp.arange(len(dense))),
        )
        of_positive = jnp.where(positives, similarities, 0).sum(axis=1)
        violations = jax.nn.relu(similarities - of_positive[anchor])
        used = negatives.any(axis=0) & positives.any(axis=1)[anchor]
        mean = jnp.where(used, violations, 0).sum() / jnp.maximum(used.sum(), 1)
        triplets = TripletConfig(margin=self.margin, average="all").apply(None, batch)
        return LossValue(triplets.loss + mean)


def mutual_similarity(
    first: Float[Array, "first dim"], second: Float[Array, "second dim"]
) -> Float[Array, ""]:
    """Average the inner products of mutual nearest neighbours; there is always at least one pair.

    Args:
        first: unit features of an image.
        second: unit features of another image.

    Example:
        >>> float(mutual_similarity(jnp.eye(3)[:2], jnp.eye(3)[1:]))
        1.0
    """
    products = jax.lax.stop_gradient(jnp.matmul(first, second.T, precision="highest"))
    nearest = products.argmax(axis=1)
    mutual = products.argmax(axis=0)[nearest] == jnp.arange(len(first))
    return jnp.where(mutual, (first * second[nearest]).sum(axis=1), 0).sum() / mutual.sum()
