"""The aggregators beside SALAD, by hand and by torch's pooling; the order of a descriptor."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax.config.registry import REGISTRIES
from crisalad_jax.nn.aggregators.backbone_tokens import ClassTokenConfig
from crisalad_jax.nn.aggregators.base import Aggregator, to_descriptor
from crisalad_jax.nn.aggregators.gem import Gem, GemPyramidConfig, gem_pyramid
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.backbones.base import Features
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.tokens import Tokens

KEY, VIT = jax.random.key(0), ViTConfig()


@pytest.mark.parametrize(
    ("aggregator", "order"),
    [
        (SaladConfig(clusters=3), [3, 4, 1, 5, 7, 2, 6, 8]),  # clusters by dimension
        (GemPyramidConfig(), [3, 4, 1, 2, 5, 6, 7, 8]),  # region after region
    ],
)
def test_a_descriptor_is_the_global_token_then_the_local_ones(
    aggregator: Aggregator, order: list[int]
) -> None:
    tokens = Tokens(jnp.array([3.0, 4.0]), jnp.array([[1.0, 2.0], [5.0, 6.0], [7.0, 8.0]]))
    # One rounding of a square root and of a product, of numbers below 1.
    expected = np.array(order) / np.sqrt(204)
    np.testing.assert_allclose(to_descriptor(tokens, aggregator), expected, atol=1e-7)


DIMENSION_FIRST = {"boq", "conv-ap", "edtformer", "fol", "mixvpr", "salad"}
"""Whose authors' code flattens (dimension, token)."""


@pytest.mark.parametrize("name", REGISTRIES["aggregator"])
def test_descriptors_have_the_published_order(name: str) -> None:
    aggregator = REGISTRIES["aggregator"].make(name)
    tokens = Tokens.of_local(jnp.arange(12.0).reshape(3, 4))
    first = np.array([0, 4, 8, 1] if name in DIMENSION_FIRST else [0, 1, 2, 3])
    # Divided by the root of 0 + 1 + 4 ... + 121.
    np.testing.assert_allclose(to_descriptor(tokens, aggregator)[:4], first / 506**0.5, rtol=1e-6)


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
    found = gem_pyramid(jnp.asarray(patches), jnp.asarray(exponent), grid)
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
    pyramid = GemPyramidConfig().init(KEY, VIT, (16, 16))
    assert isinstance(pyramid, Gem)
    assert (pyramid.p.shape, float(pyramid.p)) == ((), 3.0)  # CricaVPR's GeM(p=3)


def test_a_class_token_is_all_there_is() -> None:
    config = ClassTokenConfig()
    assert config.init(KEY, VIT, (16, 16)) is None
    features = Features(jnp.array([3.0, 4.0]), jnp.ones((9, 2)))
    tokens = config.apply(None, features, (3, 3), key=None)
    np.testing.assert_allclose(to_descriptor(tokens, config), [0.6, 0.8], atol=1e-7)


def test_small_features_of_low_precision_are_pooled_in_float32() -> None:
    config = GemPyramidConfig()
    patches = jax.random.normal(jax.random.key(0), (9, 64)).astype(jnp.bfloat16)
    features = Features(patches[0], patches)
    params = config.init(KEY, ViTConfig(dim=64, heads=1), (3, 3))
    tokens = config.apply(params, features, (3, 3), key=None)
    assert tokens.local.dtype == tokens.global_token.dtype == jnp.float32
