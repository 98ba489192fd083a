"""Patch-NetVLAD: VLADs of windows of several sizes (Hausler et al., CVPR 2021, section 3).

Where the paper leaves something open, this follows the authors' code (QVPR/Patch-NetVLAD).
"""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from crisalad_jax.nn.aggregators.vlad import NetVlad, shares
from crisalad_jax.nn.config import ModelConfig, check_unit_length
from crisalad_jax.nn.layers import at_least_float32, l2_normalise
from crisalad_jax.nn.model import AnyArray, Crisalad, Images, unit_features
from crisalad_jax.nn.projection import project
from crisalad_jax.retrieval.reranking.matching import (
    Features,
    Scores,
    inliers,
    mutual_matches,
    spatial_score,
)
from crisalad_jax.utils import compiler
from crisalad_jax.utils.errors import InputError

Grid = tuple[int, int]

WINDOWS = ((2, 0.45), (5, 0.15), (8, 0.4))
"""Window sides (in patches) and weights of the paper's multi-scale score; the stride is 1."""


def windows_of(config: ModelConfig) -> list[tuple[int, float, Grid]]:
    """List side, weight and grid (rows, columns) of the window sizes that fit a model's images.

    Sizes of which fewer than 2 x 2 windows fit are left out: a single window cannot be displaced.

    Raises:
        InputError: no window size fits.
    """
    rows, columns = config.grid
    fitting = [
        (side, weight, (rows - side + 1, columns - side + 1))
        for side, weight in WINDOWS
        if min(rows, columns) > side
    ]
    if not fitting:
        smallest = config.backbone.patch_size * (WINDOWS[0][0] + 1)
        height, width = config.input_size
        raise InputError(
            f"patch-netvlad: found images of {height} x {width}, expected at least {smallest} x "
            f"{smallest}, in which 2 x 2 of the smallest windows fit"
        )
    return fitting


def window_vlads(
    assignment: Float[Array, "patch cluster"],
    features: Float[Array, "patch dim"],
    centroids: Float[Array, "cluster dim"],
    grid: Grid,
    side: int,
) -> Float[Array, "window vlad"]:
    """Compute a VLAD for every window of side x side patches, in row order (Eq. 2 and 4).

    A window's residuals from the centroids are weighted by `assignment`, summed, and normalised per
    cluster, then as a whole. Neighbouring windows share partial sums. The paper's integral features
    need fewer additions, but subtract large sums: for a cluster with little mass in a window, only
    rounding errors would remain, which the normalisation would scale up.
    """
    residuals = assignment[:, :, None] * (features[:, None, :] - centroids)
    sums = residuals.reshape(*grid, *centroids.shape)
    for axis in (0, 1):
        length = grid[axis] - side + 1
        shifted = (jax.lax.slice_in_dim(sums, i, i + length, axis=axis) for i in range(side))
        sums = functools.reduce(jnp.add, shifted)
    vlads = l2_normalise(sums)
    return l2_normalise(vlads.reshape(-1, centroids.size))


def shape(config: ModelConfig) -> tuple[int, int]:
    """Return the number of an image's windows, of all sizes, and the length of their descriptors.

    Raises:
        InputError: no window size fits the images, or the model's descriptors are not unit vectors.
    """
    check_unit_length(config, "rerank")
    windows = sum(rows * columns for _, _, (rows, columns) in windows_of(config))
    return windows, config.descriptor_dim


@functools.partial(compiler.jit, static_argnames="config")
def describe(
    params: Crisalad, images: Images, config: ModelConfig
) -> Float[Array, "image window dim"]:
    """Compute unit descriptors of all windows of every image, smallest size first, in float16.

    The model's projection, if it has one, reduces each window's VLAD as it does the image's.
    """
    aggregator, projection = params.aggregator, params.projection
    assert isinstance(aggregator, NetVlad)
    features = unit_features(params, images, config)
    assignment = shares(aggregator.conv, features)

    def of_size(assignment: Array, features: Array, side: int) -> Array:
        centroids = at_least_float32(aggregator.centroids)
        vlads = window_vlads(assignment, features, centroids, config.grid, side)
        return vlads if projection is None else project(projection, vlads, config.projection)

    def of_one(image: tuple[Array, Array]) -> Array:
        parts = [of_size(*image, side) for side, _, _ in windows_of(config)]
        return jnp.concatenate(parts).astype(jnp.float16)

    # One image at a time: the residuals of an image are as large as all of its windows.
    return jax.lax.map(of_one, (assignment, features))


@functools.partial(compiler.jit, static_argnames="config")
def spatial_scores(
    query: Float[AnyArray, "window dim"],
    candidates: Float[AnyArray, "candidate window dim"],
    config: ModelConfig,
) -> Float[Array, "candidate size"]:
    """Compute each candidate's rapid spatial score at each window size (paper section 3.4)."""

    def of_one(candidate: AnyArray) -> Array:
        matched = [(mutual_matches(query[w], candidate[w]), grid) for w, grid in _parts(config)]
        return jnp.stack([spatial_score(matches, grid) for matches, grid in matched])

    return jax.vmap(of_one)(candidates)


@functools.partial(compiler.jit, static_argnames="config")
def _matches_to(
    query: Float[AnyArray, "window dim"],
    candidates: Float[AnyArray, "candidate window dim"],
    config: ModelConfig,
) -> list[Int[Array, "candidate part"]]:
    def of_one(candidate: AnyArray) -> list[Array]:
        return [mutual_matches(candidate[w], query[w]) for w, _ in _parts(config)]

    return jax.vmap(of_one)(candidates)


def inlier_scores(query: Features, candidates: Features, config: ModelConfig) -> Scores:
    """Compute the share of RANSAC inliers among the windows of each size (paper section 3.4).

    As in the authors' code, the homography maps the candidate's windows to the query's.
    """
    by_size = jax.device_get(_matches_to(query, candidates, config))
    scores = [
        [inliers(each, grid) / len(each) for each in matches]
        for matches, (_, grid) in zip(by_size, _parts(config), strict=True)
    ]
    return np.array(scores, np.float32).T


def _parts(config: ModelConfig) -> list[tuple[slice, Grid]]:
    """List the slice of windows of each size, and their rows and columns."""
    grids = [grid for _, _, grid in windows_of(config)]
    bounds = itertools.accumulate((rows * columns for rows, columns in grids), initial=0)
    slices = itertools.starmap(slice, itertools.pairwise(bounds))
    return list(zip(slices, grids, strict=True))


def weighted_sum(scores: Scores, config: ModelConfig) -> Scores:
    """Sum each candidate's scores of all window sizes, weighted by `WINDOWS` (paper Eq. 6)."""
    return scores @ np.array([weight for _, weight, _ in windows_of(config)])


def standardised_sum(scores: Scores, config: ModelConfig) -> Scores:
    """Standardise the scores of each window size over a query's candidates, then sum them weighted.

    The authors' code standardises before Eq. 6. A size at which all scores are equal adds 0.
    """
    # In float64, the mean of equal float32 values is exact, so their deviation is 0.
    scores = scores.astype(np.float64)
    deviation = scores.std(axis=0)
    off = scores - scores.mean(axis=0)
    return weighted_sum(off / np.where(deviation > 0, deviation, 1), config)
