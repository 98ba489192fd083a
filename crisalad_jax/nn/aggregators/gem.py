"""Generalised means (GeM) of patches: of an image, of regions, and heads with a linear layer."""

import itertools
import math
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import PositiveInt
from crisalad_jax.nn import random_init
from crisalad_jax.nn.aggregators.base import (
    AGGREGATORS,
    Aggregator,
    TokenShape,
    regions,
    require_side,
)
from crisalad_jax.nn.backbones.base import Backbone, Features, Grid, Patches
from crisalad_jax.nn.layers import Keys, Linear, at_least_float32, init_linear, l2_normalise, linear
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.pytree import pytree_dataclass

GEM_FLOOR = 1e-6
"""Lower bound of the values in a generalised mean, because negative ones have no real power."""
START = 3.0
"""Initial exponent, as in public implementations."""
PYRAMID_LEVELS = (2, 3)
"""Number of regions along a side on each level, as in CricaVPR: 4 and 9 regions in all."""


@pytree_dataclass
class Gem:
    """The exponent of the mean, one for all channels; 1 gives the mean, infinity the maximum."""

    p: Float[Array, ""]


@AGGREGATORS.register("gem")
class GemConfig(Aggregator):
    """Generalised mean of all patches (Radenovic et al., TPAMI 2018)."""

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of a global token as wide as the backbone."""
        return TokenShape(dim, 0, dim)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> Gem:
        """Set the exponent to 3, as public implementations do."""
        return Gem(random_init.full((), START))

    def apply(self, params: Gem, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Return the generalised mean of all patches, a global token as wide as the backbone."""
        return Tokens.of_global(gem(features.patches, params.p))


@AGGREGATORS.register("gem-pyramid")
class GemPyramidConfig(GemConfig):
    """CricaVPR's class token and generalised means over 13 regions (Lu et al., CVPR 2024).

    All regions share one exponent.
    """

    class_token: ClassVar[bool] = True

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of a global and 13 local tokens, all as wide as the backbone."""
        return TokenShape(dim, sum(level**2 for level in PYRAMID_LEVELS), dim)

    def check_grid(self, grid: Grid, patch_size: int) -> None:
        """Require a patch in every region."""
        require_side(self.part_name, grid, max(PYRAMID_LEVELS), patch_size)

    def apply(self, params: Gem, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Return the class token as the global one, and the mean of each region as a local one."""
        means = gem_pyramid(features.patches, params.p, grid)
        return Tokens(at_least_float32(features.class_token), means)


@pytree_dataclass
class CosPlace:
    """The exponent of the generalised mean, and the linear layer after it."""

    p: Float[Array, ""]
    fc: Linear


