"""Matches against brute force, the spatial score by hand, and both on shifts and on disorder."""

import cv2
import jax
import numpy as np
import pytest

from crisalad_jax.retrieval.reranking.matching import inliers, mutual_matches, spatial_score

GRID = (6, 7)
PATCHES = GRID[0] * GRID[1]
score = jax.jit(spatial_score, static_argnums=1)


def brute_force(query: np.ndarray, candidate: np.ndarray) -> list[int]:
    """Patch by patch, as the definition says."""

    def nearest(one: np.ndarray, others: np.ndarray) -> int | None:
        if not one.any():
            return None
        known = {i: one @ other for i, other in enumerate(others) if other.any()}
        return max(known, key=lambda i: known[i], default=None)

    found = []
    for i, patch in enumerate(query):
        there = nearest(patch, candidate)
        mutual = there is not None and nearest(candidate[there], query) == i
        found.append(there if mutual and there is not None else -1)
    return found


@pytest.mark.parametrize("left_out", [0.0, 0.4, 1.0])
def test_matches_are_those_of_brute_force(left_out: float) -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        sides = rng.standard_normal((2, PATCHES, 5)).astype(np.float32)
        sides[rng.random((2, PATCHES)) < left_out] = 0
        expected = brute_force(*sides)
        assert (max(expected) >= 0) == (left_out < 1)
        assert min(expected) == -1
        np.testing.assert_array_equal(jax.jit(mutual_matches)(*sides), expected)


def test_of_equal_patches_the_first_is_taken() -> None:
    query = np.array([[0, 1], [1, 0], [1, 0]], np.float32)
    np.testing.assert_array_equal(mutual_matches(query, query), [0, 1, -1])


def test_a_spatial_score_by_hand() -> None:
    """Two rows of three patches; three matches, whose mean displacement is (1/3, 2/3)."""
    # (0, 0) to (0, 1), (0, 1) to (1, 1), (1, 0) to (1, 1): (0, 1), (1, 0), (0, 1).
    matches = np.array([1, 4, -1, 4, -1, -1])
    # From the largest displacements, 1 row and 2 columns.
    rows = 2 * (1 - 1 / 3) ** 2 + (1 - 2 / 3) ** 2
    columns = 2 * (2 - 1 / 3) ** 2 + (2 - 2 / 3) ** 2
    np.testing.assert_allclose(score(matches, (2, 3)), (rows + columns) / 6, rtol=1e-6)


def test_what_is_further_off_than_the_grid_is_long_adds_nothing() -> None:
    """One of three matches goes 5 down where two go 5 up: it is 20 / 3 from the mean."""
    matches = np.full(12, -1)
    matches[[0, 10, 11]] = 10, 0, 1  # six rows of two
    rows = 2 * (5 - 10 / 3) ** 2 + 0
    np.testing.assert_allclose(score(matches, (6, 2)), (rows + 3 * 1) / 12, rtol=1e-5)


def test_no_match_scores_nothing() -> None:
    assert score(np.full(PATCHES, -1), GRID) == 0
    assert inliers(np.full(PATCHES, -1), GRID) == 0


def shifted(down: int, right: int) -> np.ndarray:
    """Matches of an image with its copy moved on the grid."""
    rows, columns = np.divmod(np.arange(PATCHES), GRID[1])
    rows, columns = rows + down, columns + right
    inside = (rows >= 0) & (rows < GRID[0]) & (columns >= 0) & (columns < GRID[1])
    return np.where(inside, rows * GRID[1] + columns, -1)


@pytest.mark.parametrize("shift", [(0, 0), (1, 0), (0, -2), (-1, 2)])
def test_disorder_scores_lower_than_a_shift(shift: tuple[int, int]) -> None:
    """The same patches are matched, but to each other's places."""
    matches = shifted(*shift)
    matched = np.flatnonzero(matches >= 0)
    largest = sum((side - 1) ** 2 for side in GRID)
    # All displacements are the mean: nothing is lost.
    expected = largest * len(matched) / PATCHES
    np.testing.assert_allclose(score(matches, GRID), expected, rtol=1e-6)
    assert inliers(matches, GRID) == len(matched)
    for seed in range(20):
        mixed = matches.copy()
        mixed[matched] = np.random.default_rng(seed).permutation(matches[matched])
        assert score(mixed, GRID) < 0.8 * expected
        # One and a half patches of tolerance let some of disorder pass.
        assert inliers(mixed, GRID) < 0.7 * len(matched)


def test_inliers_are_the_same_whatever_was_drawn_before() -> None:
    rng = np.random.default_rng(1)
    matches = shifted(1, 0)
    # Where each of them goes is drawn anew: only samples of the rest agree with one another.
    mixed = rng.random(PATCHES) < 0.6
    matches[mixed] = rng.integers(PATCHES, size=mixed.sum())
    found = set()
    for seed in range(5):
        cv2.setRNGSeed(seed)
        cv2.randn(np.empty(seed + 1), 0, 1)
        found.add(inliers(matches, GRID))
    assert len(found) == 1
    assert (~mixed & (shifted(1, 0) >= 0)).sum() <= found.pop() < PATCHES


HOMOGRAPHY = np.array([[0.8, 0.1, 3.0], [-0.05, 0.9, 2.0], [0.002, 0.004, 1.0]])
"""A turn, a shear and a perspective, in columns and rows of a grid of 20 x 24."""


@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.6])
def test_the_matches_of_a_known_homography_are_its_inliers(outliers: float) -> None:
    grid = (20, 24)
    rng = np.random.default_rng(0)
    rows, columns = np.divmod(np.arange(480), 24)
    x, y, w = HOMOGRAPHY @ np.stack([columns, rows, np.ones(480)])
    x, y = x / w, y / w
    inside = (x >= 0) & (x <= 23) & (y >= 0) & (y <= 19)
    matches = np.where(inside, 24 * y.round() + x.round(), -1).astype(int)
    wrong = inside & (rng.random(480) < outliers)
    # Far from where they belong: four or more times an inlier's largest distance.
    far = np.hypot(x[wrong, None] - columns, y[wrong, None] - rows) > 4 * 1.5
    matches[wrong] = [rng.choice(np.flatnonzero(places)) for places in far]
    right = (inside & ~wrong).sum()
    assert right > 100
    # Places on a grid are up to 0.7 patches off, so that a sample's homography may lose a few at
    # the margin of 1.5, and may find a few of the others.
    assert 0.97 * right <= inliers(matches, grid) <= 1.03 * right


@pytest.mark.parametrize("count", [3, 4])
def test_a_homography_needs_four_matches(count: int) -> None:
    matches = np.full(PATCHES, -1)
    corners = np.array([0, GRID[1] - 1, PATCHES - 1, PATCHES - GRID[1]])[:count]
    matches[corners] = corners
    assert inliers(matches, GRID) == (count if count == 4 else 0)
