"""Charts by the colours where something must stand."""

import cv2
import numpy as np
import pytest

from crisalad_jax.evaluation.metrics import PrecisionRecall
from crisalad_jax.experiments import report
from crisalad_jax.experiments.report.charts import (
    Positions,
    find_placed,
    outcomes_of,
    position_map,
    precision_curves,
    similarity_matrix,
    truth_cells,
)
from crisalad_jax.retrieval.neighbours import Neighbours
from tests.experiments.report.pictures import (
    BLUE,
    GREEN,
    ORANGE,
    RED,
    assert_clear_edges,
    drawn,
    is_colour,
    near_colour,
)

DATABASE = np.array([[1000.0, 5000.0], [1100, 5000], [1100, 5100], [1000, 5100]])
QUERIES = np.array([[1005.0, 5000.0], [1100, 5097]])
LEGEND = 110
"""Rows of the picture that the legend takes."""


def draw(tmp_path, *outcomes, first=(0, 0)):
    places = Positions(DATABASE, QUERIES, np.ones(4, bool), np.ones(2, bool), np.inf)
    figure = position_map(places, np.array(first), np.array(outcomes))
    return drawn(figure, tmp_path)


def reddish(picture):
    """Where crosses are, and the lines, which are thin and pale."""
    lower = picture[:-LEGEND].astype(int)
    return np.argwhere(lower[..., 0] - lower[..., 1] > 30)


def test_a_right_query_is_green_and_a_wrong_one_red_with_a_line_to_its_retrieval(tmp_path):
    picture = draw(tmp_path, "right", "wrong")
    lower = picture[:-LEGEND]
    green, red = (np.argwhere(near_colour(lower, colour)) for colour in (GREEN, RED))
    # South-west is right and below left of the wrong one in the north-east.
    south_west, north_east = green.mean(axis=0), red.mean(axis=0)
    assert south_west[0] > north_east[0] + 300
    assert south_west[1] < north_east[1] - 300
    # The line passes half-way to the retrieval, five metres west of the green dot.
    middle = (south_west + north_east) / 2
    assert np.abs(reddish(picture) - middle).sum(axis=1).min() < 40
    assert not near_colour(draw(tmp_path, "right", "right"), RED).any()


def test_metres_are_as_long_on_both_axes(tmp_path):
    """Of a square of database images, drawn far apart, the corners make a square."""
    picture = draw(tmp_path, "right", "right", first=(0, 2))
    # The lines of the grid are paler by 32 levels.
    is_grey = (np.abs(picture[:-LEGEND].astype(int) - 0xC4) < 10).all(axis=-1)
    grey = np.argwhere(cv2.erode(is_grey.astype(np.uint8), np.ones((5, 5), np.uint8)))
    height, width = np.ptp(grey, axis=0)
    # Dots are drawn to half a pixel.
    assert abs(height - width) <= 4
    assert height > 300


def test_a_query_without_a_positive_is_neither_right_nor_wrong(tmp_path):
    picture = draw(tmp_path, "right", "no positive")
    assert not near_colour(picture, RED).any()
    assert near_colour(picture, (0x7B, 0x1F, 0xA2)).any()


RNG = np.random.default_rng(0)
CITY = np.array([5e5, 5e6]) + RNG.uniform(-2000, 2000, (300, 2))
ASKED = CITY[:40] + 3.0


def out_of(database, queries=ASKED):
    placed = find_placed(database, queries)
    return tuple(np.flatnonzero(~mask).tolist() for mask in placed[2:4])


def test_zeros_and_one_far_image_are_out_of_place():
    database, queries = CITY.copy(), ASKED.copy()
    database[[3, 7]], queries[5], database[11] = 0, 0, CITY[11] + 4e5
    assert out_of(database, queries) == ([3, 7, 11], [5])


def test_placeholders_of_half_of_all_images_do_not_decide_where_the_city_is():
    database = CITY.copy()
    database[:200] = (166021.44, 0.0)  # latitude 0, longitude 0 in UTM
    assert out_of(database) == (list(range(200)), [])


def test_a_second_city_is_in_place():
    assert out_of(CITY) == ([], [])
    assert out_of(np.concatenate([CITY, CITY[:100] + 6e5])) == ([], [])


@pytest.mark.parametrize("count", [1, 6])
def test_places_that_all_share_positions_are_in_place(count):
    places = np.repeat(np.array([[0.0, 0.0], [50, 0], [90, 30]]), count, axis=0)
    assert out_of(places, places) == ([], [])


def test_what_is_out_of_place_is_not_drawn(tmp_path):
    database = np.array([[1000.0, 5000], [1100, 5000], [1100, 5100], [1000, 5100], [0, 0]] * 5)
    queries = np.array([[1095.0, 5095], [0, 0]])
    placed = find_placed(database, queries)
    assert out_of(database, queries) == ([4, 9, 14, 19, 24], [1])
    everything = Positions(database, queries, np.ones(25, bool), np.ones(2, bool), np.inf)
    first, outcomes = np.array([4, 0]), np.array(["wrong", "wrong"])
    # The map of all spans 5 km; without them it is the square of 100 m, whose red cross is alone:
    # no line leads to (0, 0).
    some, every = (
        np.ptp(reddish(drawn(position_map(each, first, outcomes), tmp_path)), axis=0).max()
        for each in (placed, everything)
    )
    assert some < 40
    assert every > 200


