"""TransVPR's re-ranking: key patches that one homography takes to the other image's."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from crisalad_jax.nn.aggregators.transvpr import TransVpr, TransVprConfig, key_features
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, Images, extract_features
from crisalad_jax.retrieval.reranking.matching import inliers, mutual_matches
from crisalad_jax.utils import compiler


def shape(config: ModelConfig) -> tuple[int, int]:
    """Return the number of patches of an image, and the length of a patch's feature."""
    return config.patches, config.backbone.dim


@functools.partial(compiler.jit, static_argnames="config")
def describe(
    params: Crisalad, images: Images, config: ModelConfig
) -> Float[Array, "image patch dim"]:
    """Compute `key_features` of every image, in float16."""
    assert isinstance(params.aggregator, TransVpr)
    assert isinstance(config.aggregator, TransVprConfig)
    levels = config.aggregator.levels
    patches = extract_features(params, images, config).patches
    return key_features(params.aggregator, patches, levels).astype(jnp.float16)


def score(
    query: Float[np.ndarray, "patch dim"],
    candidates: Float[np.ndarray, "candidate patch dim"],
    config: ModelConfig,
) -> Float[np.ndarray, " candidate"]:
    """Count the mutual matches of key patches that are inliers of RANSAC (paper section 3.3)."""
    matches = np.asarray(_matches(jnp.asarray(query), jnp.asarray(candidates)))
    return np.array([inliers(each, config.grid) for each in matches], np.float32)


@compiler.jit
def _matches(
    query: Float[Array, "patch dim"], candidates: Float[Array, "candidate patch dim"]
) -> Int[Array, "candidate patch"]:
    return jax.vmap(functools.partial(mutual_matches, query))(candidates)
