"""Windows' VLADs and the score of a pair, against loops over the definitions in float64."""

import dataclasses
from collections.abc import Iterator

import cv2
import jax
import numpy as np
import pytest

from crisalad_jax.nn.aggregators.vlad import NetVlad, NetVladConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.layers import linear
from crisalad_jax.nn.model import describe, unit_features
from crisalad_jax.nn.projection import ProjectionConfig
from crisalad_jax.retrieval.reranking import patch_netvlad
from crisalad_jax.utils.errors import InputError
from tests.conftest import random_params
from tests.retrieval.reranking.test_matching import brute_force

CONFIG = ModelConfig(
    image_size=(84, 98),
    backbone=ViTConfig(dim=16, depth=1, heads=2, position_grid=4),
    aggregator=NetVladConfig(clusters=3),
    cross_image="none",
)


def unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


@pytest.mark.parametrize("side", [1, 2, 4])
def test_a_windows_vlad_is_that_of_its_patches_alone(side: int) -> None:
    """At side 4, all rows of the grid."""
    rng = np.random.default_rng(0)
    grid = (4, 5)
    shares = rng.dirichlet(np.ones(3), 20)
    features, centroids = unit(rng.standard_normal((20, 6))), rng.standard_normal((3, 6))
    expected = []
    for top in range(4 - side + 1):
        for left in range(5 - side + 1):
            sums = np.zeros((3, 6))
            for row in range(top, top + side):
                for column in range(left, left + side):
                    patch = 5 * row + column
                    for cluster in range(3):
                        residual = features[patch] - centroids[cluster]
                        sums[cluster] += shares[patch, cluster] * residual
            expected.append(unit(unit(sums).ravel()))
    given = (x.astype(np.float32) for x in (shares, features, centroids))
    found = jax.jit(patch_netvlad.window_vlads, static_argnums=(3, 4))(*given, grid, side)
    # float32: sums of at most 16 numbers, and two lengths.
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_a_cluster_with_little_in_a_window_keeps_its_direction() -> None:
    """Where sums of the whole image are subtracted, only their rounding would be left of it."""
    rng = np.random.default_rng(0)
    features = unit(rng.standard_normal((36, 6))).astype(np.float32)
    shares = np.full((36, 2), 0.5, np.float32)
    shares[-8:, 0] = 1e-7
    shares[-8:, 1] = 1
    centroids = np.zeros((2, 6), np.float32)
    found = np.asarray(patch_netvlad.window_vlads(shares, features, centroids, (6, 6), 1))
    # Alike in both clusters, for both have all of one patch alone, of whatever share.
    np.testing.assert_allclose(found[-1, :6], found[-1, 6:], atol=1e-6)


def test_windows_that_do_not_fit_twice_are_left_out() -> None:
    def windows(*size: int) -> list:
        return patch_netvlad.windows_of(dataclasses.replace(CONFIG, image_size=size))

    assert windows(224, 224) == [(2, 0.45, (15, 15)), (5, 0.15, (12, 12)), (8, 0.4, (9, 9))]
    assert windows(98, 112) == [(2, 0.45, (6, 7)), (5, 0.15, (3, 4))]
    assert windows(42, 224) == [(2, 0.45, (2, 15))]
    with pytest.raises(InputError, match=r"found images of 28 x 224, expected at least 42 x 42"):
        windows(28, 224)


GRIDS = ((5, 6), (2, 3))
"""Rows and columns of the windows of CONFIG, of sides 2 and 5."""


def pair_matches(
    query: np.ndarray, candidate: np.ndarray
) -> Iterator[tuple[tuple[int, int], np.ndarray, np.ndarray]]:
    """Grids, and places (row, column) of matched windows of the query and of the candidate."""
    start = 0
    for rows, columns in GRIDS:
        part = slice(start, start + rows * columns)
        start = part.stop
        matches = np.array(brute_force(query[part], candidate[part]))
        here = np.flatnonzero(matches >= 0)
        places = (np.stack(np.divmod(each, columns), axis=1) for each in (here, matches[here]))
        yield (rows, columns), *places


@pytest.fixture(scope="module")
def local() -> tuple[np.ndarray, np.ndarray]:
    """Windows of a query and of four candidates that are more and less like it."""
    windows, dim = patch_netvlad.shape(CONFIG)
    assert (windows, dim) == (5 * 6 + 2 * 3, 48)
    rng = np.random.default_rng(0)
    query = unit(rng.standard_normal((windows, dim)))
    noise = rng.standard_normal((4, windows, dim))
    # They leave most, half and few of the matches.
    candidates = unit(query + np.array([0.5, 1, 1.5, 2])[:, None, None] * noise)
    return query.astype(np.float16), candidates.astype(np.float16)