def test_outcomes_by_hand():
    indices = np.array([[0, 1], [1, 0], [2, 0], [2, 1]])
    positives = [np.array([0, 2]), np.array([0]), np.array([], int), np.array([2])]
    found = outcomes_of(Neighbours(indices, np.zeros((4, 2), np.float32)), positives)
    assert found.tolist() == ["right", "wrong", "no positive", "right"]


def test_truth_by_hand():
    positives = [np.array(p, int) for p in ([0, 6], [], [3], [4], [6])]
    # Queries are in cells 0, 0, 1, 1, 2, database images in four of the first and three.
    assert truth_cells(positives, 7, (3, 2)).tolist() == [[True] * 2, [True] * 2, [False, True]]


def test_the_matrix_shows_similarities_truth_and_first_retrievals(tmp_path):
    similarities = np.array([[0.9, 0.1, 0.1], [0.1, 0.1, 0.8]], np.float32)
    positives = [np.array([0]), np.array([1])]
    outcomes = np.array(["right", "wrong"])
    figure = similarity_matrix(similarities, positives, np.array([0, 2]), outcomes, 3)
    picture = drawn(figure, tmp_path)
    green, red = (np.argwhere(is_colour(picture, colour)) for colour in (GREEN, RED))
    # The first query's retrieval is right, above and left of the second's, which is not.
    assert (green.mean(axis=0) < red.mean(axis=0)).all()
    # About the first dot it is orange, for it is right, and so is the middle of the row below.
    (row, column), (below, last) = (dots.mean(axis=0).astype(int) for dots in (green, red))
    middle = (column + last) // 2
    for at in ((row, column + 20), (below, middle)):
        assert near_colour(picture[at], ORANGE)
    # Similarities are dark about the second dot, and light right of the first.
    assert picture[below, last + 20].max() < 100
    assert picture[row, middle].min() > 200


def test_recall_curves_are_drawn_in_order(tmp_path):
    curves = {"low": {1: 0.1, 20: 0.3}, "high": {1: 0.6, 20: 0.9}}
    picture = drawn(report.recall_curves(curves, "Recall", wide=True), tmp_path / "deep")
    assert picture.shape == (540, 840, 3)  # 7 x 4.5 inches at 120 dots
    blue, orange = (np.argwhere(near_colour(picture, colour)) for colour in (BLUE, ORANGE))
    assert len(blue) > 500
    assert len(orange) > 500
    # The first curve is blue and lower, all along; below both are their names.
    names = 450
    assert orange[orange[:, 0] < names][:, 0].max() < blue[:, 0].min()
    assert [file.name for file in (tmp_path / "deep").iterdir()] == ["drawn.png"]


def test_nothing_touches_the_edge(tmp_path):
    names = [f"a model with quite a long name, seed {seed}" for seed in range(9)]
    curves = {name: {1: 0.9, 5: 0.99, 10: 1.0, 20: 1.0} for name in names}
    figure = report.recall_curves(curves, "A title beyond any measure " * 8, wide=True)
    picture = drawn(figure, tmp_path)
    assert_clear_edges(picture)


def test_training_curves_draw_what_the_records_hold(tmp_path):
    training = [
        {"step": s, "loss": 1 / (1 + s), "easy_anchor_fraction": 0.5, "learning_rate": 1e-3}
        for s in range(90)
    ]
    validation = [{"step": s, "R@1": s / 100, "R@5": 0.95} for s in (10, 50, 80)]
    heights = {}
    for name, records in (
        ("both", training + validation),
        ("training", training),
        ("validation", validation),
        ("once", training[:1]),
    ):
        picture = drawn(report.training_curves(records), tmp_path)
        assert picture.shape[1] == 840
        assert near_colour(picture, BLUE).any()
        # R@5 is the second line of the recalls.
        assert near_colour(picture, ORANGE).any() == (name in ("both", "validation"))
        heights[name] = len(picture)
    assert heights["both"] > heights["training"] == heights["once"] > heights["validation"]


def test_precision_curves_are_drawn_where_they_are(tmp_path):
    recall, none = np.array([0.1, 0.9]), np.zeros(2)
    high = PrecisionRecall(none, np.array([1.0, 0.9]), recall, 0.0, 0.0)
    low = PrecisionRecall(none, np.array([0.4, 0.2]), recall, 0.0, 0.0)
    picture = drawn(precision_curves({"high": high, "low": low}), tmp_path)
    lower = picture[: -len(picture) // 6]  # above the legend
    blue, orange = (np.argwhere(near_colour(lower, colour)) for colour in (BLUE, ORANGE))
    assert len(blue) > 500
    assert blue[:, 0].max() < orange[:, 0].min()
    # Both reach from a recall of 10 to one of 90 %.
    assert np.ptp(blue[:, 1]) == pytest.approx(np.ptp(orange[:, 1]), abs=15)
