"""SAGE's aggregation (ICLR 2026): soft clusters, without transport, of patches weighted by norm.

Written from facts about the public model; the training code is not published.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import PositiveInt
from crisalad_jax.nn import random_init
from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, FlattenOrder, TokenShape
from crisalad_jax.nn.backbones.base import Backbone, Features, Grid, Patches
from crisalad_jax.nn.layers import (
    Keys,
    TwoLayer,
    at_least_float32,
    init_two_layer,
    l2_normalise,
    powers,
    two_layer,
)
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.pytree import pytree_dataclass


@pytree_dataclass
class Sage:
    """The networks that map features, and those that compute patch weights and an exponent."""

    weighting: TwoLayer
    """Network from the L2 norm of a patch to its weight."""
    token_features: TwoLayer
    cluster_features: TwoLayer
    score: TwoLayer
    power: TwoLayer
    """Network from the clusters' means (each over the features) to the exponent of `powers`."""


@AGGREGATORS.register(
    "sage", tiny={"clusters": 16, "cluster_dim": 32, "token_dim": 64, "hidden": 128}
)
class SageConfig(Aggregator):
    """SAGE's aggregation (ICLR 2026).

    Each cluster is a mean of the patches, weighted by a softmax of their scores, without a dustbin
    or a transport. Then the signed power of each value is added to the value itself. This power is
    discontinuous at 0, so values near 0 are sensitive to rounding.

    Example:
        >>> from crisalad_jax import ModelConfig
        >>> ModelConfig(aggregator="sage", cross_image="none").descriptor_dim
        8448
    """

    class_token: ClassVar[bool] = True
    flatten_order: ClassVar[FlattenOrder] = "dimension-first"
    clusters: PositiveInt = 64
    cluster_dim: PositiveInt = 128
    token_dim: PositiveInt = 256
    """Width of the global token."""
    hidden: PositiveInt = 512
    """Hidden width of the networks that map features."""
    weighting_hidden: PositiveInt = 128
    """Hidden width of the network that weights patches by their norm."""

    def token_shape(self, dim: int) -> TokenShape:
        """Return the tokens' shape, which does not depend on the backbone."""
        return TokenShape(self.token_dim, self.clusters, self.cluster_dim)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> Sage:
        """Draw parameters like torch's default linear layers."""
        keys, dim, hidden = random_init.split(key, 5), backbone.dim, self.hidden
        return Sage(
            weighting=init_two_layer(keys[0], 1, self.weighting_hidden, 1),
            token_features=init_two_layer(keys[1], dim, hidden, self.token_dim),
            cluster_features=init_two_layer(keys[2], dim, hidden, self.cluster_dim),
            score=init_two_layer(keys[3], dim, hidden, self.clusters),
            power=init_two_layer(keys[4], self.clusters, self.clusters // 2, 1),
        )

    def apply(self, params: Sage, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Return the global token and the clusters, each L2-normalised, in at least float32."""
        patches = weighted(params.weighting, features.patches)
        means = pooled(params, patches)
        # An image has one exponent for all features of all clusters.
        means = means + powers(params.power, means, means.mean(axis=-2, keepdims=True))
        global_token = two_layer(params.token_features, features.class_token, 0.0, None)
        clusters = l2_normalise(means.swapaxes(-2, -1))
        return Tokens(l2_normalise(at_least_float32(global_token)), clusters)


def weighted(params: TwoLayer, patches: Patches) -> Patches:
    """Weight each patch by a factor of 1 to 1.5, which a network computes from its L2 norm."""
    length = jnp.linalg.norm(at_least_float32(patches), axis=-1, keepdims=True) + 1e-6
    weights = 1 + 0.5 * jax.nn.sigmoid(two_layer(params, length, 0.0, None))
    return (at_least_float32(patches) * weights).astype(patches.dtype)


def pooled(params: Sage, patches: Patches) -> Float[Array, "*batch feature cluster"]:
    """Compute each cluster's weighted mean of centred features, divided by the patch count."""
    features = at_least_float32(two_layer(params.cluster_features, patches, 0.0, None))
    scores = at_least_float32(two_layer(params.score, patches, 0.0, None))
    features = features - features.mean(axis=(-2, -1), keepdims=True)
    shares = jax.nn.softmax(scores, axis=-2) / scores.shape[-2]
    return jnp.einsum("...nd,...nm->...dm", features, shares)
