"""Patch-NetVLAD: VLADs of windows of several sizes (Hausler et al., CVPR 2021, section 3)."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from crisalad_jax.nn.aggregators.netvlad import NetVlad, shares
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.layers import at_least_float32, l2_normalise
from crisalad_jax.nn.model import Crisalad, Images, unit_features
from crisalad_jax.retrieval.reranking.matching import mutual_matches, spatial_score
from crisalad_jax.utils import compiler
from crisalad_jax.utils.errors import InputError

Grid = tuple[int, int]

WINDOWS = ((2, 0.45), (5, 0.15), (8, 0.4))
"""Sides in patches and weights of the paper's multi-scale score; windows are a patch apart."""


def windows_of(config: ModelConfig) -> list[tuple[int, float, Grid]]:
    """List side, weight, and rows and columns of the windows that fit this model's images.

    Sizes of which fewer than 2 x 2 fit are left out: a single window cannot be displaced.

    Raises:
        InputError: no size is left.
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
            f"{smallest}, of which 2 x 2 of the smallest windows fit"
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

    Assigned residuals are summed, normalised cluster by cluster, and as a whole. Sums are shared by
    neighbouring windows along rows, then along columns. The paper's integral features take fewer
    additions, but subtract large sums. For a cluster with little mass in a window only rounding
    errors would remain, which the normalisation would scale up.
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
    """Return the number of windows of an image, of all sizes, and the length of a descriptor.

    Raises:
        InputError: what `windows_of` raises.
    """
    windows = sum(rows * columns for _, _, (rows, columns) in windows_of(config))
    return windows, config.token_shape.tokens * config.backbone.dim


@functools.partial(compiler.jit, static_argnames="config")
def describe(
    params: Crisalad, images: Images, config: ModelConfig
) -> Float[Array, "image window vlad"]:
    """Compute unit descriptors of all windows, the smallest size first, in float16."""
    aggregator = params.aggregator
    assert isinstance(aggregator, NetVlad)
    features = unit_features(params, images, config)
    assignment = shares(aggregator.conv, features)

    def of_one(image: tuple[Array, Array]) -> Array:
        parts = [
            window_vlads(*image, at_least_float32(aggregator.centroids), config.grid, side)
            for side, _, _ in windows_of(config)
        ]
        return jnp.concatenate(parts).astype(jnp.float16)

    # Images run one after the other: the residuals of one are as large as all of its windows.
    return jax.lax.map(of_one, (assignment, features))


def score(
    query: Float[np.ndarray, "window vlad"],
    candidates: Float[np.ndarray, "candidate window vlad"],
    config: ModelConfig,
) -> Float[np.ndarray, " candidate"]:
    """Sum the spatial scores of all sizes of windows, weighted (paper Eq. 6)."""
    return np.asarray(_scores(query, candidates, config))


@functools.partial(compiler.jit, static_argnames="config")
def _scores(
    query: Float[Array, "window vlad"],
    candidates: Float[Array, "candidate window vlad"],
    config: ModelConfig,
) -> Float[Array, " candidate"]:
    def of_one(candidate: Array) -> Array:
        total, start = jnp.zeros(()), 0
        for _, weight, grid in windows_of(config):
            part = slice(start, start + grid[0] * grid[1])
            matches = mutual_matches(query[part], candidate[part])
            total += weight * spatial_score(matches, grid)
            start = part.stop
        return total

    return jax.vmap(of_one)(candidates)
