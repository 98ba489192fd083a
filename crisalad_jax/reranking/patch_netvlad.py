"""Patch-NetVLAD: VLADs of windows of several sizes (Hausler et al., CVPR 2021, section 3)."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from crisalad_jax import platform
from crisalad_jax.config import PATCH_SIZE, ModelConfig
from crisalad_jax.errors import InputError
from crisalad_jax.model import Crisalad, Images, unit_features
from crisalad_jax.nn.aggregators.netvlad import NetVlad, shares
from crisalad_jax.nn.layers import l2_normalise, widen
from crisalad_jax.reranking.matching import mutual_matches, spatial_score

Grid = tuple[int, int]

WINDOWS = ((2, 0.45), (5, 0.15), (8, 0.4))
"""Sides in patches and weights of the paper's multi-scale score; windows are a patch apart."""


def windows_of(config: ModelConfig) -> list[tuple[int, float, Grid]]:
    """Side, weight, and rows and columns of the windows that images of this model have.

    Sizes of which fewer than 2 x 2 fit are left out: one window alone cannot be displaced.

    Raises:
        InputError: none is left.
    """
    rows, columns = config.grid
    fitting = [
        (side, weight, (rows - side + 1, columns - side + 1))
        for side, weight in WINDOWS
        if min(rows, columns) > side
    ]
    if not fitting:
        smallest = PATCH_SIZE * (WINDOWS[0][0] + 1)
        height, width = config.image_size
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
    """A VLAD for every window of side x side patches, in row order (paper Eq. 2 and 4).

    Assigned residuals are summed, normalised cluster by cluster, and as a whole. Neighbouring
    windows share sums along rows, and then along columns. The paper's integral features would take
    fewer additions, but differences of large sums: of a cluster with little in a window they leave
    rounding alone, to which the normalisation would give the weight of any other.
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
    """How many windows an image has, of all sizes, and numbers in each one's descriptor.

    Raises:
        InputError: what `windows_of` raises.
    """
    windows = sum(rows * columns for _, _, (rows, columns) in windows_of(config))
    return windows, config.netvlad.clusters * config.backbone.dim


@functools.partial(platform.jit, static_argnames="config")
def describe(
    params: Crisalad, images: Images, config: ModelConfig
) -> Float[Array, "image window vlad"]:
    """Unit descriptors of the windows of all sizes, the smallest first, in float16."""
    aggregator = params.aggregator
    assert isinstance(aggregator, NetVlad)
    features = unit_features(params, images, config)
    assignment = shares(aggregator, features)

    def of_one(image: tuple[Array, Array]) -> Array:
        parts = [
            window_vlads(*image, widen(aggregator.centroids), config.grid, side)
            for side, _, _ in windows_of(config)
        ]
        return jnp.concatenate(parts).astype(jnp.float16)

    # One after the other: an image's residuals are as large as all of its windows.
    return jax.lax.map(of_one, (assignment, features))


def score(
    query: Float[np.ndarray, "window vlad"],
    candidates: Float[np.ndarray, "candidate window vlad"],
    config: ModelConfig,
) -> Float[np.ndarray, " candidate"]:
    """The weighted sum of the spatial scores of all sizes of windows (paper Eq. 6)."""
    return np.asarray(_scores(query, candidates, config))


@functools.partial(platform.jit, static_argnames="config")
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
