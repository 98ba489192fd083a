"""SelaVPR's re-ranking: the number of local features that are each other's nearest."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from crisalad_jax.nn.aggregators.selavpr import SelaVpr, SelaVprConfig, local_features
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, Images, extract_features
from crisalad_jax.retrieval.reranking.matching import mutual_matches
from crisalad_jax.utils import compiler


def shape(config: ModelConfig) -> tuple[int, int]:
    """Return the number of local features of an image, and their width."""
    assert isinstance(config.aggregator, SelaVprConfig)
    return math.prod(config.aggregator.local_grid(config.grid)), config.aggregator.local


@functools.partial(compiler.jit, static_argnames="config")
def describe(
    params: Crisalad, images: Images, config: ModelConfig
) -> Float[Array, "image feature dim"]:
    """Compute `local_features` of every image in row order, in float16."""
    assert isinstance(params.aggregator, SelaVpr)
    patches = extract_features(params, images, config).patches
    local = local_features(params.aggregator, patches, config.grid)
    return local.reshape(len(local), *shape(config)).astype(jnp.float16)


def score(
    query: Float[np.ndarray, "feature dim"],
    candidates: Float[np.ndarray, "candidate feature dim"],
    config: ModelConfig,
) -> Float[np.ndarray, " candidate"]:
    """Count the mutual matches (paper section 3.4)."""
    return np.asarray(_counts(jnp.asarray(query), jnp.asarray(candidates)))


@compiler.jit
def _counts(
    query: Float[Array, "feature dim"], candidates: Float[Array, "candidate feature dim"]
) -> Float[Array, " candidate"]:
    def of_one(candidate: Array) -> Array:
        return (mutual_matches(query, candidate) >= 0).sum().astype(jnp.float32)

    # One after the other: the products of one pair are 55 MB for images of 224 x 224.
    return jax.lax.map(of_one, candidates)
