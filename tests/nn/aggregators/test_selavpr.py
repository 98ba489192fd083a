"""Transposed convolutions and local features against torch."""

import jax
import jax.numpy as jnp
import numpy as np
import torch

from crisalad_jax.nn.aggregators.selavpr import SelaVprConfig, local_features, upconv
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.layers import Conv

CONFIG = SelaVprConfig(hidden=6, local=4)


def as_torch(array: jax.Array) -> torch.Tensor:
    return torch.tensor(np.asarray(array))


def torch_upconv(params: Conv, x: torch.Tensor) -> torch.Tensor:
    weight = as_torch(params.weight).permute(2, 3, 0, 1)
    return torch.nn.functional.conv_transpose2d(x, weight, as_torch(params.bias), 2, padding=1)


def test_local_features_equal_torch() -> None:
    params = CONFIG.init(jax.random.key(0), ViTConfig(dim=8, heads=2), (3, 5))
    patches = jax.random.normal(jax.random.key(1), (2, 15, 8))
    maps = as_torch(patches).reshape(2, 3, 5, 8).permute(0, 3, 1, 2)
    expected = torch_upconv(params.upconv1, maps)
    found = upconv(params.upconv1, patches.reshape(2, 3, 5, 8))
    # Sums of at most 4 x 8 products of order 1.
    np.testing.assert_allclose(found, expected.permute(0, 2, 3, 1), atol=1e-5)

    expected = torch_upconv(params.upconv2, torch.relu(expected))
    expected = torch.nn.functional.normalize(expected, dim=1).permute(0, 2, 3, 1)
    local = local_features(params, patches, (3, 5))
    assert local.shape == (2, *CONFIG.local_grid((3, 5)), 4) == (2, 9, 17, 4)
    # Float32 rounding of sums of at most 4 x 6 products, divided by a norm of at least 0.09.
    np.testing.assert_allclose(local, expected, atol=1e-6)
    np.testing.assert_allclose(local_features(params, patches[0], (3, 5)), local[0], atol=1e-6)


def test_convolutions_start_as_torchs() -> None:
    """Uniform within 1 / sqrt(9 x channels out): 1 / sqrt(54)."""
    drawn = CONFIG.init(jax.random.key(0), ViTConfig(dim=64, heads=2), (3, 5)).upconv1
    there = torch.nn.ConvTranspose2d(64, 6, 3, stride=2, padding=1)
    for ours, theirs in ((drawn.weight, there.weight), (drawn.bias, there.bias)):
        assert float(jnp.abs(ours).max()) <= 54**-0.5
        assert float(theirs.detach().abs().max()) <= 54**-0.5
    # Of 3,456 draws the largest is within a hundredth of the bound, there and here.
    assert min(float(jnp.abs(drawn.weight).max()), float(there.weight.detach().abs().max())) > 0.134
