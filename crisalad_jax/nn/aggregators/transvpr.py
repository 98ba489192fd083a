"""TransVPR's multi-level attention (Wang et al., CVPR 2022, section 3.2), on any of our backbones.

Features hold the patches of all levels side by side (`nn.vit.vit_levels`).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config import ModelConfig
from crisalad_jax.nn.layers import Keys, Linear, init_linear, l2_normalise, linear, widen
from crisalad_jax.nn.tokens import Tokens, global_alone
from crisalad_jax.nn.vit import Features
from crisalad_jax.pytree import params

KEY_THRESHOLD = 0.02
"""A patch is a key patch above this fused attention, from 0 to 1: the public code's."""


@params
class TransVpr:
    """Scores of a patch for every level, and the descriptor's linear layer."""

    attention: Linear
    """Without bias: softmax over patches would not see one."""
    reduction: Linear


def init(key: PRNGKeyArray, config: ModelConfig) -> TransVpr:
    """Start as torch's `nn.Linear` does."""
    first, second = jax.random.split(key)
    levels, dim = config.transvpr.levels, config.transvpr.dim
    wide = levels * config.backbone.dim
    return TransVpr(init_linear(first, wide, levels, bias=False), init_linear(second, wide, dim))


def apply(
    params: TransVpr,
    features: Features,
    grid: tuple[int, int],
    config: ModelConfig,
    *,
    key: Keys | None,
) -> Tokens:
    """The global descriptor, and no local token."""
    patches = widen(features.patches)
    weights = attentions(params, features.patches)
    by_level = patches.reshape(*patches.shape[:-1], config.transvpr.levels, -1)
    pooled = jnp.einsum("...nl,...nld->...ld", weights, by_level)
    pooled = l2_normalise(pooled.reshape(*pooled.shape[:-2], -1))
    descriptor = l2_normalise(linear(params.reduction, pooled))
    return global_alone(descriptor)


def attentions(
    params: TransVpr, patches: Float[Array, "*batch patch wide"]
) -> Float[Array, "*batch patch level"]:
    """A softmax over patches for every level, scored from all levels, in float32 at least."""
    return jax.nn.softmax(widen(linear(params.attention, patches)), axis=-2)


def key_features(
    params: TransVpr, patches: Float[Array, "*batch patch wide"], config: ModelConfig
) -> Float[Array, "*batch patch dim"]:
    """Unit patch tokens of the middle level; those of patches that are no key patches are 0.

    Every level's attention is stretched to 0 to 1, and so is their sum; key patches are those
    above `KEY_THRESHOLD`. As in the public code nothing is learnt for the tokens alone.
    """
    fused = _stretch(_stretch(attentions(params, patches)).sum(axis=-1, keepdims=True))
    levels = config.transvpr.levels
    middle = jnp.split(widen(patches), levels, axis=-1)[levels // 2]
    return jnp.where(fused > KEY_THRESHOLD, l2_normalise(middle), 0)


def _stretch(x: Float[Array, "*batch patch level"]) -> Float[Array, "*batch patch level"]:
    """The patches' numbers from 0 to 1; all 0 where they are the same."""
    low, high = x.min(axis=-2, keepdims=True), x.max(axis=-2, keepdims=True)
    return (x - low) / jnp.maximum(high - low, 1e-12)
