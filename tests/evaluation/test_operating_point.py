"""The similarity to ask for: by hand, against the curve, and the bound against the binomial."""

import dataclasses
import pathlib

import numpy as np
import pytest
import scipy.stats

from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.evaluation.metrics import precision_recall
from crisalad_jax.evaluation.operating_point import (
    OperatingPoint,
    caveats,
    check_supported,
    operating_point,
)
from crisalad_jax.nn.model import Model
from crisalad_jax.utils.errors import InputError
from tests.conftest import MODEL, read_options

# Six queries of one database image: right, right, wrong, right, unknown place, right.
SIMILARITIES = np.array([[0.91], [0.8], [0.75], [0.75], [0.6123], [0.6122]], np.float32)
POSITIVES = [np.array(p, np.int64) for p in ([0], [0], [1], [0], [], [0])]
INDICES = np.zeros((6, 1), np.int64)


def point_at(precision: float, rows=slice(None)) -> OperatingPoint:
    return operating_point(INDICES[rows], SIMILARITIES[rows], POSITIVES[rows], precision)


def test_points_by_hand():
    strict = point_at(0.99)
    assert strict == OperatingPoint(0.99, 0.8, 2, 2, queries=6, unknown=1, unknown_answered=0)
    assert (strict.precision, strict.recall, strict.reached) == (1, 2 / 6, True)
    # Equal similarities are accepted together: 3 of 4, not 3 of 3.
    three_quarters = point_at(0.75)
    assert (three_quarters.right, three_quarters.answered) == (3, 4)
    assert three_quarters.min_similarity == 0.75
    # Precision falls to 3 of 5 and rises again to 4 of 6 with everything accepted.
    all_of_them = point_at(0.66)
    assert (all_of_them.right, all_of_them.answered) == (4, 6)
    assert all_of_them.unknown_answered == all_of_them.unknown == 1
    assert all_of_them.min_similarity == 0.612


def test_rounding_down_never_reaches_the_next_similarity():
    """0.7504 would round to 0.750, which is that of a wrong answer."""
    similarities = np.array([[0.7504], [0.75]], np.float32)
    point = operating_point(INDICES[:2], similarities, [np.array([0]), np.array([1])], 1.0)
    assert (point.right, point.answered) == (1, 1)
    assert 0.75 < point.min_similarity <= similarities[0, 0]


def test_a_precision_that_nothing_reaches_is_said():
    """Of the queries from the third on the best is 2 of 4, with all of them."""
    point = point_at(0.9, slice(2, None))
    assert not point.reached
    assert (point.right, point.answered) == (2, 4)
    (words,) = caveats(point)
    assert words.startswith("no similarity reaches a precision of 90 %; the highest is 50.0 %")
    none = point_at(0.9, slice(4, 5))
    assert (none.precision, none.lower_bound, none.reached) == (0, 0, False)


@pytest.mark.parametrize(("right", "answered"), [(29, 29), (297, 300), (1, 7), (5, 6)])
def test_the_bound_is_where_the_binomial_says(right, answered):
    """At the bound, as many right answers or more have a chance of 5 %."""
    point = OperatingPoint(0.9, 0.5, answered, right, 400, 0, 0)
    chance = scipy.stats.binom.sf(right - 1, answered, point.lower_bound)
    # The bound is a root found by iteration: scipy's beta.ppf is good to about 1e-10.
    assert chance == pytest.approx(0.05, rel=1e-8)
    if right == answered:
        assert point.lower_bound == pytest.approx(0.05 ** (1 / answered), rel=1e-8)


def test_how_many_answers_a_precision_takes():
    (rarer,) = caveats(OperatingPoint(0.99, 0.5, 29, 29, 40, 0, 0))
    assert rarer.endswith("99 % takes 299 answers, all of them correct")  # 0.99 ** 298 is 0.05003
    (certain,) = caveats(OperatingPoint(1.0, 0.5, 29, 29, 40, 0, 0))
    assert certain.endswith("(95 % confidence)")  # no number of answers shows that
    many = OperatingPoint(0.9, 0.5, 29, 29, 40, 0, 0)
    assert caveats(many) == []
    (words,) = caveats(many._replace(answered=28, right=28))
    (mixed,) = caveats(OperatingPoint(0.3, 0.5, 53, 16, 111, 0, 0))
    assert mixed.endswith("which shows a precision of at least 19.9 % (95 % confidence)")
    assert words.startswith("rests on few queries: 28 of 28 answers were correct, which shows")
    assert words.endswith(
        "at least 89.9 % (95 % confidence); 90 % takes 29 answers, all of them correct"
    )


def test_two_answers_are_a_coincidence():
    """Two of two show 0.05 ** (1 / 2), 22 %."""
    two = OperatingPoint(0.99, 0.5, 2, 2, 40, 0, 0)
    with pytest.raises(InputError, match=r"found 2 .* on town, 2 correct, .* least 22\.4 %"):
        check_supported(two, "town")
    check_supported(two._replace(answered=3), "town")


@pytest.mark.parametrize("seed", range(5))
def test_points_are_of_the_curve_and_accept_the_same_queries(seed):
    generator = np.random.default_rng(seed)
    similarities = generator.normal(0.5, 0.1, (200, 1)).astype(np.float32)
    indices = (similarities + generator.normal(0, 0.1, (200, 1)) < 0.5).astype(np.int64)
    positives = [np.array([0])] * 200
    curve = precision_recall(indices, similarities, positives)
    assert curve is not None
    for precision in (0.6, 0.8, 0.95, 1.0):
        point = operating_point(indices, similarities, positives, precision)
        enough = curve.precision >= precision
        if point.reached:
            assert point.recall == curve.recall[enough].max()
        else:
            assert not enough.any()
        # In float64: a float32 comparison would round the threshold.
        accepted = similarities[:, 0].astype(np.float64) >= point.min_similarity
        assert int(accepted.sum()) == point.answered
        assert int((accepted & (indices[:, 0] == 0)).sum()) == point.right


@pytest.mark.parametrize("precision", [0, -0.5, 1.01, float("nan")])
def test_such_a_precision_is_refused(precision, params, benchmark):
    words = rf"precision: found {precision}, expected a fraction above 0, at most 1"
    with pytest.raises(InputError, match=words):
        point_at(precision)
    # Before any image is read.
    gone = dataclasses.replace(benchmark, queries=(pathlib.Path("gone.jpg"),))
    with pytest.raises(InputError, match=words):
        evaluate(Model(params, MODEL), gone, precision=precision)


def test_evaluate_gives_each_result_its_point(params, benchmark):
    options = {"groupings": ["single"]} | read_options({})
    plain = evaluate(Model(params, MODEL), benchmark, **options)
    results = evaluate(Model(params, MODEL), benchmark, precision=0.5, **options)
    truth = benchmark.ground_truth()
    for without, result in zip(plain, results, strict=True):
        assert without.operating_point is None
        point = result.operating_point
        assert point is not None
        assert point == operating_point(*result.neighbours, truth, 0.5)
        assert (result.recalls, point.unknown) == (without.recalls, 1)
