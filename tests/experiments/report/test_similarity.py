"""The matrix of similarities: its cells by brute force, its marks by their colours."""

import numpy as np
import pytest

from crisalad_jax.evaluation.similarity import cells_of
from crisalad_jax.experiments.report.similarity import _outlines, similarity_matrix, truth_cells
from crisalad_jax.utils.errors import InputError
from tests.experiments.report.pictures import GREEN, RED, is_colour, read_picture


def test_truth_by_brute_force():
    positives = [np.array(p, int) for p in ([0, 6], [], [3], [4], [6])]
    found = truth_cells(positives, 7, (3, 2))
    expected = np.zeros((3, 2), bool)
    for query, wanted in enumerate(positives):
        for index in wanted:
            expected[cells_of(5, 3)[query], cells_of(7, 2)[index]] = True
    np.testing.assert_array_equal(found, expected)
    assert found.tolist() == [[True, True], [True, True], [False, True]]


def test_outlines_by_hand():
    lines = {tuple(map(tuple, line)) for line in _outlines(np.array([[True, True], [False, True]]))}
    assert lines == {
        ((0, 0), (1, 0)),
        ((1, 0), (2, 0)),
        ((0, 1), (1, 1)),
        ((1, 2), (2, 2)),
        ((0, 0), (0, 1)),
        ((1, 1), (1, 2)),
        ((2, 0), (2, 1)),
        ((2, 1), (2, 2)),
    }


def test_the_matrix_shows_similarities_truth_and_first_retrievals(tmp_path):
    similarities = np.array([[0.9, 0.1, 0.1], [0.1, 0.1, 0.8]], np.float32)
    positives = [np.array([0]), np.array([1])]
    path = tmp_path / "matrix.png"
    similarity_matrix(path, similarities, positives, np.array([0, 2]), 3)
    picture = read_picture(path)
    green, red = (np.argwhere(is_colour(picture, colour)) for colour in (GREEN, RED))
    # The first query's retrieval is right, above and left of the second's, which is not.
    assert (green.mean(axis=0) < red.mean(axis=0)).all()
    # About both dots it is dark, and right of the first light.
    row, column = green.mean(axis=0).astype(int)
    cell = (red.mean(axis=0)[1] - green.mean(axis=0)[1]) / 2
    assert picture[row, column + 20].max() < 100
    assert picture[row, int(column + cell)].min() > 200
    outlined = np.argwhere(is_colour(picture, (0xD5, 0x5E, 0x00)))
    assert outlined[:, 0].min() < row < outlined[:, 0].max()
    with pytest.raises(
        InputError, match=r"^similarities: found \(2, 3\), expected at most \(2, 2\)"
    ):
        similarity_matrix(path, similarities, positives, np.array([0, 1]), 2)