def test_spatial_scores_are_those_of_loops(local) -> None:
    query, candidates = local
    expected = []
    for candidate in candidates:
        scores = []
        for (rows, columns), here, there in pair_matches(query, candidate):
            moved = there - here
            off = np.abs(moved - moved.mean(axis=0))
            near = np.maximum([rows - 1, columns - 1] - off, 0)
            scores.append((near**2).sum() / (rows * columns))
        expected.append(scores)
    found = patch_netvlad.spatial_scores(query, candidates, CONFIG)
    assert len(set(np.round(np.array(expected)[:, 0], 3))) == 4
    # The matches are the same; then a dozen roundings of float32.
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_inlier_scores_are_shares_of_the_windows(local) -> None:
    """From candidate to query, as in the public code: 24 pixels of tolerance, patches of 16."""
    query, candidates = local
    expected = []
    for candidate in candidates:
        scores = []
        for (rows, columns), here, there in pair_matches(candidate, query):
            before, after = (each[:, ::-1].astype(np.float32) for each in (here, there))
            mask = np.zeros(0)
            if len(here) > 3:
                _, mask = cv2.findHomography(before, after, cv2.RANSAC, 24 / 16)
            scores.append(np.sum(mask) / (rows * columns))
        expected.append(scores)
    found = patch_netvlad.inlier_scores(query, candidates, CONFIG)
    assert found.dtype == np.float32
    assert len(set(np.array(expected)[:, 0])) >= 3
    np.testing.assert_allclose(found, expected, rtol=1e-7)  # float32's rounding of a quotient
    np.testing.assert_array_equal(patch_netvlad.inlier_scores(query, candidates, CONFIG), found)


def test_scores_of_sizes_are_summed_weighted() -> None:
    scores = np.array([[1, 10], [3, 20]], np.float32)
    expected = [0.45 * 1 + 0.15 * 10, 0.45 * 3 + 0.15 * 20]
    np.testing.assert_allclose(patch_netvlad.weighted_sum(scores, CONFIG), expected, rtol=1e-12)


def test_standardised_scores_by_hand() -> None:
    """Three candidates: means 2 and 40, deviations (2/3)^0.5 and 200^0.5."""
    scores = np.array([[3, 20], [2, 50], [1, 50]], np.float32)
    first, second = np.array([1, 0, -1]) * 1.5**0.5, np.array([-20, 10, 10]) / 200**0.5
    found = patch_netvlad.standardised_sum(scores, CONFIG)
    np.testing.assert_allclose(found, 0.45 * first + 0.15 * second, rtol=1e-12)
    # The weighted sum puts the first one last: the second size has the larger numbers.
    assert found.argmax() == 0
    assert patch_netvlad.weighted_sum(scores, CONFIG).argmin() == 0


@pytest.mark.parametrize("alike", [0.0, 0.1, 1 / 3])
def test_a_size_at_which_all_score_alike_adds_nothing(alike: float) -> None:
    """Their mean has no rounding error, which the division by a deviation of 0 would blow up."""
    scores = np.full((7, 2), alike, np.float32)
    np.testing.assert_array_equal(patch_netvlad.standardised_sum(scores, CONFIG), np.zeros(7))
    scores[:, 0] = np.arange(7)
    expected = 0.45 * (np.arange(7) - 3) / 2
    found = patch_netvlad.standardised_sum(scores, CONFIG)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_one_window_over_all_patches_is_the_aggregators_own_descriptor() -> None:
    params = random_params(CONFIG)
    images = jax.random.normal(jax.random.key(0), (1, 84, 84, 3))
    aggregator = params.aggregator
    assert isinstance(aggregator, NetVlad)
    (features,) = unit_features(params, images, CONFIG)
    shares = jax.nn.softmax(linear(aggregator.conv, features), axis=-1)
    (whole,) = patch_netvlad.window_vlads(shares, features, aggregator.centroids, (6, 6), 6)
    # The same 36 residuals, summed in another order.
    np.testing.assert_allclose(whole, describe(params, images, CONFIG)[0], atol=1e-5)


def test_windows_are_projected_as_the_whole_image_is() -> None:
    config = dataclasses.replace(CONFIG, projection=ProjectionConfig(dim=5))
    params = random_params(config)
    images = jax.random.normal(jax.random.key(0), (2, *config.image_size, 3))
    assert patch_netvlad.shape(config) == (36, 5)
    plain = dataclasses.replace(params, projection=None)
    vlads = np.asarray(patch_netvlad.describe(plain, images, CONFIG), np.float64)
    weight, bias = (np.asarray(each, np.float64) for each in jax.tree.leaves(params.projection))
    found = patch_netvlad.describe(params, images, config)
    assert (found.shape, found.dtype) == ((2, 36, 5), np.float16)
    # Numbers below 1, which float16 rounds by up to 2.4e-4, before the projection and after it.
    np.testing.assert_allclose(found, unit(vlads @ weight + bias), atol=1e-3)
    assert (np.ptp(np.asarray(found, np.float32), axis=1) > 0.1).any()
