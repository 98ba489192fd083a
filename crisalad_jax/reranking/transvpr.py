"""TransVPR's re-ranking: key patches that one homography takes to the other image's."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from crisalad_jax import platform
from crisalad_jax.config import ModelConfig
from crisalad_jax.model import Crisalad, Images, features_of
from crisalad_jax.nn.aggregators.transvpr import TransVpr, key_features
from crisalad_jax.reranking.matching import inliers, mutual_matches


def shape(config: ModelConfig) -> tuple[int, int]:
    """How many patches an image has, and numbers in each one's feature."""
    return config.patches, config.backbone.dim


@functools.partial(platform.jit, static_argnames="config")
def describe(
    params: Crisalad, images: Images, config: ModelConfig
) -> Float[Array, "image patch dim"]:
    """What `key_features` gives of every image, in float16."""
    assert isinstance(params.aggregator, TransVpr)
    patches = features_of(params, images, config).patches
    return key_features(params.aggregator, patches, config).astype(jnp.float16)


def score(
    query: Float[np.ndarray, "patch dim"],
    candidates: Float[np.ndarray, "candidate patch dim"],
    config: ModelConfig,
) -> Float[np.ndarray, " candidate"]:
    """How many mutual matches of key patches are RANSAC's inliers (paper section 3.3)."""
    matches = np.asarray(_matches(query, candidates))
    return np.array([inliers(each, config.grid) for each in matches], np.float32)


@platform.jit
def _matches(
    query: Float[Array, "patch dim"], candidates: Float[Array, "candidate patch dim"]
) -> Int[Array, "candidate patch"]:
    return jax.vmap(functools.partial(mutual_matches, query))(candidates)
