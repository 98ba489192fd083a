"""Generalised means at their floor, regions by torch's pooling, the order of a descriptor."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax.config.registry import REGISTRIES
from crisalad_jax.nn.aggregators.backbone_tokens import ClassTokenConfig
from crisalad_jax.nn.aggregators.base import Aggregator, to_descriptor
from crisalad_jax.nn.aggregators.conv_ap import adaptive_means
from crisalad_jax.nn.aggregators.gem import (
    CosPlace,
    CosPlaceConfig,
    GemConfig,
    GemPyramidConfig,
    gem,
)
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.backbones.base import Features
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.errors import InputError

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


DIMENSION_FIRST = {"boq", "conv-ap", "edtformer", "fol", "mixvpr", "sage", "salad"}
"""Whose authors' code flattens (dimension, token)."""


@pytest.mark.parametrize("name", list(REGISTRIES["aggregator"]))
def test_descriptors_have_the_published_order(name: str) -> None:
    aggregator = REGISTRIES["aggregator"].make(name)
    tokens = Tokens.of_local(jnp.arange(12.0).reshape(3, 4))
    first = np.array([0, 4, 8, 1] if name in DIMENSION_FIRST else [0, 1, 2, 3])
    # Divided by the root of 0 + 1 + 4 ... + 121.
    np.testing.assert_allclose(to_descriptor(tokens, aggregator)[:4], first / 506**0.5, rtol=1e-6)


@pytest.mark.parametrize("config", [GemConfig(), GemPyramidConfig(), CosPlaceConfig(dim=7)])
def test_means_start_at_the_published_exponent(config: Aggregator) -> None:
    params = config.init(KEY, VIT, (16, 16))
    assert (params.p.shape, float(params.p)) == ((), 3.0)
    if isinstance(params, CosPlace):
        bound = 768**-0.5  # torch's nn.Linear
        assert 0.7 * bound < jnp.abs(params.fc.weight).max() <= bound
        assert params.fc.bias is not None
        assert params.fc.bias.any()  # EigenPlaces and CosPlace alike have a bias


@pytest.mark.parametrize("config", [GemConfig(), GemPyramidConfig(), ClassTokenConfig()])
def test_tokens_have_the_shape_that_is_allocated_for_them(config: Aggregator) -> None:
    features, params = Features(jnp.ones(6), jnp.ones((12, 6))), config.init(KEY, VIT, (3, 4))
    tokens = config.apply(params, features, (3, 4), key=None)
    shape = tokens.global_token.shape[-1], tokens.local.shape[-2]
    assert tuple(config.token_shape(6))[:2] == shape


def test_a_class_token_is_asked_for() -> None:
    words = "found resnet for aggregator gem-pyramid, expected one with a class token"
    with pytest.raises(InputError, match=words):
        ModelConfig(backbone="resnet", aggregator="gem-pyramid")


def test_negative_numbers_count_as_the_floor() -> None:
    found = gem(jnp.array([[-3.0, 4.0]]), jnp.asarray(3.0))
    # The floor's logarithm is 14, whose rounding is the exponential's relative error.
    np.testing.assert_allclose(found, [1e-6, 0.8], rtol=2e-6)


def test_channels_at_the_floor_have_gradients_under_high_exponents() -> None:
    """Where (1e-6)^8 is 0 in float32; by hand the mean is the floor whatever the exponent."""

    def total(patches: jax.Array, p: jax.Array) -> jax.Array:
        return gem(patches, p).sum()

    patches = -jnp.abs(jax.random.normal(KEY, (2, 9, 20)))
    value, slopes = jax.jit(jax.value_and_grad(total, argnums=(0, 1)))(patches, jnp.asarray(8.0))
    np.testing.assert_allclose(value, 40e-6, rtol=1e-5)
    np.testing.assert_array_equal(slopes[0], 0)
    # Equal numbers: the terms that cancel are of size log(1e-6) * 1e-6.
    np.testing.assert_allclose(slopes[1], 0, atol=1e-9)


@pytest.mark.parametrize(("grid", "side"), [((5, 7), 2), ((4, 6), 2), ((5, 7), 3), ((2, 3), 1)])
def test_regions_are_those_of_torchs_adaptive_pooling(grid: tuple[int, int], side: int) -> None:
    patches = np.random.default_rng(0).normal(size=(grid[0] * grid[1], 6)).astype(np.float32)
    pool = torch.nn.AdaptiveAvgPool2d((side, side))
    expected = pool(torch.tensor(patches).T.unflatten(1, grid)).flatten(1).T
    # Means of at most 35 numbers of order 1.
    found = adaptive_means(jnp.asarray(patches), grid, side)
    np.testing.assert_allclose(found, expected, atol=1e-6)


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
