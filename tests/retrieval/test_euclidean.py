"""Ranking by Euclidean distance with the search for unit vectors."""

import numpy as np
import pytest

from crisalad_jax.retrieval.euclidean import to_unit_vectors
from crisalad_jax.retrieval.search import search
from crisalad_jax.utils.errors import InputError


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64])
def test_cosines_rank_as_distances(kind: type) -> None:
    rng = np.random.default_rng(0)
    sides = [
        (rng.normal(size=(count, 9)) * rng.uniform(0.1, 20, (count, 1))).astype(kind)
        for count in (300, 40)
    ]
    found = search(*to_unit_vectors(*sides), 5)
    database, queries = (side.astype(np.float64) for side in sides)
    squares = np.square(queries[:, None] - database).sum(axis=2)
    np.testing.assert_array_equal(found.indices, squares.argsort(axis=1, kind="stable")[:, :5])
    largest = max(np.square(side).sum(axis=1).max() for side in (database, queries))
    nearest = np.take_along_axis(squares, found.indices, axis=1)
    expected = (np.square(queries).sum(axis=1, keepdims=True) - nearest) / largest / 3
    # Float32 of a unit vector's numbers.
    np.testing.assert_allclose(found.similarities, expected, atol=3e-7, rtol=0)


def test_zeros_are_embedded() -> None:
    found = search(*to_unit_vectors(np.zeros((2, 3)), np.zeros((1, 3))), 1)
    assert found.indices.tolist() == [[0]]


def test_bad_sides_are_named() -> None:
    with pytest.raises(InputError, match=r"^queries: found numbers that are not finite in row 1$"):
        to_unit_vectors(np.zeros((2, 2)), np.array([[0.0, 1.0], [np.nan, 0.0]]))
    with pytest.raises(InputError, match=r"^queries: found descriptors of length 3"):
        to_unit_vectors(np.zeros((2, 2)), np.zeros((2, 3)))
