"""Positions that are none, told from cities of any size."""

import numpy as np
import pytest

from crisalad_jax.experiments.report.placeholders import find_placed
from crisalad_jax.experiments.report.positions import position_map
from tests.experiments.report.pictures import RED, near_colour, read_picture

RNG = np.random.default_rng(0)
CITY = np.array([5e5, 5e6]) + RNG.uniform(-2000, 2000, (300, 2))
QUERIES = CITY[:40] + 3.0


def out_of(database, queries=QUERIES):
    placed = find_placed(database, queries)
    return np.flatnonzero(~placed.database).tolist(), np.flatnonzero(~placed.queries).tolist()


def test_a_city_has_no_placeholders():
    assert out_of(CITY) == ([], [])


def test_zeros_and_one_far_image_are_out_of_place():
    database, queries = CITY.copy(), QUERIES.copy()
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
    verdicts = np.array([4, 0]), np.array([False, False]), np.array([True, True])
    placed = find_placed(database, queries)
    assert out_of(database, queries) == ([4, 9, 14, 19, 24], [1])
    position_map(tmp_path / "some.png", database, queries, *verdicts, placed)
    position_map(tmp_path / "all.png", database, queries, *verdicts)
    # The map of all spans 5 km; without them it is the square of 100 m, whose red cross is alone:
    # no line leads to (0, 0).
    red = np.argwhere(near_colour(read_picture(tmp_path / "some.png")[110:], RED))
    assert np.ptp(red, axis=0).max() < 40
    red = np.argwhere(near_colour(read_picture(tmp_path / "all.png")[110:], RED))
    assert np.ptp(red, axis=0).max() > 200
