"""A custom loss: the soft triplet loss, log(1 + exp(distance gap)), of all mined pairs.

python examples/loss.py
crisalad train --plugin examples/loss.py --loss.kind soft-triplet ...
"""

import dataclasses

import jax
import jax.numpy as jnp

import crisalad_jax as cj


@cj.register_loss("soft-triplet")
@dataclasses.dataclass(frozen=True)
class SoftTriplet(cj.Loss):
    """An anchor's farthest positive against its nearest negative (Hermans et al., 2017)."""

    scale: float = 10.0

    def apply(self, params, batch):
        """Return the mean over anchors that have a positive and a negative."""
        positives, negatives = batch.pairs
        farthest = jnp.where(positives, batch.similarities, jnp.inf).min(axis=1)
        nearest = jnp.where(negatives, batch.similarities, -jnp.inf).max(axis=1)
        counted = positives.any(axis=1) & negatives.any(axis=1)
        # Where nothing is counted, the gap is finite, so that the gradient is finite.
        gap = jnp.where(counted, nearest, 0) - jnp.where(counted, farthest, 0)
        losses = jnp.where(counted, jax.nn.softplus(self.scale * gap), 0)
        return cj.LossValue(losses.sum() / jnp.maximum(counted.sum(), 1))


def main():
    """Minimise the loss of four descriptors of two places by gradient descent."""
    config = cj.LossConfig(kind="soft-triplet", miner="none")
    labels = jnp.array([0, 0, 1, 1])
    points = jax.random.normal(jax.random.key(0), (4, 3))

    def loss(points):
        units = points / jnp.linalg.norm(points, axis=1, keepdims=True)
        return cj.metric_loss(units, labels, config).loss

    losses = []
    for _ in range(10):
        value, gradient = jax.value_and_grad(loss)(points)
        losses.append(float(value))
        points -= 0.02 * gradient
    print("losses:", ", ".join(f"{each:.3f}" for each in losses))
    return losses


if __name__ == "__main__":
    main()
