"""CricaVPR's pyramid of generalised means (Lu et al., CVPR 2024)."""

import itertools

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config import PYRAMID_LEVELS, ModelConfig
from crisalad_jax.nn.aggregators.gem import START, generalised_mean, log_units
from crisalad_jax.nn.layers import Keys, widen
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.nn.vit import Features
from crisalad_jax.pytree import params


@params
class GemPyramid:
    """The exponent of the generalised means, one for all regions (CricaVPR, CVPR 2024)."""

    p: Float[Array, ""]


def init(key: PRNGKeyArray, config: ModelConfig) -> GemPyramid:
    """Start as the public implementation, at an exponent of 3."""
    return GemPyramid(jnp.full((), START))


def apply(
    params: GemPyramid,
    features: Features,
    grid: tuple[int, int],
    config: ModelConfig,
    *,
    key: Keys | None,
) -> Tokens:
    """The class token, and a generalised mean for each region."""
    means = gem_pyramid(params, widen(features.patches), grid)
    return Tokens(widen(features.class_token), means)


def gem_pyramid(
    params: GemPyramid, patches: Float[Array, "*batch patch dim"], grid: tuple[int, int]
) -> Float[Array, "*batch region dim"]:
    """Generalised means (Radenovic et al. 2018) of unit patches over 2 x 2 and 3 x 3 regions.

    Regions come level by level in row order. A side of n patches is cut at round(i n / level):
    CricaVPR's 8, and 5 and 11, for the 16 x 16 grid that it was published for and fixed to.
    """
    cells = log_units(patches)
    cells = cells.reshape(*cells.shape[:-2], *grid, cells.shape[-1])
    means = [
        generalised_mean(cells[..., top:bottom, left:right, :], params.p, axis=(-3, -2))
        for level in PYRAMID_LEVELS
        for top, bottom in _cuts(grid[0], level)
        for left, right in _cuts(grid[1], level)
    ]
    return jnp.stack(means, axis=-2)


def _cuts(side: int, level: int) -> list[tuple[int, int]]:
    edges = [round(i * side / level) for i in range(level + 1)]
    return list(itertools.pairwise(edges))
