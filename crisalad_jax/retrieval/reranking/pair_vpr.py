"""Pair-VPR's second stage: a decoder's scores of pairs of images (Hausler and Moghadam, 2025)."""

import functools

import jax.numpy as jnp
from jaxtyping import Array, Float

from crisalad_jax.nn.aggregators.pair_vpr import PairVprConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import AnyArray, Crisalad, Images, extract_features
from crisalad_jax.utils import compiler


@functools.partial(compiler.jit, static_argnames="config")
def describe(
    params: Crisalad, images: Images, config: ModelConfig
) -> Float[Array, "image patch dim"]:
    """Compute the patches of every image after the backbone's last layer norm, in float16."""
    return extract_features(params, images, config).patches.astype(jnp.float16)


@functools.partial(compiler.jit, static_argnames="config")
def scores(
    params: Crisalad,
    query: Float[AnyArray, "patch dim"],
    candidates: Float[AnyArray, "candidate patch dim"],
    config: ModelConfig,
) -> Float[Array, " candidate"]:
    """Score each candidate: sum the decoder's logits of (query, candidate) and the reverse pair."""
    assert isinstance(config.aggregator, PairVprConfig)
    theirs = jnp.asarray(candidates, config.compute_dtype)
    ours = jnp.broadcast_to(jnp.asarray(query, config.compute_dtype), theirs.shape)
    first, second = jnp.concatenate([ours, theirs]), jnp.concatenate([theirs, ours])
    logits = config.aggregator.logits(params.aggregator, first, second, config.grid)
    return logits.reshape(2, -1).sum(axis=0)
