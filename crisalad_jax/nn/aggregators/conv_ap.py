"""Conv-AP, the baseline of GSV-Cities (Ali-bey et al., Neurocomputing 2022)."""

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config import ModelConfig
from crisalad_jax.nn.layers import Keys, Linear, init_linear, linear, widen
from crisalad_jax.nn.tokens import Tokens, local_alone
from crisalad_jax.nn.vit import Features
from crisalad_jax.pytree import params


@params
class ConvAp:
    """The 1 x 1 convolution: a linear layer at every patch."""

    channel_pool: Linear


def init(key: PRNGKeyArray, config: ModelConfig) -> ConvAp:
    """Start as torch's convolutions do."""
    return ConvAp(init_linear(key, config.backbone.dim, config.conv_ap.channels))


def apply(
    params: ConvAp,
    features: Features,
    grid: tuple[int, int],
    config: ModelConfig,
    *,
    key: Keys | None,
) -> Tokens:
    """A token for each of side x side regions, row by row.

    Published as convolution, then means. Both are linear and the weights of a mean add up to 1, so
    the order is free; means first leave the convolution fewer products by patches over regions.
    """
    means = adaptive_means(widen(features.patches), grid, config.conv_ap.side)
    return local_alone(widen(linear(params.channel_pool, means.astype(features.patches.dtype))))


def adaptive_means(
    patches: Float[Array, "*batch patch dim"], grid: tuple[int, int], side: int
) -> Float[Array, "*batch region dim"]:
    """Means over side x side regions of the patches, as torch's `AdaptiveAvgPool2d` cuts them.

    Region i of a side of n patches goes from floor(i n / side) to ceil((i + 1) n / side): where
    `side` does not divide n, neighbours share a row or column.
    """
    cells = patches.reshape(*patches.shape[:-2], *grid, patches.shape[-1])
    means = [
        cells[..., top:bottom, left:right, :].mean(axis=(-3, -2))
        for top, bottom in _cuts(grid[0], side)
        for left, right in _cuts(grid[1], side)
    ]
    return jnp.stack(means, axis=-2)


def _cuts(length: int, side: int) -> list[tuple[int, int]]:
    return [(i * length // side, -(-(i + 1) * length // side)) for i in range(side)]
