"""Recalls and their paired differences, against scipy and a bootstrap written out."""

import numpy as np
import pytest
import scipy.stats

from crisalad_jax.evaluation.difference import paired_difference
from crisalad_jax.experiments.comparison.results import recall_of
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


@pytest.mark.parametrize("same_seeds", [True, False])
def test_it_is_a_bootstrap_written_out(same_seeds):
    """Three runs of 60 queries, better or worse by their seed, and the same with two changed."""
    theirs = np.stack([drawn(1, 60, share, i)[0] for i, share in enumerate((0.2, 0.5, 0.8))])
    ours = theirs.copy()
    ours[:, :2] = True
    generator, values = np.random.default_rng(7), []
    for _ in range(10_000):
        queries = generator.integers(0, 60, 60)
        seeds = generator.integers(0, 3, 3)
        others = seeds if same_seeds else generator.integers(0, 3, 3)
        values.append(ours[seeds][:, queries].mean() - theirs[others][:, queries].mean())
    expected = np.quantile(values, (0.025, 0.975))
    found = paired_difference(ours, theirs, same_seeds=same_seeds).interval
    # A quantile of 10,000 draws is off by a thirtieth of their deviation, four times which is 0.13.
    assert found == pytest.approx(expected, abs=0.15 * np.std(values))
    assert (found.high - found.low < 0.1) == same_seeds


def test_runs_that_agree_have_no_difference():
    """Seeds that recall 80 and 0 %, the same queries in both methods: nothing is uncertain."""
    theirs = np.array([[True] * 8 + [False] * 2, [False] * 10])
    assert paired_difference(theirs, theirs).interval == (0, 0)
    apart = paired_difference(theirs, theirs, same_seeds=False).interval
    assert apart.low < -0.3
    assert apart.high > 0.3


@pytest.mark.parametrize(
    ("ours", "theirs", "verdict"),
    [(40, 10, "better"), (10, 40, "worse"), (25, 25, "inconclusive"), (26, 25, "inconclusive")],
)
def test_what_an_interval_decides(ours, theirs, verdict):
    """One more hit of 50 is 0 in a resample that draws that query not once, as a third do."""
    row = np.arange(50)[None]
    assert paired_difference(row < ours, row < theirs).verdict == verdict


def test_it_is_the_same_every_time():
    ours, theirs = drawn(3, 30, 0.6, 0), drawn(2, 30, 0.5, 1)
    first, again, other = (
        paired_difference(ours, theirs, same_seeds=False, seed=seed) for seed in (0, 0, 1)
    )
    assert first == again != other


def test_other_queries_are_refused():
    with pytest.raises(InputError, match=r"found shapes \(1, 4\) and \(1, 5\), expected"):
        paired_difference(drawn(1, 4, 0.5, 0), drawn(1, 5, 0.5, 0))
    with pytest.raises(InputError, match=r"found shapes \(1, 4\) and \(2, 4\), .* same_seeds=F"):
        paired_difference(drawn(1, 4, 0.5, 0), drawn(2, 4, 0.5, 0))


def test_recalls_of_ranks_by_hand():
    """Two seeds, four queries: at 1 they hit 2 and 1, at 5 they hit 3 and 2."""
    ranks = np.array([[1, 1, 3, 0], [1, 6, 5, 0]])
    at_1, at_5 = recall_of(ranks, 1), recall_of(ranks, 5)
    assert at_1.by_seed == (0.5, 0.25)
    assert (at_1.mean, at_5.mean) == (0.375, 0.625)
    # The sample deviation of two numbers is their distance over the square root of 2.
    assert at_1.spread == pytest.approx(0.25 / np.sqrt(2), abs=1e-15)
    assert recall_of(ranks[:1], 1).spread is None
