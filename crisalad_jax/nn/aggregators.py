"""From a backbone's features to an image's tokens: SALAD, CricaVPR's GeM pyramid, a class token."""

import itertools

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config import PYRAMID_LEVELS, ModelConfig
from crisalad_jax.nn.layers import Keys, l2_normalise, widen
from crisalad_jax.nn.salad import Salad, init_salad, published_order, salad
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.nn.vit import Features
from crisalad_jax.pytree import params

GEM_FLOOR = 1e-6
"""What a generalised mean takes smaller numbers for."""


@params
class GemPyramid:
    """The exponent of the generalised means, one for all regions (CricaVPR, CVPR 2024)."""

    p: Float[Array, ""]


Aggregator = Salad | GemPyramid


def init_aggregator(key: PRNGKeyArray, config: ModelConfig) -> Aggregator | None:
    """Random parameters of `config.aggregator`; a class token has none."""
    if config.aggregator == "salad":
        return init_salad(key, config.backbone.dim, config.salad)
    return GemPyramid(jnp.full((), 3.0)) if config.aggregator == "gem-pyramid" else None


def aggregate(
    params: Aggregator | None,
    features: Features,
    grid: tuple[int, int],
    config: ModelConfig,
    *,
    key: Keys | None,
) -> Tokens:
    """Tokens of one image or of a batch, in float32 at least.

    `grid` is the rows and columns of patches. `key` draws dropout, one for all or one an
    image; None means inference.

    Raises:
        InputError: SALAD finds no more patches than clusters.
    """
    if isinstance(params, Salad):
        return salad(params, features, config.salad, key=key)
    class_token, patches = widen(features.class_token), widen(features.patches)
    if params is None:
        return Tokens(class_token, patches[..., :0, :])
    return Tokens(class_token, gem_pyramid(params, patches, grid))


def gem_pyramid(
    params: GemPyramid, patches: Float[Array, "*batch patch dim"], grid: tuple[int, int]
) -> Float[Array, "*batch region dim"]:
    """Generalised means (Radenovic et al. 2018) of unit patches over 2 x 2 and 3 x 3 regions.

    Regions come level by level in row order. A side of n patches is cut at round(i n / level):
    CricaVPR's 8, and 5 and 11, for the 16 x 16 grid that it was published for and fixed to.
    """
    cells = jnp.maximum(l2_normalise(patches), GEM_FLOOR) ** params.p
    cells = cells.reshape(*cells.shape[:-2], *grid, cells.shape[-1])
    means = [
        cells[..., top:bottom, left:right, :].mean(axis=(-3, -2))
        for level in PYRAMID_LEVELS
        for top, bottom in _cuts(grid[0], level)
        for left, right in _cuts(grid[1], level)
    ]
    return jnp.stack(means, axis=-2) ** (1 / params.p)


def _cuts(side: int, level: int) -> list[tuple[int, int]]:
    edges = [round(i * side / level) for i in range(level + 1)]
    return list(itertools.pairwise(edges))


def join(tokens: Tokens, config: ModelConfig) -> Float[Array, " descriptor"]:
    """One unit descriptor: the global token, then the local ones in the published order."""
    local = published_order(tokens.local) if config.aggregator == "salad" else tokens.local
    return l2_normalise(jnp.concatenate([tokens.global_token, local.ravel()]))
