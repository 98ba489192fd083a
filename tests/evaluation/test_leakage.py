"""Shares of same-place images by hand, and against a loop over all pairs."""

import numpy as np
import pytest

from crisalad_jax.evaluation import leakage as same_place
from crisalad_jax.evaluation.leakage import (
    by_truth,
    masked,
    mirrored_share,
    near,
    same_place_share,
)
from crisalad_jax.retrieval.grouping import GROUPINGS, batches_of


def pairs(same, count: int) -> np.ndarray:
    """Of all images with all."""
    a, b = np.indices((count, count)).reshape(2, -1)
    return same(a, b).reshape(count, count)


def test_positions_tell_by_the_radius_inclusive():
    positions = np.array([[0.0, 0.0], [3.0, 4.0], [0.0, 5.1], [6.0, 8.0]])
    found = pairs(near(positions, 5.0), 4)
    expected = np.eye(4, dtype=bool)
    expected[[0, 1, 1, 2, 1, 3], [1, 0, 2, 1, 3, 1]] = True
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("chunk", [1, 5, 2**21])
def test_the_truth_tells_by_what_is_shared(monkeypatch, chunk):
    monkeypatch.setattr(same_place, "_CHUNK", chunk)
    rng = np.random.default_rng(2)
    positives = [rng.permutation(9)[: rng.integers(0, 4)] for _ in range(12)]
    queries, database = by_truth(positives, 9)
    found = [set(each.tolist()) for each in positives]
    np.testing.assert_array_equal(pairs(queries, 12), [[bool(a & b) for b in found] for a in found])
    expected = [[any({a, b} <= each for each in found) for b in range(9)] for a in range(9)]
    np.testing.assert_array_equal(pairs(database, 9), expected)


def test_the_share_by_hand():
    # Places a a b a b: in file order by threes, (a a b) and (a b).
    same = near(np.array([[0.0, 0], [0, 0], [9, 0], [0, 0], [9, 0]]), 1.0)
    assert same_place_share(batches_of(5, "single", 3), same) is None
    # a: 1 of 2, a: 1 of 2, b: 0 of 2; a: 0 of 1, b: 0 of 1.
    assert same_place_share(batches_of(5, "sequential", 3), same) == (0.5 + 0.5) / 5
    # The first looked at none: a: 1 of 1, b: 0 of 2, a: 1 of 2, b: 1 of 2.
    assert same_place_share(batches_of(5, "window", 3), same) == (1 + 0 + 0.5 + 0.5) / 4
    # A last batch of one looked at none, and whoever pads it is no other image.
    assert same_place_share(batches_of(4, "sequential", 3), same) == 1 / 3
    assert same_place_share(batches_of(1, "sequential", 3), same) is None


@pytest.mark.parametrize("grouping", GROUPINGS)
@pytest.mark.parametrize("chunk", [1, 40, 2**21])
def test_the_share_agrees_with_a_loop(monkeypatch, grouping, chunk):
    monkeypatch.setattr(same_place, "_CHUNK", chunk)
    count, size = 23, 5
    places = np.random.default_rng(3).integers(0, 4, count)
    batches = batches_of(count, grouping, size, seed=1)
    shares = []
    for images, filled, kept in zip(*batches[:3], strict=True):
        for image in images[kept]:
            others = [other for other in images[filled] if other != image]
            if others and grouping != "single":
                shares.append(np.mean([places[other] == places[image] for other in others]))
    same = near(np.stack([places, places], axis=1).astype(float), 0.0)
    found = same_place_share(batches, same)
    if grouping == "single":
        assert found is None
    else:
        # Sums of two dozen fractions in another order.
        assert found == pytest.approx(np.mean(shares), rel=1e-13)
        assert 0 < found < 1


def test_masked_images_see_their_batch_without_their_own_place():
    places = np.array([0, 0, 1, 2, 1, 1, 0])
    same = near(np.stack([places, places], axis=1).astype(float), 0.0)
    found = masked(batches_of(7, "sequential", 3), same)
    assert found.grouping == "masked"
    assert found.images[found.kept].tolist() == list(range(7))
    seen = [sorted(images[filled].tolist()) for images, filled in zip(*found[:2], strict=True)]
    assert seen == [[0, 2], [1, 2], [0, 1, 2], [3, 4, 5], [3, 4], [3, 5], [6]]
    assert same_place_share(found, same) == 0


def test_the_mirrored_share_by_hand():
    positives = [np.array([0]), np.array([1]), np.array([2]), np.array([3]), np.array([], int)]
    queries = batches_of(5, "sequential", 2)
    # The same order on both sides: each other image is also there.
    assert mirrored_share(queries, batches_of(4, "sequential", 2), positives) == 1
    # By threes (0 1 2) (3): query 3 has no other of its place there, and query 4 no positive.
    assert mirrored_share(queries, batches_of(4, "sequential", 3), positives) == (1 + 1 + 0 + 0) / 4
    assert mirrored_share(queries, batches_of(4, "single", 3), positives) is None
    # Of several positives the one whose batch is most alike counts.
    positives[2] = np.array([0, 2])
    assert mirrored_share(queries, batches_of(4, "sequential", 3), positives) == 0.5
    positives[3] = np.array([1, 3])
    assert mirrored_share(queries, batches_of(4, "sequential", 3), positives) == 1


@pytest.mark.parametrize("sides", [("shuffled", "sequential"), ("window", "shuffled")])
def test_the_mirrored_share_agrees_with_a_loop(sides):
    rng = np.random.default_rng(5)
    positives = [rng.permutation(17)[: rng.integers(0, 4)] for _ in range(23)]
    queries, database = (
        batches_of(count, grouping, 5, seed=2)
        for count, grouping in zip((23, 17), sides, strict=True)
    )
    sight = []
    for side in (queries, database):
        own = {}
        for images, filled, kept in zip(*side[:3], strict=True):
            own |= {int(image): set(images[filled].tolist()) for image in images[kept]}
        sight.append(own)
    shares = []
    for query, right in enumerate(positives):
        others = sight[0][query] - {query}
        if len(right) and others:
            shares.append(
                max(
                    np.mean([bool(set(positives[o].tolist()) & sight[1][int(a)]) for o in others])
                    for a in right
                )
            )
    # Sums of some twenty fractions in another order.
    assert mirrored_share(queries, database, positives) == pytest.approx(np.mean(shares), rel=1e-13)
    assert 0 < np.mean(shares) < 1
