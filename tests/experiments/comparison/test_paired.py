"""Paired differences, against scipy and against every resample that there is."""

import itertools

import numpy as np
import pytest
import scipy.stats

from crisalad_jax.experiments.comparison import paired_difference
from crisalad_jax.utils.errors import InputError


def drawn(seeds: int, queries: int, share: float, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((seeds, queries)) < share


def test_of_one_seed_it_is_scipys_paired_bootstrap():
    ours = drawn(1, 160, 0.6, 0)
    theirs = ours & drawn(1, 160, 0.8, 1) | drawn(1, 160, 0.1, 2)

    def difference(first, second, axis):
        return first.mean(axis) - second.mean(axis)

    expected = scipy.stats.bootstrap(
        (ours[0].astype(float), theirs[0].astype(float)),
        difference,
        paired=True,
        n_resamples=10_000,
        method="percentile",
        rng=np.random.default_rng(3),
    ).confidence_interval
    found = paired_difference(ours, theirs)
    assert found.mean == pytest.approx(ours.mean() - theirs.mean(), abs=1e-15)
    # Two draws of the ends, which lie on a grid of a query: each may be one step off.
    assert found.interval == pytest.approx((expected.low, expected.high), abs=1 / 160 + 1e-9)


def test_of_several_seeds_it_is_every_resample():
    """Four queries, two seeds each: 4^4 x 2^2 x 2^2 resamples, equally likely."""
    ours = np.array([[1, 1, 0, 1], [0, 1, 1, 1]], bool)
    theirs = np.array([[0, 0, 1, 1], [0, 1, 0, 0]], bool)
    values = [
        ours[np.ix_(a, queries)].mean() - theirs[np.ix_(b, queries)].mean()
        for queries in itertools.product(range(4), repeat=4)
        for a in itertools.product(range(2), repeat=2)
        for b in itertools.product(range(2), repeat=2)
    ]
    low, high = np.quantile(values, (0.025, 0.975))
    found = paired_difference(ours, theirs, resamples=100_000)
    # The ends lie on a grid of 1/8 in between which 100,000 draws may fall on either side.
    assert found.interval == pytest.approx((low, high), abs=1 / 8 + 1e-9)
    assert found.interval.high - found.interval.low > 0.5
    within = (np.array(values) >= found.interval.low) & (np.array(values) <= found.interval.high)
    assert within.mean() >= 0.95 - 0.01  # the draws' own error is a tenth of that


def test_seeds_of_the_same_runs_are_drawn_together():
    """The second stage adds one query to every seed, whatever the seed: nothing is uncertain."""
    theirs = np.array([[True] * 8 + [False] * 2, [False] * 10])
    ours = theirs.copy()
    assert paired_difference(ours, theirs, same_runs=True).interval == (0, 0)
    apart = paired_difference(ours, theirs).interval
    assert apart.low < -0.3
    assert apart.high > 0.3


def test_more_seeds_that_agree_narrow_the_interval():
    few = paired_difference(drawn(1, 50, 0.6, 0), drawn(1, 50, 0.4, 1)).interval
    many = paired_difference(drawn(20, 50, 0.6, 0), drawn(20, 50, 0.4, 1)).interval
    assert many.high - many.low < 0.6 * (few.high - few.low)


@pytest.mark.parametrize(
    ("ours", "theirs", "verdict"),
    [(40, 10, "better"), (10, 40, "worse"), (25, 25, "not told apart"), (26, 25, "not told apart")],
)
def test_what_an_interval_decides(ours, theirs, verdict):
    """One more hit of 50 is 0 in a resample that draws that query not once, as a third do."""
    row = np.arange(50)[None]
    assert paired_difference(row < ours, row < theirs).verdict == verdict


def test_it_is_the_same_every_time():
    ours, theirs = drawn(3, 30, 0.6, 0), drawn(2, 30, 0.5, 1)
    assert paired_difference(ours, theirs) == paired_difference(ours, theirs)
    assert paired_difference(ours, theirs) != paired_difference(ours, theirs, seed=1)


def test_other_queries_are_refused():
    with pytest.raises(InputError, match=r"found shapes \(1, 4\) and \(1, 5\), expected"):
        paired_difference(drawn(1, 4, 0.5, 0), drawn(1, 5, 0.5, 0))
    with pytest.raises(InputError, match="found 1 and 2 seeds of the same runs"):
        paired_difference(drawn(1, 4, 0.5, 0), drawn(2, 4, 0.5, 0), same_runs=True)
