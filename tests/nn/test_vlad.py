"""NetVLAD and AnyLoc against loops over patches and clusters, and the block that a facet is of."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.config import (
    AnyLocConfig,
    CrossImageConfig,
    ModelConfig,
    NetVladConfig,
    ViTConfig,
)
from crisalad_jax.errors import InputError
from crisalad_jax.model import alone, relate
from crisalad_jax.nn.aggregators import init_aggregator
from crisalad_jax.nn.aggregators.anyloc import AnyLoc, from_words, hard_vlad, mark
from crisalad_jax.nn.aggregators.netvlad import NetVlad, from_centroids, netvlad
from crisalad_jax.nn.layers import Linear
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.nn.vit import facet
from tests.conftest import random_params

PATCHES = np.random.default_rng(0).normal(size=(2, 9, 6)).astype(np.float32)
CENTROIDS = np.random.default_rng(1).normal(size=(4, 6)).astype(np.float32)
VIT = ViTConfig(dim=32, depth=3, heads=2, position_grid=3)
MODEL = ModelConfig(
    image_size=(42, 56),
    backbone=VIT,
    aggregator="netvlad",
    netvlad=NetVladConfig(clusters=3),
    anyloc=AnyLocConfig(clusters=3, layer=1),
    encoder=CrossImageConfig(layers=0),
)


def unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x)


def test_netvlad_is_the_papers_sum() -> None:
    """Eq. 4, patch by patch and cluster by cluster, in float64."""
    weight = np.random.default_rng(2).normal(size=(6, 4)).astype(np.float32)
    params = NetVlad(Linear(jnp.asarray(weight), None), jnp.asarray(CENTROIDS))
    found = netvlad(params, jnp.asarray(PATCHES))
    for image, clusters in zip(PATCHES.astype(np.float64), found, strict=True):
        sums = np.zeros((4, 6))
        for patch in map(unit, image):
            exponentials = [np.exp(weight[:, k] @ patch) for k in range(4)]
            for k in range(4):
                sums[k] += exponentials[k] / sum(exponentials) * (patch - CENTROIDS[k])
        # Sums of nine numbers around 1 in float32, divided by their length.
        np.testing.assert_allclose(clusters, [unit(row) for row in sums], atol=1e-6)


def test_hard_vlad_takes_the_nearest_word_alone() -> None:
    """Jegou's VLAD by loops; a word that is nearest to nothing leaves zeros."""
    words = np.concatenate([0.3 * CENTROIDS, np.full((1, 6), 9, np.float32)])
    found = hard_vlad(jnp.asarray(words), jnp.asarray(PATCHES))
    for image, clusters in zip(PATCHES.astype(np.float64), found, strict=True):
        sums = np.zeros((5, 6))
        for patch in map(unit, image):
            nearest = min(range(5), key=lambda k: np.linalg.norm(patch - words[k]))
            sums[nearest] += patch - words[nearest]
        assert not sums[4].any()
        expected = [row if not row.any() else unit(row) for row in sums]
        np.testing.assert_allclose(clusters, expected, atol=1e-6)


def test_the_start_shares_a_patch_out_a_hundred_to_one() -> None:
    """The mean logarithm of the largest share over the second largest; directions stay."""
    features = np.stack([unit(row) for row in PATCHES.reshape(-1, 6)])
    params = from_centroids(jnp.asarray(CENTROIDS), jnp.asarray(features))
    scores = features.astype(np.float64) @ np.asarray(params.conv.weight)
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


def test_a_start_from_features_that_are_all_alike_is_refused() -> None:
    features = jnp.tile(unit(PATCHES[0, 0]), (5, 1))
    with pytest.raises(InputError, match="found 5 that are as near to two of 2 centroids"):
        from_centroids(features[:2], features)


def test_without_features_centroids_are_random_and_unit() -> None:
    for config in (MODEL, dataclasses.replace(MODEL, aggregator="anyloc")):
        params = init_aggregator(jax.random.key(0), config)
        assert isinstance(params, NetVlad | AnyLoc)
        centroids = params.centroids if isinstance(params, NetVlad) else params.words
        assert centroids.shape == (3, 32)
        np.testing.assert_allclose(np.linalg.norm(centroids, axis=1), 1, rtol=1e-6)


def test_a_facet_looks_at_no_block_after_its_own() -> None:
    """All of those after it NaN, and of its own what a facet does not need."""
    params = random_params(MODEL).backbone
    images = jax.random.normal(jax.random.key(1), (1, 42, 56, 3))
    spoilt = jax.tree.map(lambda leaf: leaf.at[2:].set(jnp.nan), params.blocks)
    beyond = dataclasses.replace(
        spoilt, mlp=jax.tree.map(lambda x: x.at[1:].set(jnp.nan), spoilt.mlp)
    )
    run = jax.jit(facet, static_argnums=(2, 3, 4))
    for name, blocks in (("value", beyond), ("token", spoilt)):
        found = run(dataclasses.replace(params, blocks=blocks), images, VIT, 1, name)
        expected = run(params, images, VIT, 1, name)
        assert np.isfinite(expected.patches).all()
        np.testing.assert_array_equal(found.patches, expected.patches)
        np.testing.assert_array_equal(found.class_token, expected.class_token)


def test_netvlads_tokens_fit_the_encoder() -> None:
    """It has no global token, which the encoder's switch leaves on."""
    config = dataclasses.replace(MODEL, encoder=CrossImageConfig(heads=4, feedforward=8))
    params = random_params(config)
    local = jax.random.normal(jax.random.key(1), (2, 3, 32))
    found = relate(params, Tokens(jnp.zeros((2, 0)), local), config, mask=alone(2))
    assert found.shape == (2, config.descriptor_dim) == (2, 96)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-6)


def test_a_mark_tells_backbones_apart_and_is_a_float32() -> None:
    backbone = random_params(MODEL).backbone
    marks = {mark(backbone)}
    for change in (
        {"cls_token": backbone.cls_token.at[0].add(1e-6)},
        {"pos_embed_cls": backbone.cls_token, "cls_token": backbone.pos_embed_cls},
    ):
        marks.add(mark(dataclasses.replace(backbone, **change)))
    assert len(marks) == 3
    assert mark(jax.tree.map(np.asarray, backbone)) in marks
    for one in marks:
        assert int(np.float32(one)) == one > 0
    assert float(from_words(jnp.ones((2, 32)), backbone).backbone) == mark(backbone)
