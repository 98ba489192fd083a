"""Losses on the descriptors of a batch: their interface and their inputs."""

import abc
import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from crisalad_jax.config.checks import require
from crisalad_jax.config.classes import ClassesConfig
from crisalad_jax.config.part import Part
from crisalad_jax.config.registry import Registry, count_arguments
from crisalad_jax.config.short_repr import brief
from crisalad_jax.utils.pytree import expect_like

Similarities = Float[Array, "anchor image"]


@brief
class Pairs(NamedTuple):
    """Masks of the pairs that enter the loss: a row for each anchor, a column for each image."""

    positives: Bool[Array, "anchor image"]
    negatives: Bool[Array, "anchor image"]


@brief
@dataclasses.dataclass(frozen=True)
class LossBatch:
    """The inputs of a loss for one batch."""

    descriptors: Float[Array, "image descriptor"]
    """Unit descriptors, in float32 or higher precision."""
    labels: Int[Array, " image"]
    """Place or class of each image; for mined tuples, its label from `tuple_labels`."""
    valid: Bool[Array, " image"]
    """Whether each image takes part; the others are not in any pair, even as anchors."""
    pairs: Pairs
    """Pairs that the miner chose; without a miner, all pairs."""
    classes: Int[Array, ""] | int | None = None
    """Number of classes, if the loss has a vector for each."""
    tokens: Float[Array, "image token dim"] | None = None
    """Local or dense tokens of the images (`Loss.reads_tokens`); None if the loss reads none."""
    targets: Float[Array, "image target"] | None = None
    """A teacher's unit descriptors of the images, for a loss whose `reads_targets` is True."""

    @functools.cached_property
    def similarities(self) -> Similarities:
        """Inner products of all pairs of descriptors."""
        return inner_products(self.descriptors)

    @functools.cached_property
    def distances(self) -> Similarities:
        """Euclidean distances of all pairs of descriptors, with gradient 0 where two are equal."""
        squared = 2 - 2 * self.similarities
        apart = squared > 0
        return jnp.where(apart, jnp.sqrt(jnp.where(apart, squared, 1)), 0)

    @property
    def anchors(self) -> Int[Array, ""]:
        """Number of valid images, but at least 1, so that it can be a divisor."""
        return jnp.maximum(self.valid.sum(), 1)


@brief
class LossValue(NamedTuple):
    """A loss and its logged values."""

    loss: Float[Array, ""]
    accuracy: Float[Array, ""] | None = None
    """Share of the images whose nearest class is their own, if the loss classifies; else None."""
    numbers: Mapping[str, Any] | None = None
    """Other scalars by name, such as a learnt temperature; each step logs them as `loss.NAME`."""


class Loss(Part, abc.ABC):
    """A loss of a batch: a frozen dataclass whose fields are its constants.

    A subclass has to define only `apply`. A plain function that takes a `LossBatch` and returns a
    scalar can be registered too, as a loss without constants.

    Example:
        >>> from crisalad_jax import LossConfig, metric_loss, register_loss
        >>> @register_loss("positive-distance")
        ... def positive_distance(batch):
        ...     return jnp.where(batch.pairs.positives, 1 - batch.similarities, 0).sum()
        >>> config = LossConfig(kind="positive-distance", miner="none")
        >>> float(metric_loss(jnp.eye(2), jnp.array([0, 0]), config).loss)
        2.0
    """

    ranks_all: ClassVar[bool] = False
    """Whether the loss ranks all images, so that no miner may choose pairs."""

    of_tuples: ClassVar[bool] = False
    """Whether the loss takes only mined tuples, in which the query is the anchor of every pair."""
    learning_rate = 1e-2  # without a type, so that a subclass can make it a field
    """Learning rate of the loss's own parameters, which have their own Adam optimiser."""

    grouping: ClassVar[ClassesConfig | None] = None
    """Grouping of images into classes; None for a loss of pairs of images."""
    reads_tokens: ClassVar[Literal["local", "dense"] | None] = None
    """Field of `Tokens` that the loss compares, in addition to descriptors: "local", the
    aggregator's local tokens, or "dense", local features, which few aggregators provide."""

    reads_targets: ClassVar[bool] = False
    """Whether the loss compares descriptors with a teacher's; images then need no places."""

    def init(self, key: PRNGKeyArray, classes: int, dim: int) -> Any:
        """Return the loss's own trainable parameters, a pytree of arrays; by default None.

        Args:
            key: random key.
            classes: number of classes; 0 for a loss of pairs.
            dim: number of dimensions of a descriptor.
        """
        return None

    def from_scratch(self) -> "Loss":
        """Return the loss with constants for training from random weights; unchanged by default."""
        return self

    def with_grouping(self, grouping: ClassesConfig) -> "Loss":
        """Return the loss with another grouping of images into classes; unchanged by default."""
        return self

    @abc.abstractmethod
    def apply(self, params: Any, batch: LossBatch) -> LossValue:
        """Compute the loss of a batch; `params` are the loss's own parameters (`init`), or None."""


