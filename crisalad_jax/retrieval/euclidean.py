"""Rank descriptors of any length by their Euclidean distances, with the search for unit vectors."""

import numpy as np

from crisalad_jax.retrieval.chunks import as_sides
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Float, Float32


def to_unit_vectors(
    database: Float[np.ndarray, "n d"], queries: Float[np.ndarray, "q d"]
) -> tuple[Float32[np.ndarray, "n d+3"], Float32[np.ndarray, "q d+3"]]:
    r"""Embed descriptors so that their cosines rank as the Euclidean distances do.

    With both sides divided by the largest length, x of the database and y of the queries become

    $$\left(\sqrt{\tfrac23}\,x,\ \tfrac{|x|^2}{\sqrt3},\ a,\ 0\right) \quad\text{and}\quad
    \left(\sqrt{\tfrac23}\,y,\ -\tfrac{1}{\sqrt3},\ 0,\ b\right),$$

    where a and b fill the lengths up to 1. The cosine is then (|y|^2 - |x - y|^2) / 3.

    Args:
        database: descriptors of the n database images, of any lengths.
        queries: descriptors of the q queries, of any lengths.

    Returns:
        Unit vectors of both sides, three numbers longer.

    Raises:
        InputError: a side is no matrix, or empty; the sides' widths differ; a number is not finite.

    Example:
        >>> import numpy as np
        >>> from crisalad_jax import search
        >>> database = np.array([[9.0, 9.0], [1.0, 2.0]])
        >>> search(*to_unit_vectors(database, np.array([[2.0, 2.0]])), 1).indices.tolist()
        [[1]]
    """
    sides = as_sides(database, queries)
    lengths = [np.linalg.norm(side.astype(np.float64), axis=1) for side in sides]
    for name, found in zip(("database", "queries"), lengths, strict=True):
        if not np.isfinite(found).all():
            row = np.argmin(np.isfinite(found))
            raise InputError(f"{name}: found numbers that are not finite in row {row}")
    largest = max(1e-30, *(found.max() for found in lengths))
    squares = [np.square(found / largest) for found in lengths]
    last = np.sqrt(1 / 3) * squares[0], np.full_like(squares[1], -np.sqrt(1 / 3))
    embedded = []
    for number, (side, square, third) in enumerate(zip(sides, squares, last, strict=True)):
        unit = np.zeros((len(side), side.shape[1] + 3), np.float32)
        unit[:, :-3] = np.sqrt(2 / 3) / largest * side
        unit[:, -3] = third
        unit[:, -2 + number] = np.sqrt(np.maximum(0, 1 - 2 / 3 * square - third**2))
        embedded.append(unit)
    return embedded[0], embedded[1]
