"""Windows' VLADs and the score of a pair, against loops over the definitions in float64."""

import dataclasses

import jax
import numpy as np
import pytest

from crisalad_jax.nn.aggregators.netvlad import NetVlad, NetVladConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.nn.layers import linear
from crisalad_jax.nn.model import describe, unit_features
from crisalad_jax.retrieval.reranking import patch_netvlad
from crisalad_jax.utils.errors import InputError
from tests.conftest import random_params
from tests.retrieval.reranking.test_matching import brute_force

CONFIG = ModelConfig(
    image_size=(84, 98),
    backbone=ViTConfig(dim=16, depth=1, heads=2, position_grid=4),
    aggregator=NetVladConfig(clusters=3),
    cross_image=CrossImageConfig(layers=0),
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


def test_a_pairs_score_is_the_weighted_sum_over_sizes() -> None:
    windows, dim = patch_netvlad.shape(CONFIG)
    assert (windows, dim) == (5 * 6 + 2 * 3, 48)
    rng = np.random.default_rng(0)
    query = unit(rng.standard_normal((windows, dim)))
    candidates = unit(query + 0.5 * rng.standard_normal((4, windows, dim)))
    expected = []
    for candidate in candidates:
        total, start = 0.0, 0
        for weight, (rows, columns) in ((0.45, (5, 6)), (0.15, (2, 3))):
            part = slice(start, start + rows * columns)
            start = part.stop
            matches = brute_force(query[part], candidate[part])
            pairs = [(i, there) for i, there in enumerate(matches) if there >= 0]
            moved = np.array(
                [np.subtract(divmod(j, columns), divmod(i, columns)) for i, j in pairs]
            )
            off = np.abs(moved - moved.mean(axis=0))
            near = np.maximum([rows - 1, columns - 1] - off, 0)
            total += weight * (near**2).sum() / (rows * columns)
        expected.append(total)
    found = patch_netvlad.score(query.astype(np.float16), candidates.astype(np.float16), CONFIG)
    assert len(set(np.round(expected, 3))) == 4
    # The matches are the same; then a dozen roundings of float32.
    np.testing.assert_allclose(found, expected, rtol=1e-5)


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
