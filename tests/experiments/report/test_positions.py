"""The map by where its colours stand."""

import cv2
import numpy as np
import pytest

from crisalad_jax.experiments.report.positions import position_map
from crisalad_jax.utils.errors import InputError
from tests.experiments.report.pictures import GREEN, RED, near_colour, read_picture

DATABASE = np.array([[1000.0, 5000.0], [1100, 5000], [1100, 5100], [1000, 5100]])
QUERIES = np.array([[1005.0, 5000.0], [1100, 5097]])
LEGEND = 110
"""Rows of the picture that the legend takes."""


def draw(path, right, matched=(True, True), first=(0, 0)):
    arrays = np.array(first), np.array(right), np.array(matched)
    position_map(path, DATABASE, QUERIES, *arrays)
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


def test_what_cannot_be_drawn(tmp_path):
    with pytest.raises(InputError, match=r"^first: found 1, expected 2 as of queries"):
        draw(tmp_path / "map.png", [True, True], first=(0,))
    nowhere, one = np.array([[np.nan, 0.0]]), (np.zeros(1, int), np.ones(1, bool), np.ones(1, bool))
    with pytest.raises(InputError, match=r"^queries: found a position that is not finite"):
        position_map(tmp_path / "map.png", DATABASE, nowhere, *one)
    assert not (tmp_path / "map.png").exists()
