"""CricaVPR's pyramid of generalised means (Lu et al., CVPR 2024)."""

import dataclasses
import itertools

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.nn import draw
from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, TokenShape, require_side
from crisalad_jax.nn.aggregators.gem import START, generalised_mean, log_units
from crisalad_jax.nn.backbones.base import Backbone, FeatureRequest, Features
from crisalad_jax.nn.layers import Keys, at_least_float32
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.pytree import pytree_dataclass

PYRAMID_LEVELS = (2, 3)
"""Cuts of a side, as CricaVPR's: 4 and 9 regions."""


@pytree_dataclass
class GemPyramid:
    """The exponent of the generalised means, one for all regions (CricaVPR, CVPR 2024)."""

    p: Float[Array, ""]


@AGGREGATORS.register("gem-pyramid")
@dataclasses.dataclass(frozen=True)
class GemPyramidConfig(Aggregator):
    """CricaVPR's class token and generalised means over 13 regions (Lu et al., CVPR 2024)."""

    def features(self, depth: int) -> FeatureRequest:
        """Request the last patches and the class token."""
        return FeatureRequest(class_token=True)

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of tokens as wide as the backbone."""
        return TokenShape(dim, sum(level**2 for level in PYRAMID_LEVELS), dim)

    def check_grid(self, grid: tuple[int, int], patch_size: int) -> None:
        """Require a patch in every region."""
        require_side(self.part_name, grid, max(PYRAMID_LEVELS), patch_size)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: tuple[int, int]) -> GemPyramid:
        """Start at an exponent of 3, as the public implementation does."""
        return GemPyramid(draw.full((), START))

    def apply(
        self, params: GemPyramid, features: Features, grid: tuple[int, int], *, key: Keys | None
    ) -> Tokens:
        """Return the class token, and a generalised mean for each region."""
        means = gem_pyramid(params, at_least_float32(features.patches), grid)
        return Tokens(at_least_float32(features.class_token), means)


def gem_pyramid(
    params: GemPyramid, patches: Float[Array, "*batch patch dim"], grid: tuple[int, int]
) -> Float[Array, "*batch region dim"]:
    """Compute generalised means (Radenovic et al. 2018) of unit patches in 2 x 2 and 3 x 3 regions.

    Regions come level by level in row order. A side of n patches is cut at round(i n / level). For
    CricaVPR's fixed 16 x 16 grid that gives its published cuts at 8, and at 5 and 11.
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
