"""Patches of two images that are each other's nearest, and whether they lie alike."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

INLIER_DISTANCE = 1.5
"""How far a match may be from where the homography says, in patches: the public codes'."""
_LEAST_MATCHES = 4
"""A homography needs so many."""


def mutual_matches(query: Float[Array, "m d"], candidate: Float[Array, "n d"]) -> Int[Array, " m"]:
    """The candidate's patch that is nearest to each of the query's, and whose nearest it is.

    Nearest is the largest inner product; of equal ones the first. -1 where there is none; a
    patch of zeros is left out, on both sides.
    """
    query, candidate = query.astype(jnp.float32), candidate.astype(jnp.float32)
    products = jnp.matmul(query, candidate.T, precision=jax.lax.Precision.HIGHEST)
    ours, theirs = jnp.any(query != 0, axis=1), jnp.any(candidate != 0, axis=1)
    products = jnp.where(ours[:, None] & theirs, products, -jnp.inf)
    forward, backward = products.argmax(axis=1), products.argmax(axis=0)
    mutual = backward[forward] == jnp.arange(len(query))
    return jnp.where(mutual & ours & theirs[forward], forward, -1)


def spatial_score(matches: Int[Array, " m"], grid: tuple[int, int]) -> Float[Array, ""]:
    """Patch-NetVLAD's rapid spatial score (Hausler et al., CVPR 2021, section 3.4).

    Of each match the displacement on the grid, less the mean of all, is taken from the largest that
    there can be; the squares, over rows and columns, are summed and divided by the patches. A
    displacement further off than the largest adds nothing, where the formula as printed would
    add its square again.

    Args:
        matches: from `mutual_matches`, of patches in row order.
        grid: rows and columns of patches, the same of both images.
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
    """How many matches one homography explains, found by RANSAC from a fixed seed.

    The arguments are those of `spatial_score`. Fewer than four matches are explained by none.
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
    _, kept = cv2.findHomography(before, after, cv2.RANSAC, INLIER_DISTANCE)
    return 0 if kept is None else int(np.count_nonzero(kept))
