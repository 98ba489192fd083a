"""MixVPR: networks that mix all positions of a feature map (Ali-bey et al., WACV 2023).

The parameters belong to the patches of one grid: a model describes images of one size.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config import ModelConfig
from crisalad_jax.nn.layers import (
    Keys,
    LayerNorm,
    Linear,
    init_layer_norm,
    init_linear,
    layer_norm,
    linear,
    widen,
)
from crisalad_jax.nn.tokens import Tokens, local_alone
from crisalad_jax.nn.vit import Features
from crisalad_jax.pytree import params

NORM_EPSILON = 1e-5


@params
class FeatureMixer:
    """Layer norm and a network of one hidden layer, over the patches of a channel."""

    norm: LayerNorm
    fc1: Linear
    fc2: Linear


@params
class MixVpr:
    """Mixers in order, then what makes fewer channels and fewer rows."""

    mix: tuple[FeatureMixer, ...]
    channel_proj: Linear
    row_proj: Linear


def init(key: PRNGKeyArray, config: ModelConfig) -> MixVpr:
    """Start as the public implementation.

    Mixers have zero biases and normal weights of deviation 0.02 (said to be truncated, at a hundred
    deviations); the projections start as torch's linear layers do.
    """
    mixers, channels, rows = jax.random.split(key, 3)
    mixvpr, patches = config.mixvpr, config.patches
    return MixVpr(
        mix=tuple(_init_mixer(one, patches) for one in jax.random.split(mixers, mixvpr.depth)),
        channel_proj=init_linear(channels, config.backbone.dim, mixvpr.channels),
        row_proj=init_linear(rows, patches, mixvpr.rows),
    )


def _init_mixer(key: PRNGKeyArray, patches: int) -> FeatureMixer:
    weights = 0.02 * jax.random.normal(key, (2, patches, patches))
    first, second = (Linear(weight, jnp.zeros(patches)) for weight in weights)
    return FeatureMixer(init_layer_norm(patches), first, second)


def apply(
    params: MixVpr,
    features: Features,
    grid: tuple[int, int],
    config: ModelConfig,
    *,
    key: Keys | None,
) -> Tokens:
    """A token of `channels` numbers for each row (paper Eqs. 1 to 4)."""
    maps = features.patches.swapaxes(-2, -1)
    for mixer in params.mix:
        maps = feature_mixer(mixer, maps)
    channels = linear(params.channel_proj, maps.swapaxes(-2, -1)).swapaxes(-2, -1)
    return local_alone(widen(linear(params.row_proj, channels)).swapaxes(-2, -1))


def feature_mixer(
    params: FeatureMixer, maps: Float[Array, "*batch channel patch"]
) -> Float[Array, "*batch channel patch"]:
    """x + W2 relu(W1 norm(x)) along the patches of each channel, in the type of `maps` (Eq. 2)."""
    hidden = linear(params.fc1, layer_norm(params.norm, maps, epsilon=NORM_EPSILON))
    return maps + linear(params.fc2, jax.nn.relu(hidden))
