"""A second stage that scores two images by the Sinkhorn divergence of their local tokens."""

import functools

import jax.numpy as jnp
from jaxtyping import Array, Float

from crisalad_jax.config.checks import require
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.layers import l2_normalise
from crisalad_jax.nn.model import AnyArray, Crisalad, Images, extract_tokens
from crisalad_jax.nn.transport.divergence import sinkhorn_divergence
from crisalad_jax.utils import compiler


def shape(config: ModelConfig) -> tuple[int, int]:
    """Return the number of local tokens of an image, and their width.

    Raises:
        InputError: the aggregator of the model has no local tokens.
    """
    _, tokens, dim = config.token_shape
    require(
        tokens > 0,
        f"rerank: found a model with aggregator {config.aggregator.part_name}, which has no local "
        "tokens, expected one that has them, such as salad",
    )
    return tokens, dim


@functools.partial(compiler.jit, static_argnames="config")
def describe(
    params: Crisalad, images: Images, config: ModelConfig
) -> Float[Array, "image token dim"]:
    """Compute the local tokens of every image independently, as unit vectors in float16."""
    return l2_normalise(extract_tokens(params, images, config).local).astype(jnp.float16)


@functools.partial(compiler.jit, static_argnames="config")
def scores(
    query: Float[AnyArray, "token dim"],
    candidates: Float[AnyArray, "candidate token dim"],
    config: ModelConfig,
) -> Float[Array, " candidate"]:
    """Compute each candidate's negative divergence from the query (Feydy et al., AISTATS 2019)."""
    ours = jnp.broadcast_to(query, candidates.shape)
    return -sinkhorn_divergence(ours, jnp.asarray(candidates))
