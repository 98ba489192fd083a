"""Nearest neighbours, and their similarities: what all searches have in common, without JAX."""

import math
from typing import NamedTuple

import numpy as np

from crisalad_jax.config.short_repr import brief
from crisalad_jax.retrieval.chunks import UNIT_TOLERANCE
from crisalad_jax.utils.shapes import Float, Float32, Int, Int64

_PIECE = 2**17
"""Size of a piece that is multiplied in float64, in numbers: 1 MiB, which fits a core's cache."""


@brief
class Neighbours(NamedTuple):
    """The most similar database images of each query, best first."""

    indices: Int64[np.ndarray, "q k"]
    similarities: Float32[np.ndarray, "q k"]


def rounding(length: int) -> float:
    """Bound the rounding error of a float32 product of two descriptors, in any order of sums.

    The probabilistic bound of Higham and Mary (2019), lambda sqrt(n) u, at lambda = 8, where it
    fails less than once in 10^9 products; the sum of |a_i b_i| is at most the lengths' product.
    """
    return 8 * math.sqrt(length) * 2.0**-24 * (1 + UNIT_TOLERANCE) ** 2


def exact_similarities(
    queries: Float32[np.ndarray, "q d"],
    rows: Float[np.ndarray, "n d"],
    query: Int[np.ndarray, " pair"],
    row: Int[np.ndarray, " pair"],
) -> Float32[np.ndarray, " pair"]:
    """Compute products of pairs in float64, in a fixed order of sums, rounded to float32."""
    similarities = np.empty(len(query), np.float32)
    size = max(1, _PIECE // queries.shape[1])
    for start in range(0, len(query), size):
        piece = slice(start, start + size)
        products = rows[row[piece]].astype(np.float64)
        products *= queries[query[piece]]
        similarities[piece] = products.sum(axis=1)
    return similarities + np.float32(0)  # turns -0.0 into 0.0, so that both sort alike
