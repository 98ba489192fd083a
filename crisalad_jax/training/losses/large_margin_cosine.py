"""Large-margin cosine loss over classes (CosFace, Wang et al., CVPR 2018), as in CosPlace."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import Fraction, PositiveFloat
from crisalad_jax.config.classes import ClassesConfig
from crisalad_jax.training.losses.base import LOSSES, Loss, LossBatch, LossValue


@LOSSES.register("large-margin-cosine")
class LargeMarginCosineConfig(Loss):
    """Large-margin cosine loss (CosFace, Wang et al., CVPR 2018), one group of classes per epoch.

    The constants are CosPlace's (Berton et al., CVPR 2022); see docs/methods.md.
    """

    scale: PositiveFloat = 30.0
    """Factor of the cosines; EigenPlaces' is 100."""
    margin: Fraction = 0.4
    """Margin subtracted from the cosine of an image's own class."""
    learning_rate: PositiveFloat = 0.01
    """Constant learning rate of the class vectors, whose own Adam optimiser has no weight decay."""
    classes: ClassesConfig = ClassesConfig()
    """Grouping of images into classes."""

    @property
    def grouping(self) -> ClassesConfig:
        """Grouping of images into classes, by position, heading or place."""
        return self.classes

    def with_grouping(self, grouping: ClassesConfig) -> Loss:
        """Return the loss with another grouping of images into classes."""
        return dataclasses.replace(self, classes=grouping)

    def init(self, key: PRNGKeyArray, classes: int, dim: int) -> Float[Array, "class dim"]:
        """Draw a vector for each class (uniform, Glorot and Bengio 2010, as in CosPlace)."""
        bound = jnp.sqrt(6 / (jnp.asarray(classes, jnp.float32) + dim))
        return bound * jax.random.uniform(key, (classes, dim), jnp.float32, -1, 1)

    def apply(self, params: Any, batch: LossBatch) -> LossValue:
        """Compute the cross entropy of cosines to class vectors (CosFace, equation 4).

        The margin is subtracted from the cosine of an image and its own class, then all cosines are
        multiplied by the scale. The loss is the mean over the valid images; the accuracy is the
        share of them whose nearest class is their own. All vectors are first scaled to length 1.

        Args:
            params: a row for each class; rows beyond `batch.classes` are padding.
            batch: a batch whose labels are classes.
        """
        directions, centres = _directions(batch.descriptors), _directions(params)
        cosines = jnp.matmul(directions, centres.T, precision="highest")
        numbers = jnp.arange(len(params))
        if batch.classes is not None:
            cosines = jnp.where(numbers < batch.classes, cosines, -jnp.inf)
        own = batch.labels[:, None] == numbers
        logits = self.scale * jnp.where(own, cosines - self.margin, cosines)
        log_share = jnp.where(own, jax.nn.log_softmax(logits, axis=1), 0).sum(axis=1)
        loss = -jnp.where(batch.valid, log_share, 0).sum() / batch.anchors
        right = batch.valid & (cosines.argmax(axis=1) == batch.labels)
        return LossValue(loss, right.sum(dtype=loss.dtype) / batch.anchors)


def _directions(x: Float[Array, "row column"]) -> Float[Array, "row column"]:
    """Scale rows to unit length, in float32 at least, with a finite gradient where a row is 0."""
    wide = x.astype(jnp.promote_types(x.dtype, jnp.float32))
    squares = jnp.square(wide).sum(axis=1, keepdims=True)
    return wide * jax.lax.rsqrt(jnp.maximum(squares, 1e-24))
