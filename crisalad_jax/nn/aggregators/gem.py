"""Generalised mean of an image's patches (GeM; Radenovic et al., TPAMI 2018)."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config import ModelConfig
from crisalad_jax.nn.layers import Keys, l2_normalise, widen
from crisalad_jax.nn.tokens import Tokens, global_alone
from crisalad_jax.nn.vit import Features
from crisalad_jax.pytree import params

GEM_FLOOR = 1e-6
"""What a generalised mean takes smaller numbers for: negative ones have no power."""
START = 3.0
"""Where public implementations start the exponent."""


@params
class Gem:
    """The exponent of the mean, one for all channels: 1 is the mean, infinity the maximum."""

    p: Float[Array, ""]


def init(key: PRNGKeyArray, config: ModelConfig) -> Gem:
    """Start as public implementations, at an exponent of 3."""
    return Gem(jnp.full((), START))


def apply(
    params: Gem,
    features: Features,
    grid: tuple[int, int],
    config: ModelConfig,
    *,
    key: Keys | None,
) -> Tokens:
    """The mean of all patches, a global token as wide as the backbone."""
    return global_alone(generalised_mean(log_units(widen(features.patches)), params.p, axis=-2))


def log_units(patches: Float[Array, "*batch patch dim"]) -> Float[Array, "*batch patch dim"]:
    """Logarithms of unit patches, every number above the floor.

    Unit length and floor are those of CosPlace, CricaVPR and the benchmark of Berton et al. (CVPR
    2022).
    """
    return jnp.log(jnp.maximum(l2_normalise(patches), GEM_FLOOR))


def generalised_mean(
    logs: Float[Array, "*shape"], p: Float[Array, ""], *, axis: int | tuple[int, ...]
) -> Float[Array, "*rest"]:
    """(mean of x^p)^(1/p) along `axis`, of the logarithms of x (Radenovic et al., Eq. 3).

    By way of logarithms, for in float32 the floor's power is 0 from an exponent of 6.4 on, and a
    mean of zeros has no gradient.
    """
    axes = (axis,) if isinstance(axis, int) else axis
    count = math.prod(logs.shape[i] for i in axes)
    return jnp.exp((jax.nn.logsumexp(p * logs, axis=axis) - math.log(count)) / p)
