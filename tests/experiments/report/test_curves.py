"""Curves by the colours where something must stand."""

import numpy as np
import pytest

from crisalad_jax.experiments import report
from crisalad_jax.experiments.report.curves import _spread
from crisalad_jax.utils.errors import InputError
from tests.experiments.report.pictures import BLUE, ORANGE, near_colour, read_picture


def test_recall_curves_are_drawn_in_order(tmp_path):
    path = tmp_path / "deep" / "curves.png"
    curves = {"low": {1: 0.1, 20: 0.3}, "high": {1: 0.6, 20: 0.9}}
    report.recall_curves(path, curves, "Recall")
    picture = read_picture(path)
    assert picture.shape == (540, 840, 3)  # 7 x 4.5 inches at 120 dots
    blue, orange = (np.argwhere(near_colour(picture, colour)) for colour in (BLUE, ORANGE))
    assert len(blue) > 500
    assert len(orange) > 500
    # The first curve is blue and lower, all along.
    assert orange[:, 0].max() < blue[:, 0].min()
    assert [file.name for file in path.parent.iterdir()] == ["curves.png"]


def test_nothing_touches_the_edge(tmp_path):
    names = [f"a model with quite a long name, seed {seed}" for seed in range(9)]
    curves = {name: {1: 0.9, 5: 0.99, 10: 1.0, 20: 1.0} for name in names}
    report.recall_curves(tmp_path / "curves.png", curves, "A title beyond any measure " * 8)
    picture = read_picture(tmp_path / "curves.png")
    for edge in (picture[:4], picture[-4:], picture[:, :4], picture[:, -4:]):
        assert (edge == 255).all()


def test_names_beside_curves_are_spread():
    # Two that are too close move apart alike, one alone stays.
    assert _spread([50.0, 49.0, 10.0], 6.0, 0.0, 100.0) == pytest.approx([52.5, 46.5, 10])
    # At the top they move down, in order; 0.1 is the hundredth of a gap at which it stops.
    assert _spread([100.0] * 3, 10.0, 0.0, 100.0) == pytest.approx([80, 90, 100], abs=0.1)
    # More than fit share the height.
    crowd = _spread([3.0] * 8, 40.0, 0.0, 80.0)
    assert np.diff(crowd) == pytest.approx([10] * 7, abs=1)
    assert min(crowd) >= 0
    assert max(crowd) <= 80


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
        ([{"step": 1, "loss": 1.0}, {"loss": 2.0}], r"^records: number 1 has no step, only loss"),
        ([{"step": 7, "R@1": 45.0}], r"^R@1: found recall 45.0 at 7"),
    ):
        with pytest.raises(InputError, match=message):
            report.training_curves(tmp_path / "curves.png", records)


def test_precision_curves_are_drawn_where_they_are(tmp_path):
    path = tmp_path / "curves.png"
    high = report.PrecisionCurve(np.array([1.0, 0.9]), np.array([0.1, 0.9]))
    low = report.PrecisionCurve(np.array([0.4, 0.2]), np.array([0.1, 0.9]))
    report.curves.precision_curves(path, {"high": high, "low": low})
    picture = read_picture(path)
    lower = picture[len(picture) // 6 :]  # below the legend
    blue, orange = (np.argwhere(near_colour(lower, colour)) for colour in (BLUE, ORANGE))
    assert len(blue) > 500
    assert blue[:, 0].max() < orange[:, 0].min()
    # Both reach from a recall of 10 to one of 90 %.
    assert np.ptp(blue[:, 1]) == pytest.approx(np.ptp(orange[:, 1]), abs=15)


def test_precision_curves_reject_what_is_none(tmp_path):
    path = tmp_path / "curves.png"
    ones = np.ones(2)
    for curves, message in (
        ({}, r"^curves: found none"),
        ({"a": report.PrecisionCurve(ones, np.ones(3))}, r"^a: found 2 precisions and 3 recalls"),
        ({"a": report.PrecisionCurve(ones, 90 * ones)}, r"^a: found recall 90.0 at 0"),
    ):
        with pytest.raises(InputError, match=message):
            report.curves.precision_curves(path, curves)
    assert not path.exists()


def test_narrow_curves_are_for_small_screens(tmp_path):
    report.recall_curves(tmp_path / "narrow.png", {"a": {1: 0.5, 5: 0.9}}, "", narrow=True)
    assert read_picture(tmp_path / "narrow.png").shape == (680, 800, 3)  # 4 inches at 200 dots