@dataclasses.dataclass(frozen=True)
class GivenLoss(Loss):
    """A plain function that a caller passes instead of a registered loss."""

    part_name: ClassVar[str] = "given"
    function: Callable[..., Any]
    """Takes a `LossBatch`, or (descriptors, labels) or (descriptors, labels, valid)."""

    def apply(self, params: Any, batch: LossBatch) -> LossValue:
        """Call the function, and return its value as a `LossValue`."""
        arrays = batch.descriptors, batch.labels, batch.valid
        count = count_arguments(self.function, "descriptors", "labels", "valid")
        value = self.function(batch) if count == 1 else self.function(*arrays[:count])
        return value if isinstance(value, LossValue) else LossValue(value)


def _of_function(function: Callable[..., Any]) -> Mapping[str, Any]:
    """Return the methods of a loss that is a plain function, as `GivenLoss` takes it."""
    given = GivenLoss(function)
    count_arguments(function, "descriptors", "labels", "valid")
    return {"apply": lambda self, params, batch: given.apply(params, batch)}


def check_value(value: Any, name: str) -> None:
    """Raise InputError, naming the loss, unless it returned float32 or float64 scalars."""
    dtype = getattr(getattr(value, "loss", None), "dtype", None)
    number: Any = jax.ShapeDtypeStruct((), jnp.float64 if dtype == jnp.float64 else jnp.float32)
    has_accuracy = getattr(value, "accuracy", None) is not None
    numbers = getattr(value, "numbers", None)
    expect_like(name, value, LossValue(number, number if has_accuracy else None, numbers))
    for key, each in (numbers or {}).items():
        shape = jnp.shape(each)
        require(shape == (), f"{name}: found number {key!r} of shape {shape}, expected a scalar")


LOSSES = Registry("loss", Loss, of_function=_of_function)


def inner_products(descriptors: Float[Array, "image descriptor"]) -> Similarities:
    """Return the inner products of all pairs of descriptors, in float32 or higher precision."""
    wide = descriptors.astype(jnp.promote_types(descriptors.dtype, jnp.float32))
    return jnp.matmul(wide, wide.T, precision="highest")


def mean_of_positive(losses: Float[Array, "*shape"]) -> Float[Array, ""]:
    """Return the mean over the losses above 0; 0 if there are none."""
    counted = losses > 0
    return jnp.where(counted, losses, 0).sum() / jnp.maximum(counted.sum(), 1)


def log_sum_exp(x: Similarities, where: Bool[Array, "anchor image"]) -> Float[Array, " anchor"]:
    """Compute each row's log-sum-exp over `where`; 0, with a finite gradient, for an empty row."""
    some = where.any(axis=1, keepdims=True)
    # A row without chosen entries sums all of them, to a finite number that is not used.
    chosen = jnp.where(where | ~some, x, -jnp.inf)
    return jnp.where(some[:, 0], jax.nn.logsumexp(chosen, axis=1), 0)


def log1p_sum_exp(x: Similarities, where: Bool[Array, "anchor image"]) -> Float[Array, " anchor"]:
    """Compute log(1 + sum(exp(x))) of each row over `where`, with a stable gradient."""
    chosen = jnp.where(where, x, -jnp.inf)
    # A column of zeros adds the 1 inside the logarithm, and keeps an empty row finite.
    return jax.nn.logsumexp(jnp.pad(chosen, ((0, 0), (0, 1))), axis=1)
