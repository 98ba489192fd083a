"""Large-margin cosine loss over classes (CosFace, Wang et al., CVPR 2018), as CosPlace trains."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from crisalad_jax.config.checks import require_fraction, require_positive
from crisalad_jax.config.classes import ClassesConfig
from crisalad_jax.training.losses.base import LOSSES, Loss, LossBatch, LossValue


@LOSSES.register("large-margin-cosine")
@dataclasses.dataclass(frozen=True)
class LargeMarginCosineConfig(Loss):
    """Large-margin cosine loss (CosFace, Wang et al., CVPR 2018) over groups of classes.

    The constants are CosPlace's (Berton et al., CVPR 2022); see docs/methods.md.
    """

    scale: float = 30.0
    """Factor of the cosines; EigenPlaces' is 100."""
    margin: float = 0.4
    """Margin subtracted from the cosine of an image's own class."""
    learning_rate: float = 0.01
    """Learning rate of the classifiers, which train by an Adam of their own, without decay."""
    classes: ClassesConfig = ClassesConfig()
    """Grouping of images into classes."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "scale", "learning_rate")
        require_fraction(self, "margin")

    @property
    def grouping(self) -> ClassesConfig:
        """Grouping of images into classes, by position, heading or place."""
        return self.classes

    def with_grouping(self, grouping: ClassesConfig) -> Loss:
        """Return the loss over other classes."""
        return dataclasses.replace(self, classes=grouping)

    def init(self, key: PRNGKeyArray, classes: int, dim: int) -> Float[Array, "class dim"]:
        """Draw vectors for the classes (Glorot and Bengio 2010, uniform, as CosPlace's)."""
        bound = jnp.sqrt(6 / (jnp.asarray(classes, jnp.float32) + dim))
        return bound * jax.random.uniform(key, (classes, dim), jnp.float32, -1, 1)

    def apply(self, params: Any, batch: LossBatch) -> LossValue:
        """Return the cross entropy, and the share of images whose nearest class is their own."""
        return large_margin_cosine_loss(
            batch.descriptors,
            batch.labels,
            params,
            scale=self.scale,
            margin=self.margin,
            valid=batch.valid,
            classes=batch.classes,
        )


def large_margin_cosine_loss(
    descriptors: Float[Array, "image descriptor"],
    labels: Int[Array, " image"],
    weights: Float[Array, "class descriptor"],
    *,
    scale: float,
    margin: float,
    valid: Bool[Array, " image"] | None = None,
    classes: Int[Array, ""] | int | None = None,
) -> LossValue:
    """Compute the cross entropy of cosines to classes' vectors (CosFace, equation 4).

    `margin` is subtracted from the cosine of an image and its own class, then all cosines are
    multiplied by `scale`. The mean is over the valid images.

    Args:
        descriptors: of any length; their directions count.
        labels: the class of each image.
        weights: a vector for each class, of any length.
        scale: the paper's s.
        margin: the paper's m.
        valid: images that take part; None means all.
        classes: number of leading weights that are classes; None means all.

    Returns:
        The loss and the accuracy.

    Example:
        >>> import jax.numpy as jnp
        >>> value = large_margin_cosine_loss(
        ...     jnp.eye(2), jnp.array([0, 1]), jnp.eye(2), scale=30.0, margin=0.4
        ... )
        >>> float(value.accuracy)
        1.0
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
    return LossValue(loss, right.sum(dtype=loss.dtype) / images)


def _directions(x: Float[Array, "row column"]) -> Float[Array, "row column"]:
    """Scale rows to unit length, in float32 at least, with a finite gradient where a row is 0."""
    wide = x.astype(jnp.promote_types(x.dtype, jnp.float32))
    squares = jnp.square(wide).sum(axis=1, keepdims=True)
    return wide * jax.lax.rsqrt(jnp.maximum(squares, 1e-24))
