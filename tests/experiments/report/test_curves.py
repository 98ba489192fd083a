"""Curves by the colours where something must stand."""

import numpy as np
import pytest

from crisalad_jax.evaluation.metrics import PrecisionRecall
from crisalad_jax.experiments import report
from crisalad_jax.experiments.report.curves import precision_curves
from crisalad_jax.utils.errors import InputError
from tests.experiments.report.pictures import BLUE, ORANGE, near_colour, read_picture


def test_recall_curves_are_drawn_in_order(tmp_path):
    path = tmp_path / "deep" / "curves.png"
    curves = {"low": {1: 0.1, 20: 0.3}, "high": {1: 0.6, 20: 0.9}}
    report.recall_curves(path, curves, "Recall", wide=True)
    picture = read_picture(path)
    assert picture.shape == (540, 840, 3)  # 7 x 4.5 inches at 120 dots
    blue, orange = (np.argwhere(near_colour(picture, colour)) for colour in (BLUE, ORANGE))
    assert len(blue) > 500
    assert len(orange) > 500
    # The first curve is blue and lower, all along; above both are their names.
    lower = 150
    assert orange[:, 0].max() < blue[blue[:, 0] > lower][:, 0].min()
    assert [file.name for file in path.parent.iterdir()] == ["curves.png"]


def test_nothing_touches_the_edge(tmp_path):
    names = [f"a model with quite a long name, seed {seed}" for seed in range(9)]
    curves = {name: {1: 0.9, 5: 0.99, 10: 1.0, 20: 1.0} for name in names}
    report.recall_curves(
        tmp_path / "curves.png", curves, "A title beyond any measure " * 8, wide=True
    )
    picture = read_picture(tmp_path / "curves.png")
    for edge in (picture[:4], picture[-4:], picture[:, :4], picture[:, -4:]):
        assert (edge == 255).all()


def test_curves_reject_nothing_and_percent(tmp_path):
    path = tmp_path / "curves.png"
    for curves, message in (
        ({}, r"^curves: found none"),
        ({"HOG": {}}, r"^HOG: found no recalls"),
        ({"HOG": {1: 59.2}}, r"^HOG: found recall 59.2 at 1"),
    ):
        with pytest.raises(InputError, match=message):
            report.recall_curves(path, curves, "Recall")
    assert not path.exists()


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
        report.training_curves(tmp_path / f"{name}.png", records, title="tiny")
        picture = read_picture(tmp_path / f"{name}.png")
        assert picture.shape[1] == 840
        assert near_colour(picture, BLUE).any()
        # R@5 is the second line of the recalls.
        assert near_colour(picture, ORANGE).any() == (name in ("both", "validation"))
        heights[name] = len(picture)
    assert heights["both"] > heights["training"] == heights["once"] > heights["validation"]


def test_training_curves_reject_what_they_cannot_draw(tmp_path):
    for records, message in (
        ([], r"^records: found 0 without any of loss"),
        ([{"step": 1, "images_per_second": 3.0}], r"^records: found 1 without any of loss"),
        ([{"step": 7, "R@1": 45.0}], r"^R@1: found recall 45.0 at 7"),
    ):
        with pytest.raises(InputError, match=message):
            report.training_curves(tmp_path / "curves.png", records)


def test_precision_curves_are_drawn_where_they_are(tmp_path):
    path = tmp_path / "curves.png"
    recall, none = np.array([0.1, 0.9]), np.zeros(2)
    high = PrecisionRecall(none, np.array([1.0, 0.9]), recall, 0.0, 0.0)
    low = PrecisionRecall(none, np.array([0.4, 0.2]), recall, 0.0, 0.0)
    precision_curves(path, {"high": high, "low": low})
    picture = read_picture(path)
    lower = picture[len(picture) // 6 :]  # below the legend
    blue, orange = (np.argwhere(near_colour(lower, colour)) for colour in (BLUE, ORANGE))
    assert len(blue) > 500
    assert blue[:, 0].max() < orange[:, 0].min()
    # Both reach from a recall of 10 to one of 90 %.
    assert np.ptp(blue[:, 1]) == pytest.approx(np.ptp(orange[:, 1]), abs=15)


def test_narrow_curves_are_for_small_screens(tmp_path):
    report.recall_curves(tmp_path / "narrow.png", {"a": {1: 0.5, 5: 0.9}})
    assert read_picture(tmp_path / "narrow.png").shape == (680, 800, 3)  # 4 inches at 200 dots
