"""Losses on the descriptors of a batch, and the miner that chooses which pairs enter them.

Each is equal to pytorch-metric-learning's of the same name on unit descriptors.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from crisalad_jax.config import LossConfig, choose

Similarities = Float[Array, "anchor image"]


class Pairs(NamedTuple):
    """Which pairs (anchor, other) enter the loss."""

    positives: Bool[Array, "anchor image"]
    negatives: Bool[Array, "anchor image"]


class LossResult(NamedTuple):
    """The loss and what is logged beside it."""

    loss: Float[Array, ""]
    b_acc: Float[Array, ""]
    """Share of the anchors without a mined positive: those whose positives are all easy. Of a
    classification its accuracy: the share of the images that are nearest to their class."""


def all_pairs(labels: Int[Array, " image"], *, valid: Bool[Array, " image"] | None = None) -> Pairs:
    """All pairs of two images of one place, and of two places; none of images not `valid`."""
    same = labels[:, None] == labels[None, :]
    usable = jnp.ones_like(same) if valid is None else valid[:, None] & valid[None, :]
    return Pairs(same & usable & ~jnp.eye(len(labels), dtype=bool), ~same & usable)


def mine(similarities: Similarities, pairs: Pairs, *, epsilon: float) -> Pairs:
    """Pairs that violate the order within their row by less than `epsilon` of margin.

    The miner of the multi-similarity loss (Wang et al., CVPR 2019). A positive is kept if it is
    less similar than the hardest negative plus epsilon, a negative if it is more similar than the
    hardest positive minus epsilon, strictly. An anchor without positives or without negatives mines
    nothing.
    """
    positives, negatives = pairs
    hardest_negative = jnp.where(negatives, similarities, -jnp.inf).max(axis=1, keepdims=True)
    hardest_positive = jnp.where(positives, similarities, jnp.inf).min(axis=1, keepdims=True)
    return Pairs(
        positives & (similarities - epsilon < hardest_negative),
        negatives & (similarities + epsilon > hardest_positive),
    )


def metric_loss(
    descriptors: Float[Array, "image descriptor"],
    labels: Int[Array, " image"],
    config: LossConfig,
    *,
    valid: Bool[Array, " image"] | None = None,
) -> LossResult:
    """The loss that `config.kind` names, of the pairs that `config.miner` chooses.

    The miner passes no gradient.

    Args:
        descriptors: unit vectors; their inner products are the similarities.
        labels: the place of each image.
        config: which loss and miner, and their constants.
        valid: images that take part; None means all. The others are neither anchors nor pairs.

    Raises:
        InputError: while tracing, an unknown loss.
    """
    wide = descriptors.astype(jnp.promote_types(descriptors.dtype, jnp.float32))
    similarities = jnp.matmul(wide, wide.T, precision="highest")
    every = all_pairs(labels, valid=valid)
    mined = mine(jax.lax.stop_gradient(similarities), every, epsilon=config.epsilon)
    pairs = every if config.miner == "none" else mined
    anchors = jnp.asarray(len(labels)) if valid is None else jnp.maximum(valid.sum(), 1)
    loss = choose("LossConfig.kind", config.kind, _LOSSES)(similarities, pairs, anchors, config)
    if config.library_quirk:
        few = (pairs.positives.sum() <= 1) & (pairs.negatives.sum() <= 1)
        loss = jnp.where(few, 0.0, loss)
    # A NaN compares as no pair at all: without this line it would look like a perfect batch.
    loss = jnp.where(jnp.isfinite(similarities).all(), loss, jnp.nan)
    b_acc = 1 - mined.positives.any(axis=1).sum() / anchors
    return LossResult(loss, b_acc)


def large_margin_cosine_loss(
    descriptors: Float[Array, "image descriptor"],
    labels: Int[Array, " image"],
    weights: Float[Array, "class descriptor"],
    *,
    scale: float,
    margin: float,
    valid: Bool[Array, " image"] | None = None,
    classes: Int[Array, ""] | int | None = None,
) -> LossResult:
    """CosFace (Wang et al., CVPR 2018, equation 4): cross entropy of cosines to classes' vectors.

    The cosine of an image and its own class is made smaller by `margin`, then all are multiplied by
    `scale`. The mean is over the valid images.

    Args:
        descriptors: of any length; their directions count.
        labels: the class of each image.
        weights: a vector for each class, of any length.
        scale: the paper's s.
        margin: the paper's m.
        valid: images that take part; None means all.
        classes: so many of the weights, the first, are classes; None means all.
    """
    directions, centres = _directions(descriptors), _directions(weights)
    cosines = jnp.matmul(directions, centres.T, precision="highest")
    if classes is not None:
        cosines = jnp.where(jnp.arange(len(weights)) < classes, cosines, -jnp.inf)
    own = labels[:, None] == jnp.arange(len(weights))
    logits = scale * jnp.where(own, cosines - margin, cosines)
    log_share = jnp.where(own, jax.nn.log_softmax(logits, axis=1), 0).sum(axis=1)
    counted = jnp.ones(len(labels), bool) if valid is None else valid
    images = jnp.maximum(counted.sum(), 1)
    loss = -jnp.where(counted, log_share, 0).sum() / images
    right = counted & (cosines.argmax(axis=1) == labels)
    return LossResult(loss, right.sum() / images)


def _directions(x: Float[Array, "row column"]) -> Float[Array, "row column"]:
    """Unit vectors, in float32 at least; with a finite gradient where a row is 0."""
    wide = x.astype(jnp.promote_types(x.dtype, jnp.float32))
    squares = jnp.square(wide).sum(axis=1, keepdims=True)
    return wide * jax.lax.rsqrt(jnp.maximum(squares, 1e-24))


def _multi_similarity(
    similarities: Similarities, pairs: Pairs, anchors: Int[Array, ""], config: LossConfig
) -> Float[Array, ""]:
    """Wang et al., CVPR 2019: anchors without a mined pair count as zeros in the mean."""
    constants = config.multi_similarity
    alpha, beta = constants.alpha, constants.beta
    centred = similarities - constants.base
    per_anchor = (
        _log1p_sum_exp(-alpha * centred, pairs.positives) / alpha
        + _log1p_sum_exp(beta * centred, pairs.negatives) / beta
    )
    return per_anchor.sum() / anchors


def _contrastive(
    similarities: Similarities, pairs: Pairs, anchors: Int[Array, ""], config: LossConfig
) -> Float[Array, ""]:
    """Hadsell et al., CVPR 2006, without its squares: the means of what violates each margin."""
    distances = _distances(similarities)
    near = jnp.where(pairs.positives, distances - config.contrastive.positive_margin, 0)
    far = jnp.where(pairs.negatives, config.contrastive.negative_margin - distances, 0)
    return _mean_of_positive(near) + _mean_of_positive(far)


def _triplet(
    similarities: Similarities, pairs: Pairs, anchors: Int[Array, ""], config: LossConfig
) -> Float[Array, ""]:
    """Schroff et al., CVPR 2015, on distances: the mean of all triplets that violate the margin.

    Without a cube of all triplets: with an anchor's negatives sorted, those that a positive
    violates come first, and their sum is that of a prefix.
    """
    distances = _distances(similarities)
    ordered = jnp.sort(jnp.where(pairs.negatives, distances, jnp.inf), axis=1)
    sums = jnp.cumsum(jnp.where(jnp.isfinite(ordered), ordered, 0), axis=1)
    sums = jnp.pad(sums, ((0, 0), (1, 0)))
    limits = distances + config.triplet.margin
    counts = jax.vmap(jnp.searchsorted)(
        jax.lax.stop_gradient(ordered), jax.lax.stop_gradient(limits)
    )
    counts = jnp.where(pairs.positives, counts, 0)
    violations = counts * limits - jnp.take_along_axis(sums, counts, axis=1)
    return violations.sum() / jnp.maximum(counts.sum(), 1)


def _circle(
    similarities: Similarities, pairs: Pairs, anchors: Int[Array, ""], config: LossConfig
) -> Float[Array, ""]:
    """Sun et al., CVPR 2020: each similarity is weighed by how far it is from its optimum."""
    margin, scale = config.circle.margin, config.circle.scale
    fixed = jax.lax.stop_gradient(similarities)
    pull = -scale * jax.nn.relu(1 + margin - fixed) * (similarities - (1 - margin))
    push = scale * jax.nn.relu(fixed + margin) * (similarities - margin)
    exponent = _log_sum_exp(pull, pairs.positives) + _log_sum_exp(push, pairs.negatives)
    both = pairs.positives.any(axis=1) & pairs.negatives.any(axis=1)
    return _mean_of_positive(jnp.where(both, jax.nn.softplus(exponent), 0))


def _supcon(
    similarities: Similarities, pairs: Pairs, anchors: Int[Array, ""], config: LossConfig
) -> Float[Array, ""]:
    """Khosla et al., NeurIPS 2020 (their L_out): cross entropy of each positive among all pairs."""
    logits = similarities / config.supcon.temperature
    positives, negatives = pairs
    log_share = logits - _log_sum_exp(logits, positives | negatives)[:, None]
    counts = positives.sum(axis=1)
    per_anchor = -jnp.where(positives, log_share, 0).sum(axis=1) / jnp.maximum(counts, 1)
    return jnp.where(positives.any() & negatives.any(), _mean_of_positive(per_anchor), 0.0)


def _fast_ap(
    similarities: Similarities, pairs: Pairs, anchors: Int[Array, ""], config: LossConfig
) -> Float[Array, ""]:
    """Cakir et al., CVPR 2019: 1 - average precision, from soft histograms of squared distances."""
    bins = config.fast_ap.bins
    squared, width = jnp.maximum(2 - 2 * similarities, 0), 4 / bins
    edges = width * jnp.arange(bins + 1, dtype=squared.dtype)

    def histogram(edge: Float[Array, ""]) -> tuple[Float[Array, " anchor"], ...]:
        pulse = jax.nn.relu(1 - jnp.abs(squared - edge) / width)
        return tuple(jnp.where(chosen, pulse, 0).sum(axis=1) for chosen in pairs)

    positives, negatives = jax.lax.map(histogram, edges)
    found, all_found = jnp.cumsum(positives, axis=0), jnp.cumsum(positives + negatives, axis=0)
    some = (positives * found > 0) & (all_found > 0)
    precision = jnp.where(some, positives * found / jnp.where(some, all_found, 1), 0).sum(axis=0)
    counts = pairs.positives.sum(axis=1)
    missing = jnp.where(counts > 0, 1 - precision / jnp.maximum(counts, 1), 0)
    return jnp.where(some.any(), missing.sum() / jnp.maximum((counts > 0).sum(), 1), 0.0)


_Loss = Callable[[Similarities, Pairs, Int[Array, ""], LossConfig], Float[Array, ""]]
_LOSSES: Mapping[str, _Loss] = {
    "multi-similarity": _multi_similarity,
    "contrastive": _contrastive,
    "triplet": _triplet,
    "circle": _circle,
    "supcon": _supcon,
    "fast-ap": _fast_ap,
}


def _distances(similarities: Similarities) -> Similarities:
    """Euclidean, of unit vectors; with gradient 0 where two are the same."""
    squared = 2 - 2 * similarities
    apart = squared > 0
    return jnp.where(apart, jnp.sqrt(jnp.where(apart, squared, 1)), 0)


def _mean_of_positive(losses: Float[Array, "*shape"]) -> Float[Array, ""]:
    """Mean over the losses above 0; 0 where there is none."""
    counted = losses > 0
    return jnp.where(counted, losses, 0).sum() / jnp.maximum(counted.sum(), 1)


def _log_sum_exp(x: Similarities, where: Bool[Array, "anchor image"]) -> Float[Array, " anchor"]:
    """log of the sum of exp(x) over the chosen; 0, with a finite gradient, where none is."""
    some = where.any(axis=1, keepdims=True)
    # Where none is chosen all are summed, to a finite number that is not used.
    chosen = jnp.where(where | ~some, x, -jnp.inf)
    return jnp.where(some[:, 0], jax.nn.logsumexp(chosen, axis=1), 0)


def _log1p_sum_exp(x: Similarities, where: Bool[Array, "anchor image"]) -> Float[Array, " anchor"]:
    """log(1 + sum of exp(x) over the chosen), 0 where none is chosen; stable, also its gradient."""
    chosen = jnp.where(where, x, -jnp.inf)
    # A column of zeros is the 1 inside the logarithm, and keeps an empty row finite.
    return jax.nn.logsumexp(jnp.pad(chosen, ((0, 0), (0, 1))), axis=1)
