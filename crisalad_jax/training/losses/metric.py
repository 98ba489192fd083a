"""Compute the loss that a configuration names, over the pairs that its miner chooses."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from crisalad_jax.config.checks import NonNegativeFloat, require, require_field, takes
from crisalad_jax.config.part import OrName
from crisalad_jax.config.registry import part_field, resolve_names
from crisalad_jax.config.short_repr import short_repr
from crisalad_jax.training.losses.base import LOSSES, Loss, LossBatch, Pairs, check_value
from crisalad_jax.training.losses.pairs import all_pairs, mine
from crisalad_jax.training.losses.pairwise import MultiSimilarityConfig


@short_repr("kind")
@dataclasses.dataclass(frozen=True)
class LossConfig:
    """The loss, and the miner that chooses its pairs.

    Example:
        >>> LossConfig(kind="triplet", miner="none").kind.part_name
        'triplet'
    """

    kind: OrName[Loss] = part_field(LOSSES, MultiSimilarityConfig)
    """Registered loss, or its name; by default the paper's multi-similarity loss."""
    miner: Literal["multi-similarity", "none"] = "multi-similarity"
    """Miner of the pairs that enter the loss: the multi-similarity loss's, or none (all pairs)."""
    miner_margin: NonNegativeFloat = 0.1
    """Similarity margin of the miner, epsilon in its paper."""
    pml_compat: bool = False
    """Whether the loss is 0 for a batch with at most one positive and at most one negative pair, as
    in pytorch-metric-learning (except its triplet loss)."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        resolve_names(self)
        fits = not self.kind.ranks_all or self.miner == "none"
        name = self.kind.part_name
        require_field(self, "miner", fits, f"'none' for loss {name}, which ranks all images")


class LossResult(NamedTuple):
    """The loss and its logged values."""

    loss: Float[Array, ""]
    easy_anchor_fraction: Float[Array, ""]
    """Share of the anchors without a mined positive: all their positives are easy."""
    accuracy: Float[Array, ""] | None = None
    """Share of the images whose nearest class is their own; None for losses of pairs."""
    numbers: Mapping[str, Array] | None = None
    """Other scalars of the loss (`LossValue.numbers`)."""


@takes(config=LossConfig)
def metric_loss(
    descriptors: Float[Array, "image descriptor"],
    labels: Int[Array, " image"],
    config: LossConfig = LossConfig(),
    *,
    valid: Bool[Array, " image"] | None = None,
    params: Any = None,
    classes: Int[Array, ""] | int | None = None,
    pairs: Pairs | None = None,
    tokens: Float[Array, "image token dim"] | None = None,
    targets: Float[Array, "image target"] | None = None,
) -> LossResult:
    """Compute the loss `config.kind` over the pairs that `config.miner` chooses.

    No gradient flows through the miner.

    Args:
        descriptors: unit vectors; their inner products are the similarities.
        labels: the place, or class, of each image.
        config: the loss, its miner and their constants.
        valid: images that take part; None means all. The others are in no pairs.
        params: the loss's own trainable parameters (`Loss.init`).
        classes: number of classes, if `params` has a vector for each; further vectors are padding.
        pairs: the valid pairs to choose from, such as those of `tuple_pairs`; None means all.
        tokens: local tokens or features of each image, for a loss that compares them.
        targets: a teacher's unit descriptors of the images, for a loss that compares them.

    Returns:
        The loss and its logged values.

    Raises:
        InputError: shapes do not fit; the loss returns something other than a number; or its
            parameters, tokens, tuples or targets are missing.

    Example:
        >>> import jax.numpy as jnp
        >>> result = metric_loss(jnp.eye(4), jnp.array([0, 0, 1, 1]))
        >>> float(result.easy_anchor_fraction)
        0.0
    """
    require(
        descriptors.ndim == 2 and labels.shape == descriptors.shape[:1],
        f"descriptors, labels: found shapes {descriptors.shape} and {labels.shape}, expected "
        "(image, descriptor) and (image,)",
    )
    kind, name = config.kind, f"loss {config.kind.part_name}"
    init = functools.partial(kind.init, classes=1, dim=descriptors.shape[1])
    learns = params is None and jax.eval_shape(init, jax.random.key(0)) is not None
    found = 0 if tokens is None else tokens.shape[1]
    for lacks, what in (
        (kind.of_tuples and pairs is None, "tuples, expected the pairs of `tuple_pairs`"),
        (
            kind.reads_tokens and not found,
            f"tokens, expected the aggregator's Tokens.{kind.reads_tokens}",
        ),
        (learns, "params, expected those of its init"),
        (kind.reads_targets and targets is None, "targets, expected a teacher's descriptors"),
    ):
        require(not lacks, f"{name}: found no {what}")
    wide = descriptors.astype(jnp.promote_types(descriptors.dtype, jnp.float32))
    if valid is None:
        valid = jnp.ones(len(labels), bool)
    else:  # images that take no part may be NaN
        wide = jnp.where(valid[:, None], wide, 0)
    every = all_pairs(labels, valid=valid) if pairs is None else pairs
    batch = LossBatch(wide, labels, valid, every, classes, tokens, targets)
    similarities = jax.lax.stop_gradient(batch.similarities)
    mined = mine(similarities, every, margin=config.miner_margin)
    chosen = every if config.miner == "none" else mined
    value = kind.apply(params, dataclasses.replace(batch, pairs=chosen))
    check_value(value, name)
    loss = value.loss
    if config.pml_compat:
        few = (chosen.positives.sum() <= 1) & (chosen.negatives.sum() <= 1)
        loss = jnp.where(few, 0.0, loss)
    # NaN similarities violate no margin: without this line the batch would look perfect.
    loss = jnp.where(jnp.isfinite(similarities).all(), loss, jnp.nan)
    # In tuples only queries are anchors.
    anchors = batch.anchors if pairs is None else jnp.maximum(pairs.positives.any(axis=1).sum(), 1)
    # In 64-bit mode JAX divides two integers to a float64.
    easy = 1 - mined.positives.any(axis=1).sum(dtype=wide.dtype) / anchors
    return LossResult(loss, easy, value.accuracy, jax.tree.map(jnp.asarray, value.numbers))
