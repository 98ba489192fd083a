"""Generalised mean of an image's patches (GeM; Radenovic et al., TPAMI 2018)."""

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
    return global_alone(generalised_mean(widen(features.patches), params.p))


def generalised_mean(
    patches: Float[Array, "*batch patch dim"], p: Float[Array, ""]
) -> Float[Array, "*batch dim"]:
    """(mean of x^p)^(1/p) over unit patches, channel by channel (Radenovic et al., Eq. 3)."""
    return unit_powers(patches, p).mean(axis=-2) ** (1 / p)


def unit_powers(
    patches: Float[Array, "*batch patch dim"], p: Float[Array, ""]
) -> Float[Array, "*batch patch dim"]:
    """Each patch scaled to length 1, every number above the floor, to the power of `p`.

    Unit length and floor are those of CosPlace, CricaVPR and the benchmark of Berton et al. (CVPR
    2022).
    """
    return jnp.maximum(l2_normalise(patches), GEM_FLOOR) ** p
