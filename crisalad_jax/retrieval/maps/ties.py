"""Break ties by the lower number, for searches that return equal similarities in any order."""

from collections.abc import Callable

import numpy as np

from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.utils.shapes import Float32

Ask = Callable[[Float32[np.ndarray, "q d"], int], Neighbours]
"""Takes queries and k; returns the k most similar of each, equal ones in any order."""


def lower_first(
    ask: Ask,
    queries: Float32[np.ndarray, "q d"],
    k: int,
    count: int,
    *,
    spare: int = 1,
    margin: float = 0.0,
) -> Neighbours:
    """Search so that equal similarities are ordered by number, also at the k-th place.

    Some more than k are asked for. Where the last of them is as similar as the k-th, there may be
    more equal ones. Such queries ask again for more, until the last is less similar.

    Args:
        ask: the search.
        queries: unit descriptors.
        k: neighbours per query, at most `count`.
        count: how many descriptors there are.
        spare: number of neighbours beyond k that are asked for at first.
        margin: by how much a descriptor that `ask` left out may exceed the last that it returned.
    """
    asked = min(k + spare, count)
    answer = _in_order(ask(queries, asked))
    indices, similarities = answer.indices[:, :k].copy(), answer.similarities[:, :k].copy()
    rows = np.arange(len(queries))
    while asked < count:
        open_still = answer.similarities[:, k - 1] <= answer.similarities[:, -1] + margin
        rows = rows[open_still]
        if not len(rows):
            break
        asked = min(2 * asked, count)
        answer = _in_order(ask(queries[rows], asked))
        indices[rows], similarities[rows] = answer.indices[:, :k], answer.similarities[:, :k]
    return Neighbours(indices, similarities)


def _in_order(neighbours: Neighbours) -> Neighbours:
    order = np.lexsort((neighbours.indices, -neighbours.similarities))
    return Neighbours(*(np.take_along_axis(array, order, axis=1) for array in neighbours))
