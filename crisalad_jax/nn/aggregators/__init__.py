"""From a backbone's features to an image's tokens: one module for each method of docs/methods.md.

Each has `init(key, config)` and `apply(params, features, grid, config, key=...)`, of which
`_METHODS` is the table.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config import ModelConfig, choose
from crisalad_jax.nn.aggregators import (
    anyloc,
    boq,
    conv_ap,
    cosplace,
    gem,
    gem_pyramid,
    mixvpr,
    netvlad,
    transvpr,
)
from crisalad_jax.nn.aggregators.anyloc import AnyLoc
from crisalad_jax.nn.aggregators.boq import Boq
from crisalad_jax.nn.aggregators.conv_ap import ConvAp
from crisalad_jax.nn.aggregators.cosplace import CosPlace
from crisalad_jax.nn.aggregators.gem import Gem
from crisalad_jax.nn.aggregators.gem_pyramid import GemPyramid
from crisalad_jax.nn.aggregators.mixvpr import MixVpr
from crisalad_jax.nn.aggregators.netvlad import NetVlad
from crisalad_jax.nn.aggregators.transvpr import TransVpr
from crisalad_jax.nn.layers import Keys, l2_normalise, widen
from crisalad_jax.nn.salad import Salad, init_salad, published_order, salad
from crisalad_jax.nn.tokens import Tokens, global_alone
from crisalad_jax.nn.vit import Features

Aggregator = (
    Salad | GemPyramid | Gem | NetVlad | ConvAp | CosPlace | MixVpr | AnyLoc | Boq | TransVpr
)


class Method(NamedTuple):
    """How an aggregator starts, what it does, and how its tokens lie in a descriptor."""

    init: Callable[[PRNGKeyArray, ModelConfig], Any]
    apply: Callable[..., Tokens]
    order: Callable[[Float[Array, "token dim"]], Array] = lambda local: local
    """Of the local tokens, as published."""


def _init_salad(key: PRNGKeyArray, config: ModelConfig) -> Salad:
    return init_salad(key, config.backbone.dim, config.salad)


def _salad(
    params: Salad,
    features: Features,
    grid: tuple[int, int],
    config: ModelConfig,
    *,
    key: Keys | None,
) -> Tokens:
    return salad(params, features, config.salad, key=key)


def _class_token(
    params: None,
    features: Features,
    grid: tuple[int, int],
    config: ModelConfig,
    *,
    key: Keys | None,
) -> Tokens:
    return global_alone(widen(features.class_token))


_METHODS = {
    "salad": Method(_init_salad, _salad, published_order),
    "gem-pyramid": Method(gem_pyramid.init, gem_pyramid.apply),
    "netvlad": Method(netvlad.init, netvlad.apply),
    "anyloc": Method(anyloc.init, anyloc.apply),
    "class-token": Method(lambda key, config: None, _class_token),
    "transvpr": Method(transvpr.init, transvpr.apply),
    "gem": Method(gem.init, gem.apply),
    "conv-ap": Method(conv_ap.init, conv_ap.apply, published_order),
    "cosplace": Method(cosplace.init, cosplace.apply),
    "mixvpr": Method(mixvpr.init, mixvpr.apply, published_order),
    "boq": Method(boq.init, boq.apply, published_order),
}


def init_aggregator(key: PRNGKeyArray, config: ModelConfig) -> Aggregator | None:
    """Random parameters of `config.aggregator`; a class token has none."""
    return choose("aggregator", config.aggregator, _METHODS).init(key, config)


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
    method = choose("aggregator", config.aggregator, _METHODS)
    return method.apply(params, features, grid, config, key=key)


def join(tokens: Tokens, config: ModelConfig) -> Float[Array, " descriptor"]:
    """One unit descriptor: the global token, then the local ones in the published order."""
    local = choose("aggregator", config.aggregator, _METHODS).order(tokens.local)
    return l2_normalise(jnp.concatenate([tokens.global_token, local.ravel()]))
