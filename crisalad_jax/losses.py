"""Multi-similarity loss with online mining (Wang et al., CVPR 2019), as used with GSV-Cities."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from crisalad_jax.config import MultiSimilarityConfig


class MinedPairs(NamedTuple):
    """Which pairs (anchor, other) enter the loss."""

    positives: Bool[Array, "anchor image"]
    negatives: Bool[Array, "anchor image"]


class LossResult(NamedTuple):
    """The loss and what is logged beside it."""

    loss: Float[Array, ""]
    b_acc: Float[Array, ""]
    """Share of the anchors without a mined positive: those whose positives are all easy."""


def mine(
    similarities: Float[Array, "anchor image"],
    labels: Int[Array, " image"],
    *,
    epsilon: float,
    valid: Bool[Array, " image"] | None = None,
) -> MinedPairs:
    """Pairs that violate the order within their row by less than `epsilon` of margin.

    A positive is kept if it is less similar than the hardest negative plus epsilon, a negative if
    it is more similar than the hardest positive minus epsilon, strictly. An anchor without
    positives or without negatives mines nothing. Images that are not `valid` are in no pair.
    """
    same = labels[:, None] == labels[None, :]
    usable = jnp.ones_like(same) if valid is None else valid[:, None] & valid[None, :]
    positives = same & usable & ~jnp.eye(len(labels), dtype=bool)
    negatives = ~same & usable
    hardest_negative = jnp.where(negatives, similarities, -jnp.inf).max(axis=1, keepdims=True)
    hardest_positive = jnp.where(positives, similarities, jnp.inf).min(axis=1, keepdims=True)
    return MinedPairs(
        positives & (similarities - epsilon < hardest_negative),
        negatives & (similarities + epsilon > hardest_positive),
    )


def multi_similarity_loss(
    descriptors: Float[Array, "image descriptor"],
    labels: Int[Array, " image"],
    config: MultiSimilarityConfig,
    *,
    valid: Bool[Array, " image"] | None = None,
) -> LossResult:
    """Mean over the anchors of the multi-similarity loss of their mined pairs.

    Anchors without a mined pair count as zeros in the mean. The miner passes no gradient.

    Args:
        descriptors: unit vectors; their inner products are the similarities.
        labels: the place of each image.
        config: constants.
        valid: images that take part; None means all. The others are neither anchors nor pairs.
    """
    wide = descriptors.astype(jnp.promote_types(descriptors.dtype, jnp.float32))
    similarities = jnp.matmul(wide, wide.T, precision="highest")
    pairs = mine(jax.lax.stop_gradient(similarities), labels, epsilon=config.epsilon, valid=valid)
    centred = similarities - config.base
    per_anchor = (
        _log1p_sum_exp(-config.alpha * centred, pairs.positives) / config.alpha
        + _log1p_sum_exp(config.beta * centred, pairs.negatives) / config.beta
    )
    anchors = len(labels) if valid is None else jnp.maximum(valid.sum(), 1)
    loss = per_anchor.sum() / anchors
    if config.library_quirk:
        few = (pairs.positives.sum() <= 1) & (pairs.negatives.sum() <= 1)
        loss = jnp.where(few, 0.0, loss)
    # A NaN compares as no pair at all: without this line it would look like a perfect batch.
    loss = jnp.where(jnp.isfinite(similarities).all(), loss, jnp.nan)
    b_acc = 1 - pairs.positives.any(axis=1).sum() / anchors
    return LossResult(loss, b_acc)


def _log1p_sum_exp(
    x: Float[Array, "anchor image"], where: Bool[Array, "anchor image"]
) -> Float[Array, " anchor"]:
    """log(1 + sum of exp(x) over the chosen), 0 where none is chosen; stable, also its gradient."""
    chosen = jnp.where(where, x, -jnp.inf)
    # A column of zeros is the 1 inside the logarithm, and keeps an empty row finite.
    return jax.nn.logsumexp(jnp.pad(chosen, ((0, 0), (0, 1))), axis=1)
