"""Match the patches of two images, and score pairs by their matches as SelaVPR and TransVPR do."""

import dataclasses
import functools
import math

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from crisalad_jax.nn.aggregators.selavpr import SelaVpr, SelaVprConfig, local_features
from crisalad_jax.nn.aggregators.selavprpp import (
    SelaVprPpConfig,
    SelaVprPpHash,
    SelaVprPpHashConfig,
)
from crisalad_jax.nn.aggregators.transvpr import TransVpr, TransVprConfig, key_features
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import AnyArray, Crisalad, Images, describe, extract_features
from crisalad_jax.utils import compiler

Features = Float[np.ndarray, "*candidate feature dim"]
"""Local features of an image, or of each candidate."""
Scores = Float[np.ndarray, "candidate *part"]
"""Scores of a query's candidates: one each, or one for each part, such as a window size."""
INLIER_DISTANCE = 1.5
"""Maximum distance, in patches, of an inlier from its match under the homography (public code)."""
_LEAST_MATCHES = 4
"""Minimum number of matches for a homography."""


def mutual_matches(
    query: Float[AnyArray, "m d"], candidate: Float[AnyArray, "n d"], above: float = -math.inf
) -> Int[Array, " m"]:
    """Find the mutual nearest patch in the candidate, by index, for each patch of the query.

    The nearest patch has the largest inner product; ties go to the first. The result is -1 where
    there is no mutual match with a product above `above`. All-zero patches match nothing.
    """
    query, candidate = query.astype(jnp.float32), candidate.astype(jnp.float32)
    products = jnp.matmul(query, candidate.T, precision=jax.lax.Precision.HIGHEST)
    ours, theirs = jnp.any(query != 0, axis=1), jnp.any(candidate != 0, axis=1)
    products = jnp.where(ours[:, None] & theirs, products, -jnp.inf)
    forward, backward = products.argmax(axis=1), products.argmax(axis=0)
    mutual = backward[forward] == jnp.arange(len(query))
    return jnp.where(mutual & (products.max(axis=1) > above), forward, -1)


def spatial_score(matches: Int[Array, " m"], grid: tuple[int, int]) -> Float[Array, ""]:
    """Compute Patch-NetVLAD's rapid spatial score (Hausler et al., CVPR 2021, section 3.4).

    For each match, in rows and in columns, the deviation of its displacement from the mean is
    subtracted from the largest displacement that the grid allows. The squared differences are
    summed and divided by the number of patches. A negative difference counts as 0, although the
    printed formula squares it.

    Args:
        matches: from `mutual_matches`, of patches in row order.
        grid: rows and columns of patches, the same for both images.
    """
    here = _places(jnp.arange(len(matches)), grid)
    moved = (_places(matches, grid) - here).astype(jnp.float32)
    matched = (matches >= 0)[:, None]
    mean = jnp.where(matched, moved, 0).sum(axis=0) / jnp.maximum(matched.sum(), 1)
    largest = jnp.asarray([side - 1 for side in grid], jnp.float32)
    near = jnp.maximum(largest - jnp.abs(moved - mean), 0)
    return jnp.where(matched, near**2, 0).sum() / len(matches)


