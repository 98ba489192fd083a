"""Conv-AP, the baseline of GSV-Cities (Ali-bey et al., Neurocomputing 2022)."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import PositiveInt
from crisalad_jax.nn.aggregators.base import (
    AGGREGATORS,
    Aggregator,
    FlattenOrder,
    TokenShape,
    regions,
    require_side,
)
from crisalad_jax.nn.backbones.base import Backbone, Features, Grid, Patches
from crisalad_jax.nn.layers import Keys, Linear, at_least_float32, init_linear, linear
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.pytree import pytree_dataclass


@pytree_dataclass
class ConvAp:
    """The parameters: a 1 x 1 convolution, which is a linear layer applied to every patch."""

    channel_pool: Linear


@AGGREGATORS.register("conv-ap", tiny={"channels": 128})
class ConvApConfig(Aggregator):
    """Conv-AP, the baseline of GSV-Cities (Ali-bey et al., Neurocomputing 2022)."""

    flatten_order: ClassVar[FlattenOrder] = "dimension-first"
    channels: PositiveInt = 1024
    """Number of output channels of the 1 x 1 convolution."""
    side: PositiveInt = 2
    """Number of regions along each side of the image; side x side means form the descriptor."""

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of one local token, a mean, for each region."""
        return TokenShape(0, self.side**2, self.channels)

    def check_grid(self, grid: Grid, patch_size: int) -> None:
        """Require a patch in every region."""
        require_side(self.part_name, grid, self.side, patch_size)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> ConvAp:
        """Draw parameters as torch draws convolutions."""
        return ConvAp(init_linear(key, backbone.dim, self.channels))

    def apply(self, params: ConvAp, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Return a token for each of side x side regions, row by row.

        The published order is convolution, then means. As the two are linear, and the weights of a
        mean add up to 1, the order does not matter. Taking means first makes the convolution
        cheaper, by the ratio of patches to regions.
        """
        means = adaptive_means(at_least_float32(features.patches), grid, self.side)
        tokens = linear(params.channel_pool, means.astype(features.patches.dtype))
        return Tokens.of_local(at_least_float32(tokens))


def adaptive_means(patches: Patches, grid: Grid, side: int) -> Float[Array, "*batch region dim"]:
    """Average the patches over side x side regions, as torch's `AdaptiveAvgPool2d` cuts them.

    Along n patches, region i goes from floor(i n / side) up to but not including
    ceil((i + 1) n / side): if `side` does not divide n, neighbours share a row or column.
    """
    cuts = ([(i * n // side, -(-(i + 1) * n // side)) for i in range(side)] for n in grid)
    return jnp.stack([each.mean(axis=(-3, -2)) for each in regions(patches, grid, *cuts)], axis=-2)
