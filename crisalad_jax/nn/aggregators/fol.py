"""FoL: SALAD whose dustbin is the class token's attention (Wang et al., AAAI 2025).

Written from the paper, with the constants of the public model.
"""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import require_fraction, require_positive
from crisalad_jax.config.part import non_semantic_field
from crisalad_jax.nn import draw
from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, TokenShape
from crisalad_jax.nn.aggregators.salad import (
    TwoLayer,
    init_two_layer,
    require_more_patches,
    transported_tokens,
    two_layer,
)
from crisalad_jax.nn.aggregators.selavpr import init_upconv
from crisalad_jax.nn.backbones.base import Backbone, FeatureRequest, Features
from crisalad_jax.nn.layers import Conv, Keys, at_least_float32, split_key
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.sinkhorn import SinkhornConfig, SinkhornResult, assign_with_dustbin
from crisalad_jax.utils.pytree import pytree_dataclass

LEAST_ATTENTION = 0.01
"""Attention below which a patch counts as one that the class token does not see, as published."""


@pytree_dataclass
class Fol:
    """SALAD's three networks, and two transposed convolutions of 3 x 3 for local features."""

    token_features: TwoLayer
    cluster_features: TwoLayer
    score: TwoLayer
    upconv1: Conv
    """Part of the public files, as `upconv2`; no descriptor needs it."""
    upconv2: Conv


@AGGREGATORS.register(
    "fol",
    tiny={
        "clusters": 16,
        "cluster_dim": 32,
        "token_dim": 64,
        "hidden": 128,
        "dropout": 0.0,
        "local_hidden": 32,
        "local": 16,
    },
)
@dataclasses.dataclass(frozen=True)
class FolConfig(Aggregator):
    """FoL's global descriptor (Wang et al., AAAI 2025).

    Example:
        >>> from crisalad_jax import CrossImageConfig, ModelConfig
        >>> alone = CrossImageConfig(layers=0)
        >>> ModelConfig(aggregator="fol", cross_image=alone).descriptor_dim
        8448
    """

    dimension_first: ClassVar[bool] = True
    width_field: ClassVar[str] = "cluster_dim"
    clusters: int = 64
    cluster_dim: int = 128
    token_dim: int = 256
    """Width of the global token."""
    hidden: int = 512
    dropout: float = non_semantic_field(0.3)
    local_hidden: int = 256
    """Number of channels between the transposed convolutions."""
    local: int = 128
    """Width of a local feature."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(
            self, "clusters", "cluster_dim", "token_dim", "hidden", "local_hidden", "local"
        )
        require_fraction(self, "dropout")

    def features(self, depth: int) -> FeatureRequest:
        """Request the last patches, the class token and its attention."""
        return FeatureRequest(class_token=True, class_attention=True)

    def token_shape(self, dim: int) -> TokenShape:
        """Return the tokens' shape, which does not depend on the backbone."""
        return TokenShape(self.token_dim, self.clusters, self.cluster_dim)

    def check_grid(self, grid: tuple[int, int], patch_size: int) -> None:
        """Require more patches than clusters: the dustbin's mass is the difference."""
        require_more_patches(self.clusters, grid, patch_size)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: tuple[int, int]) -> Fol:
        """Draw parameters as torch's default layers, as the public code."""
        token_key, cluster_key, score_key, first, second = draw.split(key, 5)
        dim = backbone.dim
        return Fol(
            token_features=init_two_layer(token_key, dim, self.hidden, self.token_dim),
            cluster_features=init_two_layer(cluster_key, dim, self.hidden, self.cluster_dim),
            score=init_two_layer(score_key, dim, self.hidden, self.clusters),
            upconv1=init_upconv(first, dim, self.local_hidden),
            upconv2=init_upconv(second, self.local_hidden, self.local),
        )

    def transport(self, params: Fol, features: Features, *, key: Keys | None) -> SinkhornResult:
        """Assign patches to clusters, dustbin last, by three plain iterations in float32.

        Raises:
            InputError: no more patches than clusters.
        """
        assert features.class_attention is not None
        scores = at_least_float32(two_layer(params.score, features.patches, self.dropout, key))
        dustbin = dustbin_scores(features.class_attention)
        return assign_with_dustbin(scores, dustbin, "token", config=SinkhornConfig())

    def apply(
        self, params: Fol, features: Features, grid: tuple[int, int], *, key: Keys | None
    ) -> Tokens:
        """Return the global token and cluster tokens, each L2-normalised, in float32.

        Raises:
            InputError: no more patches than clusters.
        """
        cluster_key, score_key = split_key(key, 2)
        global_token = two_layer(params.token_features, features.class_token, 0.0, None)
        local = two_layer(params.cluster_features, features.patches, self.dropout, cluster_key)
        result = self.transport(params, features, key=score_key)
        return transported_tokens(global_token, local, result, self.clusters)

    def plan(self, params: Fol, features: Features) -> Float[Array, "*batch patch column"]:
        """Return the mass that each patch sends to each cluster and to the dustbin."""
        return jnp.exp(self.transport(params, features, key=None).log_plan)


def dustbin_scores(attention: Float[Array, "*batch patch"]) -> Float[Array, "*batch patch"]:
    """Return 1 minus each patch's attention, which counts as 0 below `LEAST_ATTENTION`.

    Example:
        >>> import jax.numpy as jnp
        >>> dustbin_scores(jnp.array([0.5, 0.001])).tolist()
        [0.5, 1.0]
    """
    return 1 - jnp.where(attention >= LEAST_ATTENTION, attention, 0)
