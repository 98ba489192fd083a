"""TransVPR's multi-level attention (Wang et al., CVPR 2022, section 3.2), for any backbone.

A level is the output of a block; the levels of a patch are concatenated (`FeatureSpec.levels`).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import PositiveInt, require_range
from crisalad_jax.nn import random_init
from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, TokenShape
from crisalad_jax.nn.backbones.base import Backbone, Features, FeatureSpec, Grid, Patches
from crisalad_jax.nn.layers import Keys, Linear, at_least_float32, init_linear, l2_normalise, linear
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.pytree import pytree_dataclass

KEY_THRESHOLD = 0.02
"""Fused attention in `key_features`, 0 to 1, above which the public code selects key patches."""


@pytree_dataclass
class TransVpr:
    """The layer that scores patches for every level, and the descriptor's linear layer."""

    attention: Linear
    """Score layer. It has no bias, because the softmax over patches would cancel one."""
    reduction: Linear


@AGGREGATORS.register("transvpr", tiny={"levels": 2, "dim": 128})
class TransVprConfig(Aggregator):
    """TransVPR: patches of several layers, weighted by attention (Wang et al., CVPR 2022)."""

    levels: PositiveInt = 3
    """Number of the backbone's layers that are used, evenly spaced up to the last."""
    dim: PositiveInt = 256
    """Width of the descriptor."""

    def features(self, depth: int) -> FeatureSpec:
        """Request the patches of `levels` evenly spaced blocks, the last one included."""
        require_range(self, 1, depth, "levels")
        numbers = range(1, self.levels + 1)
        return FeatureSpec(tuple(depth * number // self.levels for number in numbers))

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of a global token of width `self.dim`, without local tokens."""
        return TokenShape(self.dim, 0, self.dim)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> TransVpr:
        """Draw parameters as torch's `nn.Linear` does."""
        first, second = random_init.split(key)
        wide = self.levels * backbone.dim
        return TransVpr(
            init_linear(first, wide, self.levels, bias=False), init_linear(second, wide, self.dim)
        )

    def apply(self, params: TransVpr, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Return a global token of unit length, without local tokens."""
        patches = at_least_float32(features.patches)
        weights = attentions(params, features.patches)
        by_level = patches.reshape(*patches.shape[:-1], self.levels, -1)
        pooled = jnp.einsum("...nl,...nld->...ld", weights, by_level)
        pooled = l2_normalise(pooled.reshape(*pooled.shape[:-2], -1))
        return Tokens.of_global(l2_normalise(linear(params.reduction, pooled)))


def attentions(params: TransVpr, patches: Patches) -> Float[Array, "*batch patch level"]:
    """Compute each level's softmax over patches, from all levels' features, in at least float32."""
    return jax.nn.softmax(at_least_float32(linear(params.attention, patches)), axis=-2)


def key_features(
    params: TransVpr, patches: Float[Array, "*batch patch wide"], levels: int
) -> Patches:
    """Return the middle level's features of the key patches, and 0 for all other patches.

    The attention of every level is rescaled to the range 0 to 1, summed over levels and rescaled
    again. Key patches are those above `KEY_THRESHOLD`. As in the public code, the results are not
    normalised, and no extra layer is learnt for them.
    """
    fused = _stretch(_stretch(attentions(params, patches)).sum(axis=-1, keepdims=True))
    middle = jnp.split(at_least_float32(patches), levels, axis=-1)[levels // 2]
    return jnp.where(fused > KEY_THRESHOLD, middle, 0)


def _stretch(x: Float[Array, "*batch patch level"]) -> Float[Array, "*batch patch level"]:
    """Rescale the values of patches to the range 0 to 1, or to 0 if all are equal."""
    low, high = x.min(axis=-2, keepdims=True), x.max(axis=-2, keepdims=True)
    return (x - low) / jnp.maximum(high - low, 1e-12)
