"""The head of CosPlace (Berton et al., CVPR 2022) and EigenPlaces (ICCV 2023)."""

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config import ModelConfig
from crisalad_jax.nn.aggregators.gem import START, generalised_mean, log_units
from crisalad_jax.nn.layers import Keys, Linear, init_linear, linear, widen
from crisalad_jax.nn.tokens import Tokens, global_alone
from crisalad_jax.nn.vit import Features
from crisalad_jax.pytree import params


@params
class CosPlace:
    """The exponent of the generalised mean, and the linear layer behind it."""

    p: Float[Array, ""]
    fc: Linear


def init(key: PRNGKeyArray, config: ModelConfig) -> CosPlace:
    """Start as the public implementation: an exponent of 3, torch's default linear layer."""
    fc = init_linear(key, config.backbone.dim, config.cosplace.dim)
    return CosPlace(jnp.full((), START), fc)


def apply(
    params: CosPlace,
    features: Features,
    grid: tuple[int, int],
    config: ModelConfig,
    *,
    key: Keys | None,
) -> Tokens:
    """Unit patches, their generalised mean, a linear layer; the descriptor's length comes last."""
    mean = generalised_mean(log_units(widen(features.patches)), params.p, axis=-2)
    return global_alone(widen(linear(params.fc, mean.astype(features.patches.dtype))))
