"""The map and the matrix of similarities, by where their colours stand."""

import cv2
import numpy as np
import pytest

from crisalad_jax.evaluation.similarity import cells_of
from crisalad_jax.experiments.report.charts import (
    Placed,
    Verdicts,
    _outlines,
    find_placed,
    judge,
    position_map,
    similarity_matrix,
    truth_cells,
)
from crisalad_jax.retrieval.neighbours import Neighbours
from tests.experiments.report.pictures import GREEN, RED, is_colour, near_colour, read_picture

DATABASE = np.array([[1000.0, 5000.0], [1100, 5000], [1100, 5100], [1000, 5100]])
QUERIES = np.array([[1005.0, 5000.0], [1100, 5097]])
LEGEND = 110
"""Rows of the picture that the legend takes."""


def draw(path, right, matched=(True, True), first=(0, 0)):
    verdicts = Verdicts(np.array(right), np.array(matched))
    placed = Placed(np.ones(4, bool), np.ones(2, bool), np.inf)
    position_map(path, DATABASE, QUERIES, np.array(first), verdicts, placed)
    return read_picture(path)


def test_a_right_query_is_green_and_a_wrong_one_red_with_a_line_to_its_retrieval(tmp_path):
    picture = draw(tmp_path / "map.png", [True, False])
    lower = picture[LEGEND:]
    green, red = (np.argwhere(near_colour(lower, colour)) for colour in (GREEN, RED))
    # South-west is right and below left of the wrong one in the north-east.
    south_west, north_east = green.mean(axis=0), red.mean(axis=0)
    assert south_west[0] > north_east[0] + 300
    assert south_west[1] < north_east[1] - 300
    # Thin and pale, the line passes half-way to the retrieval, five metres west of the green dot.
    reddish = np.argwhere(lower[..., 0].astype(int) - lower[..., 1] > 30)
    middle = (south_west + north_east) / 2
    assert np.abs(reddish - middle).sum(axis=1).min() < 40
    assert not near_colour(draw(tmp_path / "all.png", [True, True]), RED).any()


def test_metres_are_as_long_on_both_axes(tmp_path):
    """Of a square of database images, drawn far apart, the corners make a square."""
    picture = draw(tmp_path / "map.png", [True, True], first=(0, 2))
    # The lines of the grid are paler by 32 levels.
    is_grey = (np.abs(picture[LEGEND:].astype(int) - 0xC4) < 10).all(axis=-1)
    grey = np.argwhere(cv2.erode(is_grey.astype(np.uint8), np.ones((5, 5), np.uint8)))
    height, width = np.ptp(grey, axis=0)
    # Dots are drawn to half a pixel.
    assert abs(height - width) <= 4
    assert height > 300


def test_a_query_without_a_positive_is_neither_right_nor_wrong(tmp_path):
    picture = draw(tmp_path / "map.png", [True, False], matched=(True, False))
    assert not near_colour(picture, RED).any()
    assert near_colour(picture, (0x7B, 0x1F, 0xA2)).any()


RNG = np.random.default_rng(0)
CITY = np.array([5e5, 5e6]) + RNG.uniform(-2000, 2000, (300, 2))
ASKED = CITY[:40] + 3.0


def out_of(database, queries=ASKED):
    placed = find_placed(database, queries)
    return np.flatnonzero(~placed.database).tolist(), np.flatnonzero(~placed.queries).tolist()


def test_a_city_has_no_placeholders():
    assert out_of(CITY) == ([], [])


def test_zeros_and_one_far_image_are_out_of_place():
    database, queries = CITY.copy(), ASKED.copy()
    database[[3, 7]], queries[5], database[11] = 0, 0, CITY[11] + 4e5
    assert out_of(database, queries) == ([3, 7, 11], [5])


def test_placeholders_of_half_of_all_images_do_not_decide_where_the_city_is():
    database = CITY.copy()
    database[:200] = (166021.44, 0.0)  # latitude 0, longitude 0 in UTM
    assert out_of(database) == (list(range(200)), [])


def test_a_second_city_is_in_place():
    database = np.concatenate([CITY, CITY[:100] + 6e5])
    assert out_of(database) == ([], [])


@pytest.mark.parametrize("count", [1, 6])
def test_places_that_all_share_positions_are_in_place(count):
    places = np.repeat(np.array([[0.0, 0.0], [50, 0], [90, 30]]), count, axis=0)
    assert out_of(places, places) == ([], [])


def test_what_is_out_of_place_is_not_drawn(tmp_path):
    database = np.array([[1000.0, 5000], [1100, 5000], [1100, 5100], [1000, 5100], [0, 0]] * 5)
    queries = np.array([[1005.0, 5000], [0, 0]])
    verdicts = Verdicts(np.array([False, False]), np.array([True, True]))
    placed = find_placed(database, queries)
    assert out_of(database, queries) == ([4, 9, 14, 19, 24], [1])
    everything = Placed(np.ones(25, bool), np.ones(2, bool), np.inf)
    for name, drawn in (("some", placed), ("all", everything)):
        path = tmp_path / f"{name}.png"
        position_map(path, database, queries, np.array([4, 0]), verdicts, drawn)
    # The map of all spans 5 km; without them it is the square of 100 m, whose red cross is alone:
    # no line leads to (0, 0).
    red = np.argwhere(near_colour(read_picture(tmp_path / "some.png")[110:], RED))
    assert np.ptp(red, axis=0).max() < 40
    red = np.argwhere(near_colour(read_picture(tmp_path / "all.png")[110:], RED))
    assert np.ptp(red, axis=0).max() > 200


def test_verdicts_by_hand():
    indices = np.array([[0, 1], [1, 0], [2, 0], [2, 1]])
    positives = [np.array([0, 2]), np.array([0]), np.array([], int), np.array([2])]
    verdicts = judge(Neighbours(indices, np.zeros((4, 2), np.float32)), positives)
    assert verdicts.right.tolist() == [True, False, False, True]
    assert verdicts.matched.tolist() == [True, True, False, True]
    assert verdicts.wrong.tolist() == [False, True, False, False]


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
    right = np.array([True, False])
    similarity_matrix(path, similarities, positives, np.array([0, 2]), right, 3)
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
