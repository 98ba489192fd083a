"""Hard VLAD by loops, the starts from centroids, bursts, and whose vocabulary it is."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

from crisalad_jax.nn.aggregators.backbone_tokens import AggregationTokensConfig
from crisalad_jax.nn.aggregators.vlad import (
    BURST,
    AnyLocConfig,
    NetVlad,
    NetVladConfig,
    SuperVlad,
    SuperVladConfig,
    VladBuff,
    VladBuffConfig,
    VladConfig,
    Words,
    burst_weights,
    scores_from_centroids,
)
from crisalad_jax.nn.backbones.base import Features
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.layers import Linear, init_linear, l2_normalise
from crisalad_jax.utils.errors import InputError

PATCHES = np.random.default_rng(0).normal(size=(2, 9, 6)).astype(np.float32)
CENTROIDS = np.random.default_rng(1).normal(size=(4, 6)).astype(np.float32)
VIT = ViTConfig(dim=32, depth=3, heads=2, position_grid=3)
MODEL = ModelConfig(
    image_size=(42, 56),
    backbone=VIT,
    aggregator=NetVladConfig(clusters=3),
    cross_image="none",
)


def unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x)


FEATURES = np.stack([unit(row) for row in PATCHES.reshape(-1, 6)])


def sums_of(config: VladConfig, params: Any, patches: jax.Array) -> jax.Array:
    features = Features(patches[..., 0, :0], patches)
    return config.apply(params, features, (1, patches.shape[-2]), key=None).local


def distance(patch: np.ndarray, word: np.ndarray) -> float:
    return float(np.linalg.norm(patch - word))


def angle(patch: np.ndarray, word: np.ndarray) -> float:
    return float(-patch @ word / np.linalg.norm(word))


@pytest.mark.parametrize(("assignment", "far"), [("euclidean", distance), ("cosine", angle)])
def test_hard_vlad_takes_the_nearest_word_alone(assignment: Any, far: Any) -> None:
    """Jegou's VLAD by loops; a word that is nearest to nothing leaves zeros."""
    # Two of other lengths, which only the distance minds; and one that no patch is near to.
    words = np.concatenate([0.3 * CENTROIDS, -9 * PATCHES.sum(axis=(0, 1))[None]])
    words[1] *= 5
    config = AnyLocConfig(clusters=5, assignment=assignment)
    found = sums_of(config, Words(jnp.asarray(words)), jnp.asarray(PATCHES))
    for image, clusters in zip(PATCHES.astype(np.float64), found, strict=True):
        sums = np.zeros((5, 6))
        for patch in map(unit, image):
            nearest = min(range(5), key=lambda k: far(patch, words[k]))
            sums[nearest] += patch - words[nearest]
        assert not sums[4].any()
        expected = [row if not row.any() else unit(row) for row in sums]
        np.testing.assert_allclose(clusters, expected, atol=1e-6)


def test_supervlad_sums_patches_by_their_shares_without_ghosts() -> None:
    """In numpy: a softmax with the ghost, sums of four clusters, each normalised, then all."""
    config = SuperVladConfig(clusters=4, ghosts=1)
    weight = np.random.default_rng(2).normal(size=(6, 5)).astype(np.float32)
    found = sums_of(config, SuperVlad(Linear(jnp.asarray(weight), None)), jnp.asarray(PATCHES))
    for image, clusters in zip(PATCHES.astype(np.float64), found, strict=True):
        rows = np.stack([unit(patch) for patch in image])
        parts = scipy.special.softmax(rows @ weight, axis=1)[:, :4]
        expected = unit(np.stack([unit(row) for row in parts.T @ rows]))
        # Sums of nine unit patches in float32, of numbers below 1.
        np.testing.assert_allclose(clusters, expected, atol=1e-6)


def test_the_start_shares_a_patch_out_a_hundred_to_one() -> None:
    """The mean logarithm of the largest share over the second largest; directions stay."""
    params = NetVladConfig().from_centroids(jnp.asarray(CENTROIDS), jnp.asarray(FEATURES))
    # SuperVLAD's code makes the same scores, and keeps no centroids.
    other = SuperVladConfig().from_centroids(jnp.asarray(CENTROIDS), jnp.asarray(FEATURES))
    np.testing.assert_array_equal(other.conv.weight, params.conv.weight)
    assert SuperVladConfig(clusters=4, ghosts=1).count_centroids(32) == 5
    scores = FEATURES.astype(np.float64) @ np.asarray(params.conv.weight)
    shares = np.exp(scores) / np.exp(scores).sum(axis=1, keepdims=True)
    largest = np.sort(shares, axis=1)
    ratio = np.exp(np.log(largest[:, -1] / largest[:, -2]).mean())
    # Scores of some tens in float32, whose differences' mean is exponentiated.
    np.testing.assert_allclose(ratio, 100, rtol=1e-4)
    np.testing.assert_array_equal(params.centroids, CENTROIDS)
    directions = np.asarray(params.conv.weight).T
    lengths = np.linalg.norm(directions, axis=1)
    np.testing.assert_allclose(lengths, lengths[0], rtol=1e-6)
    np.testing.assert_allclose(
        directions / lengths[:, None], [unit(row) for row in CENTROIDS], atol=1e-6
    )