def _places(patches: Int[Array, " m"], grid: tuple[int, int]) -> Int[Array, "m 2"]:
    return jnp.stack([patches // grid[1], patches % grid[1]], axis=1)


def inliers(matches: Int[np.ndarray, " m"], grid: tuple[int, int]) -> int:
    """Count the matches that one homography explains, found by RANSAC with a fixed seed.

    The arguments are those of `spatial_score`. With fewer than four matches, the count is 0.
    """
    query = np.flatnonzero(matches >= 0)
    if len(query) < _LEAST_MATCHES:
        return 0
    there = matches[query]
    before, after = (
        np.stack([patches % grid[1], patches // grid[1]], axis=1).astype(np.float32)
        for patches in (query, there)
    )
    cv2.setRNGSeed(0)
    _, mask = cv2.findHomography(before, after, cv2.RANSAC, INLIER_DISTANCE)
    return 0 if mask is None else int(np.count_nonzero(mask))


@functools.partial(compiler.jit, static_argnames="above")
def match_all(
    query: Float[AnyArray, "m d"],
    candidates: Float[AnyArray, "candidate n d"],
    above: float = -math.inf,
) -> Int[Array, "candidate m"]:
    """Match a query's patches with those of each candidate; see `mutual_matches`."""
    # One at a time: the products of a pair of 224 x 224 images in SelaVPR take 55 MB.
    return jax.lax.map(functools.partial(mutual_matches, query, above=above), candidates)


def selavpr_shape(config: ModelConfig) -> tuple[int, int]:
    """Return the number of local features of an image, and their width."""
    assert isinstance(config.aggregator, SelaVprConfig)
    return math.prod(config.aggregator.local_grid(config.grid)), config.aggregator.local


@functools.partial(compiler.jit, static_argnames="config")
def describe_selavpr(
    params: Crisalad, images: Images, config: ModelConfig
) -> Float[Array, "image feature dim"]:
    """Compute SelaVPR's `local_features` of every image in row order, in float16."""
    assert isinstance(params.aggregator, SelaVpr)
    patches = extract_features(params, images, config).patches
    local = local_features(params.aggregator, patches, config.grid)
    return local.reshape(len(local), *selavpr_shape(config)).astype(jnp.float16)


def count_matches(query: Features, candidates: Features, config: ModelConfig) -> Scores:
    """Count the mutual matches of a query with each candidate (SelaVPR, section 3.4)."""
    matches = np.asarray(match_all(query, candidates))
    return (matches >= 0).sum(axis=1).astype(np.float32)


def selavprpp_shape(config: ModelConfig) -> tuple[int, int]:
    """Return the number of features, 1, and the length of SelaVPR++'s real-valued descriptor."""
    assert isinstance(config.aggregator, SelaVprPpHashConfig)
    return 1, config.aggregator.dim


@functools.partial(compiler.jit, static_argnames="config")
def describe_selavprpp(
    params: Crisalad, images: Images, config: ModelConfig
) -> Float[Array, "image 1 dim"]:
    """Compute SelaVPR++'s real-valued descriptor of every image, a unit vector."""
    assert isinstance(params.aggregator, SelaVprPpHash)
    assert isinstance(config.aggregator, SelaVprPpHashConfig)
    params = dataclasses.replace(params, aggregator=params.aggregator.real)
    config = dataclasses.replace(config, aggregator=SelaVprPpConfig(config.aggregator.dim))
    return describe(params, images, config)[:, None]


def nearness(query: Features, candidates: Features, config: ModelConfig) -> Scores:
    """Compute the negative Euclidean distance of the query's one feature to each candidate's."""
    return -np.linalg.norm(candidates[:, 0] - query[0], axis=1)


def patch_shape(config: ModelConfig) -> tuple[int, int]:
    """Return the number of patches of an image, and the length of a patch's feature."""
    return config.patches, config.backbone.dim


@functools.partial(compiler.jit, static_argnames="config")
def describe_transvpr(
    params: Crisalad, images: Images, config: ModelConfig
) -> Float[Array, "image patch dim"]:
    """Compute TransVPR's `key_features` of every image, in float16."""
    assert isinstance(params.aggregator, TransVpr)
    assert isinstance(config.aggregator, TransVprConfig)
    patches = extract_features(params, images, config).patches
    return key_features(params.aggregator, patches, config.aggregator.levels).astype(jnp.float16)


def count_inliers(query: Features, candidates: Features, config: ModelConfig) -> Scores:
    """Count each candidate's mutual matches that are RANSAC inliers (TransVPR, section 3.3)."""
    matches = np.asarray(match_all(query, candidates))
    return np.array([inliers(each, config.grid) for each in matches], np.float32)
