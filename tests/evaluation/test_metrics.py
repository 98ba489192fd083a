"""Scores by hand, by brute force, and against scipy's binomial distribution."""

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.stats

from crisalad_jax.evaluation import metrics as scores
from crisalad_jax.utils.errors import InputError


def test_recall_by_hand():
    indices = np.array(
        [
            [4, 1, 2, 3, 0],  # right at rank 1
            [4, 1, 2, 3, 0],  # right at ranks 3 and 4
            [0, 1, 2, 3, 4],  # its positives were not found
            [0, 1, 2, 3, 4],  # it has none: a miss, and still counted
            [3, 2, 1, 4, 0],  # right at rank 5
        ]
    )
    positives = [np.array(p, np.int64) for p in ([4], [2, 3], [7, 9], [], [0, 12])]
    found = scores.recalls(indices, positives, ks=(1, 2, 3, 5, 20))
    assert found == {1: 1 / 5, 2: 1 / 5, 3: 2 / 5, 5: 3 / 5, 20: 3 / 5}
    assert list(scores.recalls(indices, positives)) == [1, 5, 10, 20]


@pytest.mark.parametrize(
    ("queries", "positives"), [(0, []), (1, [[0], [1]]), (1, [[-1]]), (2, [[], [3, -1]])]
)
def test_positives_that_cannot_be_counted_are_refused(queries, positives):
    with pytest.raises(
        InputError, match=rf"^positives: found {len(positives)} lists for {queries}"
    ):
        scores.recalls(np.zeros((queries, 3), np.int64), [np.array(each) for each in positives])


@pytest.mark.parametrize("k", [0, -1, 1.5])
def test_a_k_that_is_no_count_is_refused(k):
    with pytest.raises(InputError, match=f"^ks: found {k}, expected "):
        scores.recalls(np.zeros((1, 3), np.int64), [np.array([1])], ks=(1, k))


# intervals


@pytest.mark.parametrize(
    ("queries", "hits"), [(1, 1), (7, 0), (7, 3), (147, 81), (740, 739), (27_592, 24_000)]
)
def test_the_interval_of_hits_and_misses_is_binomial(queries, hits):
    values = np.random.default_rng(0).permutation(np.arange(queries) < hits).astype(int)
    found = scores.bootstrap_interval(values)
    # Both are whole numbers of queries: equal, to the last.
    assert np.multiply(found, queries).round(6).tolist() == (
        scipy.stats.binom.ppf([0.025, 0.975], queries, hits / queries).tolist()
    )


def test_the_interval_of_several_trials_is_what_resampling_gives():
    generator = np.random.default_rng(1)
    hits = generator.choice(4, 60, p=[0.3, 0.1, 0.2, 0.4])
    found = scores.bootstrap_interval(hits, trials=3)
    resamples = generator.choice(hits, (100_000, 60)).mean(axis=1) / 3
    expected = np.quantile(resamples, [0.025, 0.975])
    # The means stand 1/180 apart, and 100,000 draws place a quantile within one such step.
    np.testing.assert_allclose(found, expected, atol=1.01 / 180, rtol=0)
    assert found.high - found.low > 0.1


def test_the_same_trial_thrice_is_that_trial():
    hits = (np.arange(50) % 3 == 0).astype(int)
    assert scores.bootstrap_interval(3 * hits, trials=3) == scores.bootstrap_interval(hits)
    # Where hits vary less between queries, as means of trials do, the interval is narrower.
    assert scores.bootstrap_interval(np.full(50, 1), trials=3) == (1 / 3, 1 / 3)


@pytest.mark.parametrize(
    ("hits", "trials", "words"),
    [
        ([], 1, r"hits: found array\(\[\].*, expected numbers of hits, from 0 to 1"),
        ([0, -1], 1, "hits: found .*, from 0 to 1"),
        ([0, 3], 2, "hits: found .*, from 0 to 2"),
    ],
)
def test_hits_without_an_interval_are_refused(hits, trials, words):
    with pytest.raises(InputError, match=f"^{words}"):
        scores.bootstrap_interval(np.array(hits, int), trials)


# precision and recall


def test_a_similarity_that_is_nan_is_refused():
    with pytest.raises(InputError, match=r"^similarities: found NaN, expected numbers"):
        scores.precision_recall(
            np.zeros((2, 1), np.int64), np.array([[0.5], [np.nan]]), 2 * [np.array([0])]
        )


def _curve(similarities, right, answerable=None):
    """Of one retrieval a query: database image 0, positive where right."""
    count = len(right)
    answerable = np.ones(count, bool) if answerable is None else answerable
    positives = [
        np.array([0] if good else [1] if any_ else [], np.int64)
        for good, any_ in zip(right, answerable, strict=True)
    ]
    indices = np.zeros((count, 2), np.int64)
    indices[:, 1] = 1  # a second retrieval counts for nothing
    both = np.stack([similarities, np.full(count, -1.0)], axis=1).astype(np.float32)
    return scores.precision_recall(indices, both, positives)


def test_precision_and_recall_by_hand():
    # Two without positives, accepted at 0.7 and 0.2; 0.5 is a tie of a right and a wrong one.
    found = _curve(
        [0.5, 0.9, 0.7, 0.5, 0.8, 0.2],
        [True, True, False, False, True, False],
        [True, True, False, True, True, False],
    )
    np.testing.assert_array_equal(found.thresholds, np.float32([0.9, 0.8, 0.7, 0.5, 0.2]))
    np.testing.assert_allclose(found.precision, [1, 1, 2 / 3, 3 / 5, 1 / 2], rtol=1e-15)
    np.testing.assert_allclose(found.recall, [1 / 4, 1 / 2, 1 / 2, 3 / 4, 3 / 4], rtol=1e-15)
    assert found.recall_at_full_precision == 0.5
    # Steps of recall: a quarter at 1, a quarter at 1, none, a quarter at 3/5, none.
    assert found.average_precision == pytest.approx(0.25 + 0.25 + 0.25 * 0.6, rel=1e-15)


def test_a_wrong_retrieval_on_top_leaves_nothing_at_full_precision():
    assert _curve([0.9, 0.8], [False, True]).recall_at_full_precision == 0
    # A tie with the most similar right one, too: no threshold takes the one without the other.
    assert _curve([0.9, 0.9], [True, False]).recall_at_full_precision == 0
    assert _curve([0.9, 0.8], [True, True])[3:] == (1.0, 1.0)
    assert _curve([0.9, 0.8], [False, False], [False, False]) is None


@hypothesis.settings(max_examples=60, deadline=None)
@hypothesis.given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 25))
def test_precision_and_recall_agree_with_counting_at_every_threshold(seed, count):
    rng = np.random.default_rng(seed)
    similarities = rng.integers(0, 8, count) / 8  # many ties
    answerable = rng.random(count) < 0.8
    right = answerable & (rng.random(count) < 0.6)
    found = _curve(similarities, right, answerable)
    if not answerable.any():
        assert found is None
        return
    expected = []
    for threshold in sorted(set(similarities), reverse=True):
        accepted = [s >= threshold for s in similarities]
        true = sum(a and r for a, r in zip(accepted, right, strict=True))
        expected.append((threshold, true / sum(accepted), true / answerable.sum()))
    for column, wanted in zip(found[:3], zip(*expected, strict=True), strict=True):
        np.testing.assert_allclose(column, wanted, rtol=1e-15)
    full = [recall for _, precision, recall in expected if precision == 1]
    assert found.recall_at_full_precision == max(full, default=0)
