"""Generalised mean of an image's patches (GeM; Radenovic et al., TPAMI 2018)."""

import dataclasses
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.nn import draw
from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, TokenShape
from crisalad_jax.nn.backbones.base import Backbone, Features
from crisalad_jax.nn.layers import Keys, at_least_float32, l2_normalise
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.pytree import pytree_dataclass

GEM_FLOOR = 1e-6
"""Floor of the numbers of a generalised mean, because negative numbers have no power."""
START = 3.0
"""Initial exponent of public implementations."""


@pytree_dataclass
class Gem:
    """The exponent of the mean, one for all channels: 1 is the mean, infinity the maximum."""

    p: Float[Array, ""]


@AGGREGATORS.register("gem")
@dataclasses.dataclass(frozen=True)
class GemConfig(Aggregator):
    """Generalised mean of all patches (Radenovic et al., TPAMI 2018)."""

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of a global token as wide as the backbone."""
        return TokenShape(dim, 0, dim)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: tuple[int, int]) -> Gem:
        """Start at an exponent of 3, as public implementations do."""
        return Gem(draw.full((), START))

    def apply(
        self, params: Gem, features: Features, grid: tuple[int, int], *, key: Keys | None
    ) -> Tokens:
        """Return the mean of all patches, a global token as wide as the backbone."""
        mean = generalised_mean(log_units(at_least_float32(features.patches)), params.p, axis=-2)
        return Tokens.of_global(mean)


def log_units(patches: Float[Array, "*batch patch dim"]) -> Float[Array, "*batch patch dim"]:
    """Compute the logarithms of unit patches, with numbers raised to the floor.

    Unit length and floor are those of CosPlace, CricaVPR and the benchmark of Berton et al. (CVPR
    2022).
    """
    return jnp.log(jnp.maximum(l2_normalise(patches), GEM_FLOOR))


def generalised_mean(
    logs: Float[Array, "*shape"], p: Float[Array, ""], *, axis: int | tuple[int, ...]
) -> Float[Array, "*rest"]:
    """Compute (mean of x^p)^(1/p) along `axis` from the logarithms of x (Radenovic et al., Eq. 3).

    Logarithms avoid an underflow: in float32 the floor's power is 0 from an exponent of 6.4 on, and
    a mean of zeros has no gradient.
    """
    axes = (axis,) if isinstance(axis, int) else axis
    count = math.prod(logs.shape[i] for i in axes)
    return jnp.exp((jax.nn.logsumexp(p * logs, axis=axis) - math.log(count)) / p)