@AGGREGATORS.register("cosplace", tiny={"dim": 256})
class CosPlaceConfig(Aggregator):
    """The head of CosPlace (Berton et al., CVPR 2022) and EigenPlaces (ICCV 2023)."""

    dim: PositiveInt = 512
    """Width of the descriptor: 512 in CosPlace, 2,048 in EigenPlaces."""

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of a global token of width `self.dim`."""
        return TokenShape(self.dim, 0, self.dim)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> CosPlace:
        """Draw parameters as the public code does: an exponent of 3, and torch's linear layer."""
        return CosPlace(random_init.full((), START), init_linear(key, backbone.dim, self.dim))

    def apply(self, params: CosPlace, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Apply a linear layer to the generalised mean of unit patches.

        The output is scaled to unit length only later, when it becomes the descriptor.
        """
        mean = gem(features.patches, params.p).astype(features.patches.dtype)
        return Tokens.of_global(at_least_float32(linear(params.fc, mean)))


@pytree_dataclass
class Whitening:
    """Principal components of descriptors, as scikit-learn's `PCA` stores them."""

    mean: Float[Array, " dim"]
    components: Float[Array, "dim dim"]
    """Orthonormal rows."""
    variance: Float[Array, " dim"]
    """Variance of the fitted descriptors along each component."""


@pytree_dataclass
class ApGem:
    """The exponent of the generalised mean, the linear layer after it, and the whitening."""

    p: Float[Array, ""]
    fc: Linear
    whitening: Whitening


@AGGREGATORS.register("ap-gem", tiny={"dim": 256})
class ApGemConfig(CosPlaceConfig):
    """The head of AP-GeM (Revaud et al., ICCV 2019), with the whitening of its public code."""

    dim: PositiveInt = 2048
    """Width of the linear layer and of the descriptor."""

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> ApGem:
        """Draw parameters as in CosPlace, with a whitening that does nothing."""
        head, zeros, ones = super().init(key, backbone, grid), random_init.zeros, random_init.ones
        whitening = Whitening(zeros(self.dim), jnp.diag(ones(self.dim)), ones(self.dim))
        return ApGem(head.p, head.fc, whitening)

    def apply(self, params: ApGem, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Apply a linear layer to the generalised mean of raw patches; normalise, then whiten.

        The whitening comes from statistics and is not learnt, so it gets no gradient.
        """
        patches = features.patches
        mean = generalised_mean(log_floored(patches), params.p, axes=(-2,)).astype(patches.dtype)
        unit = l2_normalise(at_least_float32(linear(params.fc, mean)))
        return Tokens.of_global(whiten(jax.lax.stop_gradient(params.whitening), unit))


def whiten(params: Whitening, x: Float[Array, "*batch dim"]) -> Float[Array, "*batch dim"]:
    """Project `x` onto the components, each divided by variance^(1/4), as AP-GeM's code does."""
    components = jnp.matmul(x - params.mean, params.components.T, precision="highest")
    return components * params.variance**-0.25


def gem(patches: Patches, p: Float[Array, ""]) -> Float[Array, "*batch dim"]:
    """Compute the generalised mean, in at least float32, of all patches scaled to unit length."""
    return generalised_mean(log_units(patches), p, axes=(-2,))


def log_units(patches: Patches) -> Patches:
    """Scale patches to unit length; return the logarithms of values clamped to `GEM_FLOOR`.

    CosPlace, CricaVPR and the benchmark of Berton et al. (CVPR 2022) use the same normalisation
    and floor. The result is in at least float32.
    """
    return log_floored(l2_normalise(at_least_float32(patches)))


def log_floored(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Compute the logarithms, in at least float32, of values clamped to `GEM_FLOOR`."""
    return jnp.log(jnp.maximum(at_least_float32(x), GEM_FLOOR))


def generalised_mean(
    logs: Float[Array, "*shape"], p: Float[Array, ""], *, axes: tuple[int, ...]
) -> Float[Array, "*rest"]:
    """Compute (mean of x^p)^(1/p) along `axes` from the logarithms of x (Radenovic et al., Eq. 3).

    Logarithms avoid underflow: in float32 the power of `GEM_FLOOR` is 0 for exponents from 6.4 on,
    and a mean of zeros has no gradient.
    """
    count = math.prod(logs.shape[i] for i in axes)
    return jnp.exp((jax.nn.logsumexp(p * logs, axis=axes) - math.log(count)) / p)


def gem_pyramid(
    patches: Patches, p: Float[Array, ""], grid: Grid
) -> Float[Array, "*batch region dim"]:
    """Compute generalised means (Radenovic et al. 2018) of unit patches in 2 x 2 and 3 x 3 regions.

    Regions come level by level in row order. With k regions along a side, n patches are cut at
    round(i n / k): for CricaVPR's fixed 16 x 16 grid at its published 8, and 5 and 11.
    """
    logs, means = log_units(patches), []
    for level in PYRAMID_LEVELS:
        edges = ([round(i * n / level) for i in range(level + 1)] for n in grid)
        cuts = map(itertools.pairwise, edges)
        means += [generalised_mean(x, p, axes=(-3, -2)) for x in regions(logs, grid, *cuts)]
    return jnp.stack(means, axis=-2)
