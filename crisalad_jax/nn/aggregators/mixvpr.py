"""MixVPR: networks that mix all positions of a feature map (Ali-bey et al., WACV 2023).

The parameters fit one grid of patches, so a model accepts images of one size only.
"""

import math
from typing import ClassVar

import jax
from jaxtyping import PRNGKeyArray

from crisalad_jax.config.checks import PositiveInt
from crisalad_jax.nn import random_init
from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, FlattenOrder, TokenShape
from crisalad_jax.nn.backbones.base import Backbone, Features, FeatureSpec, Grid
from crisalad_jax.nn.layers import (
    Keys,
    LayerNorm,
    Linear,
    at_least_float32,
    init_layer_norm,
    init_linear,
    layer_norm,
    linear,
)
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.pytree import pytree_dataclass


@pytree_dataclass
class FeatureMixer:
    """A layer norm and an MLP with one hidden layer, both over the patches of each channel."""

    norm: LayerNorm
    fc1: Linear
    fc2: Linear


@pytree_dataclass
class MixVpr:
    """Parameters: the mixers in order, then the projections of the channels and of the patches."""

    mix: tuple[FeatureMixer, ...]
    channel_proj: Linear
    row_proj: Linear


@AGGREGATORS.register("mixvpr", tiny={"channels": 128})
class MixVprConfig(Aggregator):
    """MixVPR (Ali-bey et al., WACV 2023)."""

    flatten_order: ClassVar[FlattenOrder] = "dimension-first"
    fixed_grid: ClassVar[bool] = True
    channels: PositiveInt = 1024
    """Number of channels after their linear projection."""
    rows: PositiveInt = 4
    """Number of values (rows) that the patches of each channel are projected to."""
    depth: PositiveInt = 4
    """Number of feature mixers, whose layers are as wide as the number of patches."""
    last_norm: bool = True
    """Whether the backbone's last layer norm is applied; DINO-Mix does not apply it."""

    def features(self, depth: int) -> FeatureSpec:
        """Request the patches of the last block."""
        return FeatureSpec(norm=self.last_norm)

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of `rows` local tokens of width `channels`, without a global token."""
        return TokenShape(0, self.rows, self.channels)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> MixVpr:
        """Draw parameters as the public implementation does.

        Mixers have normal weights of standard deviation 0.02 and zero biases. (The public code also
        truncates at 100 deviations, without effect.) Projections are drawn like `nn.Linear`.
        """
        mixers, channels, rows = random_init.split(key, 3)
        patches = math.prod(grid)
        return MixVpr(
            mix=tuple(
                _init_mixer(mixer_key, patches)
                for mixer_key in random_init.split(mixers, self.depth)
            ),
            channel_proj=init_linear(channels, backbone.dim, self.channels),
            row_proj=init_linear(rows, patches, self.rows),
        )

    def apply(self, params: MixVpr, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Return `rows` local tokens of width `channels` (Eqs. 1 to 4), in at least float32."""
        maps = features.patches.swapaxes(-2, -1)
        for mixer in params.mix:
            hidden = linear(mixer.fc1, layer_norm(mixer.norm, maps))
            maps = maps + linear(mixer.fc2, jax.nn.relu(hidden))
        channels = linear(params.channel_proj, maps.swapaxes(-2, -1)).swapaxes(-2, -1)
        return Tokens.of_local(at_least_float32(linear(params.row_proj, channels)).swapaxes(-2, -1))


def _init_mixer(key: PRNGKeyArray, patches: int) -> FeatureMixer:
    weights = random_init.normal(key, (2, patches, patches), scale=0.02)
    first, second = (Linear(weight, random_init.zeros(patches)) for weight in weights)
    return FeatureMixer(init_layer_norm(patches), first, second)
