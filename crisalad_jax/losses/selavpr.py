"""SelaVPR's loss: triplets of descriptors, and of mutual nearest local features (ICLR 2024)."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from crisalad_jax.config.checks import require_positive
from crisalad_jax.losses.base import LOSSES, Loss, LossBatch, LossValue
from crisalad_jax.losses.triplet import TripletConfig


@LOSSES.register("selavpr")
@dataclasses.dataclass(frozen=True)
class SelaVprLoss(Loss):
    """The loss of Lu et al. (ICLR 2024), whose margin of local features is 0."""

    of_tuples: ClassVar[bool] = True
    reads_dense: ClassVar[bool] = True

    margin: float = 0.1
    """Distance by which a positive's descriptor must be nearer than a negative's."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "margin")

    def apply(self, params: Any, batch: LossBatch) -> LossValue:
        """Add the mean of the triplets of descriptors and that of local similarities."""
        assert batch.dense is not None
        dense = batch.dense
        positives, negatives = batch.pairs
        # Each image but a query is in a single pair.
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
    """Average the inner products of the features that are each other's nearest.

    Args:
        first: unit features of an image.
        second: unit features of another.

    Returns:
        The mean; there is always such a pair.

    Example:
        >>> float(mutual_similarity(jnp.eye(3)[:2], jnp.eye(3)[1:]))
        1.0
    """
    products = jax.lax.stop_gradient(jnp.matmul(first, second.T, precision="highest"))
    nearest = products.argmax(axis=1)
    mutual = products.argmax(axis=0)[nearest] == jnp.arange(len(first))
    return jnp.where(mutual, (first * second[nearest]).sum(axis=1), 0).sum() / mutual.sum()
