"""Of equal similarities the lower number, from searches that take any of them."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float32

from crisalad_jax.retrieval import Neighbours

Ask = Callable[[Float32[np.ndarray, "q d"], int], Neighbours]
"""Queries and k, to the k most similar of each, the order of equals being no matter."""


def lower_first(
    ask: Ask,
    queries: Float32[np.ndarray, "q d"],
    k: int,
    count: int,
    *,
    spare: int = 1,
    margin: float = 0.0,
) -> Neighbours:
    """What `ask` finds among `count` descriptors, equal ones by number, also at the k-th place.

    Some more than k are asked for. Where the last of them is as similar as the k-th, there may be
    others: those queries ask for more, until the last is less similar.

    Args:
        ask: the search.
        queries: unit descriptors.
        k: neighbours per query, at most `count`.
        count: how many descriptors there are.
        spare: how many more than k are asked for at first.
        margin: how much more similar than all that it gave may be what `ask` left out.
    """
    asked = min(k + spare, count)
    found = _in_order(ask(queries, asked))
    indices, similarities = found.indices[:, :k].copy(), found.similarities[:, :k].copy()
    rows = np.arange(len(queries))
    while asked < count:
        open_still = found.similarities[:, k - 1] <= found.similarities[:, -1] + margin
        rows = rows[open_still]
        if not len(rows):
            break
        asked = min(2 * asked, count)
        found = _in_order(ask(queries[rows], asked))
        indices[rows], similarities[rows] = found.indices[:, :k], found.similarities[:, :k]
    return Neighbours(indices, similarities)


def _in_order(found: Neighbours) -> Neighbours:
    order = np.lexsort((found.indices, -found.similarities))
    return Neighbours(*(np.take_along_axis(array, order, axis=1) for array in found))
