"""Tokens from the backbone itself: its class token, or learnt tokens that run through it."""

from typing import ClassVar

from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import PositiveInt, require_range
from crisalad_jax.nn import random_init
from crisalad_jax.nn.aggregators.base import (
    AGGREGATORS,
    Aggregator,
    Centroids,
    FeatureRows,
    TokenShape,
)
from crisalad_jax.nn.aggregators.vlad import scores_from_centroids
from crisalad_jax.nn.backbones.base import Backbone, Features, FeatureSpec, Grid
from crisalad_jax.nn.layers import Keys, at_least_float32
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.pytree import pytree_dataclass


@AGGREGATORS.register("class-token")
class ClassTokenConfig(Aggregator):
    """The backbone's class token as the only token (Oquab et al. 2023)."""

    class_token: ClassVar[bool] = True

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of a global token as wide as the backbone."""
        return TokenShape(dim, 0, dim)

    def apply(self, params: None, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Return the class token unchanged."""
        return Tokens.of_global(at_least_float32(features.class_token))


@pytree_dataclass
class AggregationTokens:
    """The parameters: the learnt tokens, as they enter the backbone's blocks."""

    tokens: Float[Array, "token dim"]


@AGGREGATORS.register("aggregation-tokens", tiny={"insertion": -2})
class AggregationTokensConfig(Aggregator):
    """ImAge's learnt tokens, which run through the backbone's last blocks (Lu et al., 2025).

    Example:
        >>> from crisalad_jax import ModelConfig
        >>> part = AggregationTokensConfig(tokens=8)
        >>> ModelConfig(aggregator=part, cross_image="none").descriptor_dim
        6144
    """

    centroid_images: ClassVar[int] = 5000
    tokens: PositiveInt = 8
    """Number of learnt tokens."""
    insertion: int = -4
    """Block before which the learnt tokens are prepended: its index, from the end if negative."""

    def features(self, depth: int) -> FeatureSpec:
        """Request that the learnt tokens run through the blocks from `insertion` on.

        Raises:
            InputError: there is no such block.
        """
        require_range(self, -depth, depth - 1, "insertion")
        return FeatureSpec(insertion=self.insertion % depth)

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of the learnt tokens, as local tokens as wide as the backbone."""
        return TokenShape(0, self.tokens, dim)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> AggregationTokens:
        """Draw tokens with standard deviation 1e-6, as published; see also `from_centroids`."""
        return AggregationTokens(random_init.normal(key, (self.tokens, backbone.dim), scale=1e-6))

    def from_centroids(self, centroids: Centroids, features: FeatureRows) -> AggregationTokens:
        """Make tokens as the authors do: centroids, scaled like NetVLAD's initial score weights."""
        return AggregationTokens(scores_from_centroids(centroids, features).weight.T)

    def inserted(self, params: AggregationTokens) -> Float[Array, "token dim"]:
        """Return the learnt tokens."""
        return params.tokens

    def apply(
        self, params: AggregationTokens, features: Features, grid: Grid, *, key: Keys
    ) -> Tokens:
        """Return the learnt tokens after the last block and layer norm, as local tokens."""
        assert features.inserted is not None
        return Tokens.of_local(at_least_float32(features.inserted))
