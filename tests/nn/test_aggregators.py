"""The aggregators beside SALAD, by hand and by torch's pooling; the order of a descriptor."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax.config import CrossImageConfig, ModelConfig, SaladConfig
from crisalad_jax.nn.aggregators import aggregate, init_aggregator, join
from crisalad_jax.nn.aggregators.gem_pyramid import GemPyramid, gem_pyramid
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.nn.vit import Features

MODEL = ModelConfig(encoder=CrossImageConfig(layers=0), salad=SaladConfig(clusters=3))


def test_salads_descriptor_is_the_global_token_then_clusters_by_dimension() -> None:
    tokens = Tokens(jnp.array([3.0, 4.0]), jnp.array([[1.0, 2.0], [5.0, 6.0], [7.0, 8.0]]))
    expected = np.array([3, 4, 1, 5, 7, 2, 6, 8]) / np.sqrt(204)
    # One rounding of a square root and of a product, of numbers below 1.
    np.testing.assert_allclose(join(tokens, MODEL), expected, atol=1e-7)


def test_a_pyramids_descriptor_is_region_after_region() -> None:
    tokens = Tokens(jnp.array([3.0, 4.0]), jnp.array([[1.0, 2.0], [5.0, 6.0], [7.0, 8.0]]))
    config = dataclasses.replace(MODEL, aggregator="gem-pyramid")
    expected = np.array([3, 4, 1, 2, 5, 6, 7, 8]) / np.sqrt(204)
    np.testing.assert_allclose(join(tokens, config), expected, atol=1e-7)


@pytest.mark.parametrize(
    ("grid", "cuts"),
    [
        # The published slices of the 16 x 16 grid: 8; 5, 11. And a wide grid, cut in proportion.
        ((16, 16), {2: ([0, 8, 16], [0, 8, 16]), 3: ([0, 5, 11, 16], [0, 5, 11, 16])}),
        ((6, 9), {2: ([0, 3, 6], [0, 4, 9]), 3: ([0, 2, 4, 6], [0, 3, 6, 9])}),
    ],
)
@pytest.mark.parametrize("exponent", [3.0, 1.7])
def test_the_pyramid_is_torchs_pooling_of_its_regions(grid, cuts, exponent: float) -> None:
    patches = np.random.default_rng(0).normal(size=(grid[0] * grid[1], 20)).astype(np.float32)
    found = gem_pyramid(GemPyramid(jnp.asarray(exponent)), jnp.asarray(patches), grid)
    maps = torch.nn.functional.normalize(torch.tensor(patches).T.reshape(1, 20, *grid), dim=1)
    regions = [
        torch.nn.functional.lp_pool2d(
            (region := maps[:, :, top:bottom, left:right].clamp(min=1e-6)),
            exponent,
            kernel_size=region.shape[2:],
        )[0, :, 0, 0]
        # A sum of powers where this is a mean.
        / ((bottom - top) * (right - left)) ** (1 / exponent)
        for rows, columns in cuts.values()
        for top, bottom in itertools.pairwise(rows)
        for left, right in itertools.pairwise(columns)
    ]
    assert len(regions) == 13
    # Means of at most 81 numbers below 1, each the result of two powers of a few roundings.
    np.testing.assert_allclose(found, torch.stack(regions), atol=2e-6)


def test_the_pyramid_starts_at_the_published_exponent() -> None:
    pyramid = init_aggregator(
        jax.random.key(0), dataclasses.replace(MODEL, aggregator="gem-pyramid")
    )
    assert isinstance(pyramid, GemPyramid)
    assert (pyramid.p.shape, float(pyramid.p)) == ((), 3.0)  # CricaVPR's GeM(p=3)


def test_a_class_token_is_all_there_is() -> None:
    config = dataclasses.replace(MODEL, aggregator="class-token")
    assert init_aggregator(jax.random.key(0), config) is None
    features = Features(jnp.array([3.0, 4.0]), jnp.ones((9, 2)))
    tokens = aggregate(None, features, (3, 3), config, key=None)
    np.testing.assert_allclose(join(tokens, config), [0.6, 0.8], atol=1e-7)


def test_small_features_of_low_precision_are_pooled_in_float32() -> None:
    config = dataclasses.replace(MODEL, aggregator="gem-pyramid")
    patches = jax.random.normal(jax.random.key(0), (9, 64)).astype(jnp.bfloat16)
    features = Features(patches[0], patches)
    tokens = aggregate(
        init_aggregator(jax.random.key(0), config), features, (3, 3), config, key=None
    )
    assert tokens.local.dtype == tokens.global_token.dtype == jnp.float32
