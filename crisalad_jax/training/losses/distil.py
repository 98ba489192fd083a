"""Distillation loss: match a teacher's descriptors, their distances and their neighbours."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import (
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    require,
    require_field,
)
from crisalad_jax.nn.layers import Linear, init_linear, linear
from crisalad_jax.training.losses.base import LOSSES, Loss, LossBatch, LossValue
from crisalad_jax.training.losses.pairwise import MultiSimilarityConfig


@LOSSES.register("distil")
class DistilConfig(Loss):
    """Distillation from a teacher, whose descriptors may be longer than the student's.

    The loss is a sum of four terms, whose weights are `cosine`, `relations`, `neighbours` and
    `labels`; a term of weight 0 is not computed. Only the term `labels` uses the images' places.
    """

    reads_targets: ClassVar[bool] = True
    learning_rate: PositiveFloat = 1e-3
    """Learning rate of the projection to the teacher's descriptor length."""
    teacher_dim: PositiveInt = 8448
    """Dimensions of the teacher's descriptor; `crisalad distil` sets it."""
    cosine: NonNegativeFloat = 1.0
    """Weight of 1 - cosine similarity of the projected descriptor and the teacher's. The projection
    is learnt and is not part of the model."""
    relations: NonNegativeFloat = 1.0
    """Weight of relational distillation (Park et al., CVPR 2019, distance-wise): the Huber loss
    between pairwise distances, each divided by its model's mean distance in the batch."""
    neighbours: NonNegativeFloat = 1.0
    """Weight of the KL divergence between the teacher's and the student's softmax of an image's
    similarities to the rest of the batch (as in Passalis and Tefas, ECCV 2018)."""
    temperature: PositiveFloat = 0.05
    """Temperature of both softmaxes of `neighbours`."""
    labels: NonNegativeFloat = 0.0
    """Weight of the multi-similarity loss, the only term that uses the images' places."""

    def __post_init__(self) -> None:
        """Check that at least one weight is above 0."""
        weights = self.cosine + self.relations + self.neighbours + self.labels
        require_field(self, "cosine", weights > 0, "above 0, or another term's weight")

    def init(self, key: PRNGKeyArray, classes: int, dim: int) -> Linear | None:
        """Draw the projection to the teacher's descriptor length; None if `cosine` is 0."""
        return init_linear(key, dim, self.teacher_dim) if self.cosine else None

    def apply(self, params: Linear | None, batch: LossBatch) -> LossValue:
        """Compute the weighted sum of the terms, which are logged without their weights."""
        shape = len(batch.labels), self.teacher_dim
        assert batch.targets is not None  # `metric_loss` checks it
        found = batch.targets.shape
        require(found == shape, f"targets: found shape {found}, expected {shape}")
        targets = jnp.where(batch.valid[:, None], batch.targets, 0)
        pairs = batch.valid[:, None] & batch.valid & ~jnp.eye(len(targets), dtype=bool)
        teacher = dataclasses.replace(batch, descriptors=targets)
        terms: dict[str, Array] = {}
        if params is not None:
            projected = linear(params, batch.descriptors)
            apart = 1 - _cosines(projected, targets)
            terms["cosine"] = jnp.where(batch.valid, apart, 0).sum() / batch.anchors
        if self.relations:
            off = _relative(batch.distances, pairs) - _relative(teacher.distances, pairs)
            huber = jnp.where(abs(off) < 1, off**2 / 2, abs(off) - 0.5)
            terms["relations"] = _mean(huber, pairs)
        if self.neighbours:
            shares, logs = (
                _log_shares(each.similarities / self.temperature, pairs)
                for each in (teacher, batch)
            )
            divergence = jnp.where(pairs, jnp.exp(shares) * (shares - logs), 0).sum(axis=1)
            terms["neighbours"] = divergence.sum() / batch.anchors
        if self.labels:
            terms["labels"] = MultiSimilarityConfig(base=0.5).apply(None, batch).loss
        weighted = [getattr(self, name) * term for name, term in terms.items()]
        return LossValue(jnp.stack(weighted).sum(), numbers=terms)


def _cosines(a: Float[Array, "image dim"], b: Float[Array, "image dim"]) -> Float[Array, " image"]:
    norms = jnp.sqrt((a**2).sum(axis=1) * (b**2).sum(axis=1) + 1e-12)
    return (a * b).sum(axis=1) / norms


def _mean(x: Float[Array, "image image"], pairs: Array) -> Float[Array, ""]:
    return jnp.where(pairs, x, 0).sum() / jnp.maximum(pairs.sum(), 1)


def _relative(x: Float[Array, "image image"], pairs: Array) -> Float[Array, "image image"]:
    """Divide distances by their mean over the pairs."""
    return x / jnp.maximum(_mean(x, pairs), 1e-6)


def _log_shares(x: Float[Array, "image image"], pairs: Array) -> Float[Array, "image image"]:
    """Compute the logarithm of the softmax over an image's pairs; 0 elsewhere."""
    some = pairs | ~pairs.any(axis=1, keepdims=True)
    return jnp.where(pairs, jax.nn.log_softmax(jnp.where(some, x, -jnp.inf), axis=1), 0)