def test_image_starts_from_directions_of_netvlads_first_scores() -> None:
    """Its code: unit centroids times ln 100 over the mean gap of the two largest cosines."""
    config = AggregationTokensConfig(tokens=4)
    assert config.count_centroids(6) == 4
    assert (config.centroid_images, SuperVladConfig.centroid_images) == (5000, 5000)
    assert (VladBuffConfig.centroid_images, NetVladConfig.centroid_images) == (500, 500)
    params = config.from_centroids(jnp.asarray(CENTROIDS), jnp.asarray(FEATURES))
    directions = np.stack([unit(row) for row in CENTROIDS.astype(np.float64)])
    largest = np.sort(FEATURES.astype(np.float64) @ directions.T, axis=1)
    alpha = np.log(100) / (largest[:, -1] - largest[:, -2]).mean()
    # Numbers of some tens in float32, over a mean of differences.
    np.testing.assert_allclose(params.tokens, alpha * directions, rtol=1e-5, atol=1e-5)


def test_vlad_buff_starts_from_principal_components() -> None:
    """PCA without whitening by numpy's SVD in float64; then NetVLAD's start in the components.

    As in the public code, centroids and gap are of reduced features at their own lengths.
    """
    generator = np.random.default_rng(5)
    spread = generator.normal(size=(50, 6)) * [3, 2, 1, 0.5, 0.2, 0.1]
    features = np.stack([unit(row) for row in spread + 1]).astype(np.float32)
    config = VladBuffConfig(clusters=4, reduced=3)
    reduced = np.asarray(config.centroid_features(jnp.asarray(features)), np.float64)
    mean = features.astype(np.float64).mean(axis=0)
    components = np.linalg.svd(features - mean)[2][:3]
    expected = (features - mean) @ components.T
    signs = np.sign((reduced * expected).sum(axis=0))  # either end of a component is one
    # Components of gaps of order 1, of unit vectors in float32.
    np.testing.assert_allclose(reduced * signs, expected, atol=1e-5)
    assert abs(np.linalg.norm(reduced, axis=1) - 1).max() > 0.1

    centroids = reduced[[0, 11, 22, 33]].astype(np.float32)
    params = config.from_centroids(jnp.asarray(centroids), jnp.asarray(features))
    assert params.reduction is not None
    np.testing.assert_allclose(params.reduction.mean, mean, atol=1e-6)
    np.testing.assert_allclose(params.reduction.rotation * signs, components.T, atol=1e-5)
    np.testing.assert_array_equal(params.centroids, centroids)
    directions = np.stack([unit(row) for row in centroids])
    largest = np.sort(reduced @ directions.T, axis=1)
    alpha = np.log(100) / (largest[:, -1] - largest[:, -2]).mean()
    np.testing.assert_allclose(params.conv.weight, alpha * directions.T, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(params.burst, [8, 7, 1])

    whole = VladBuffConfig(clusters=4, reduced=0)
    plain = whole.from_centroids(jnp.asarray(CENTROIDS), jnp.asarray(features))
    netvlad = NetVladConfig().from_centroids(jnp.asarray(CENTROIDS), jnp.asarray(features))
    assert plain.reduction is None
    np.testing.assert_array_equal(plain.conv.weight, netvlad.conv.weight)
    np.testing.assert_array_equal(whole.centroid_features(jnp.asarray(features)), features)

    words = "features: found 2 of width 6, expected at least 3 features and dimensions"
    with pytest.raises(InputError, match=words):
        config.centroid_features(jnp.asarray(features[:2]))


def test_a_start_from_features_that_are_all_alike_is_refused() -> None:
    features = jnp.tile(unit(PATCHES[0, 0]), (5, 1))
    with pytest.raises(InputError, match="found 5 equally near two of 2 centroids"):
        scores_from_centroids(features[:2], features)


def test_without_features_centroids_are_random_and_unit() -> None:
    for config in (MODEL.aggregator, AnyLocConfig(clusters=3, layer=1)):
        params = config.init(jax.random.key(0), VIT, MODEL.grid)
        assert isinstance(params, NetVlad | Words)
        centroids = params.centroids if isinstance(params, NetVlad) else params.words
        assert centroids.shape == (3, 32)
        np.testing.assert_allclose(np.linalg.norm(centroids, axis=1), 1, rtol=1e-6)


def test_patches_that_are_alike_share_their_weight() -> None:
    """Three equal patches, and two at right angles to all: sigmoids of 7 and of 7 - 8 x 2."""
    patches = jnp.eye(4)[jnp.array([0, 0, 0, 1, 2])]
    same, other = 1 / (1 + np.exp(-7.0)), 1 / (1 + np.exp(9.0))
    expected = np.array([3 * same + 2 * other] * 3 + [same + 4 * other] * 2)
    # Float32 sums of five numbers.
    np.testing.assert_allclose(burst_weights(jnp.array(BURST), patches), expected, rtol=1e-6)
    squared = burst_weights(jnp.array([8.0, 7.0, 2.0]), patches)
    np.testing.assert_allclose(squared, expected**2, rtol=1e-6)


def test_equal_weights_leave_netvlad() -> None:
    """A slope of 0 makes all patches alike; a common factor falls to the intra-normalisation."""
    conv = init_linear(jax.random.key(0), 6, 3, bias=False)
    centroids = l2_normalise(jax.random.normal(jax.random.key(1), (3, 6)))
    patches = jax.random.normal(jax.random.key(2), (2, 7, 6))
    params = VladBuff(None, conv, centroids, jnp.array([0.0, 7.0, 1.0]))
    found = sums_of(VladBuffConfig(clusters=3, reduced=0), params, patches)
    expected = sums_of(NetVladConfig(clusters=3), NetVlad(conv, centroids), patches)
    # Other orders of the same sums, at cancelling residuals.
    np.testing.assert_allclose(found, expected, atol=1e-5)
