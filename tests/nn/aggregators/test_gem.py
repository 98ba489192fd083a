"""The generalised mean by hand, in float64, and at its two ends."""

import jax
import jax.numpy as jnp
import numpy as np

from crisalad_jax.nn.aggregators.base import to_descriptor
from crisalad_jax.nn.aggregators.gem import Gem, GemConfig, gem
from crisalad_jax.nn.backbones.base import Features
from crisalad_jax.nn.backbones.vit import ViTConfig

PATCHES = np.random.default_rng(0).normal(size=(2, 9, 20)).astype(np.float32)


def test_any_exponent_in_float64() -> None:
    x = PATCHES.astype(np.float64)
    x = np.maximum(x / np.sqrt((x**2).sum(axis=-1, keepdims=True)), 1e-6)
    expected = (x**2.7).mean(axis=-2) ** (1 / 2.7)
    # Two float32 powers of numbers below 1.
    np.testing.assert_allclose(gem(jnp.asarray(PATCHES), jnp.asarray(2.7)), expected, atol=1e-6)


def test_negative_numbers_count_as_the_floor() -> None:
    found = gem(jnp.array([[-3.0, 4.0]]), jnp.asarray(3.0))
    # The floor's logarithm is 14, whose rounding is the exponential's relative error.
    np.testing.assert_allclose(found, [1e-6, 0.8], rtol=2e-6)


def test_channels_at_the_floor_have_gradients_under_high_exponents() -> None:
    """Where (1e-6)^8 is 0 in float32; by hand the mean is the floor whatever the exponent."""

    def total(patches: jax.Array, p: jax.Array) -> jax.Array:
        return gem(patches, p).sum()

    patches = -jnp.abs(jnp.asarray(PATCHES))
    value, slopes = jax.jit(jax.value_and_grad(total, argnums=(0, 1)))(patches, jnp.asarray(8.0))
    np.testing.assert_allclose(value, 40e-6, rtol=1e-5)
    np.testing.assert_array_equal(slopes[0], 0)
    # Equal numbers: the terms that cancel are of size log(1e-6) * 1e-6.
    np.testing.assert_allclose(slopes[1], 0, atol=1e-9)


def test_the_descriptor_is_the_mean_of_an_image_at_length_1() -> None:
    config = GemConfig()
    params = config.init(jax.random.key(0), ViTConfig(dim=20, heads=1), (16, 16))
    assert isinstance(params, Gem)
    assert (params.p.shape, float(params.p)) == ((), 3.0)  # as published
    features = Features(jnp.zeros((2, 20)), jnp.asarray(PATCHES))
    tokens = config.apply(params, features, (3, 3), key=None)
    assert (tokens.global_token.shape, tokens.local.shape) == ((2, 20), (2, 0, 20))
    mean = np.asarray(gem(jnp.asarray(PATCHES), params.p))
    for i in range(2):
        found = to_descriptor(jax.tree.map(lambda leaf, i=i: leaf[i], tokens), config)
        np.testing.assert_allclose(found, mean[i] / np.linalg.norm(mean[i]), atol=1e-6)
