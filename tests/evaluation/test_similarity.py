"""The map of similarities, by brute force."""

import numpy as np
import pytest

from crisalad_jax.evaluation import similarity
from crisalad_jax.evaluation.similarity import cells_of, similarity_map
from crisalad_jax.utils.errors import InputError


def random_unit(seed: int, count: int, length: int) -> np.ndarray:
    rows = np.random.default_rng(seed).standard_normal((count, length)).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


@pytest.mark.parametrize("most", [400, 5, 3, 1])
def test_every_cell_is_the_largest_of_its_images(most, monkeypatch):
    """Blocks smaller than the sets, whose last ones are not full."""
    monkeypatch.setattr(similarity, "_QUERY_CHUNK", 4)
    monkeypatch.setattr(similarity, "_DATABASE_CHUNK", 6)
    database, queries = random_unit(2, 13, 8), random_unit(3, 7, 8)
    every = queries @ database.T
    rows, columns = cells_of(7, most), cells_of(13, most)
    expected = np.array(
        [
            [every[np.ix_(rows == row, columns == column)].max() for column in np.unique(columns)]
            for row in np.unique(rows)
        ]
    )
    found = similarity_map(database, queries, most=most)
    assert found.shape == (min(7, most), min(13, most))
    # Sums of eight products in float32.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


def test_cells_are_even_and_in_order():
    assert cells_of(5, 9).tolist() == [0, 1, 2, 3, 4]
    cells = cells_of(1003, 10)
    assert (np.diff(cells) >= 0).all()
    assert set(np.bincount(cells)) == {100, 101}


def test_what_is_given_is_checked():
    unit = np.eye(3, dtype=np.float32)
    with pytest.raises(InputError, match=r"^database: row 0 is of length 2"):
        similarity_map(2 * unit, unit)
    with pytest.raises(InputError, match=r"^queries: found shape .*, expected \(images, 3\)"):
        similarity_map(unit, unit[:, :2])
