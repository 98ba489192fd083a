"""Conv-AP against torch's convolution and adaptive pooling in the published order, and by hand."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax.nn.aggregators.base import to_descriptor
from crisalad_jax.nn.aggregators.conv_ap import ConvAp, ConvApConfig, adaptive_means
from crisalad_jax.nn.backbones.base import Features
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.nn.layers import Linear

CONFIG = ModelConfig(
    backbone=ViTConfig(dim=12, heads=1),
    aggregator=ConvApConfig(channels=6),
    cross_image=CrossImageConfig(layers=0),
)


def test_regions_that_do_not_divide_overlap() -> None:
    """Of 3 x 3 patches 0 to 8, four regions of 2 x 2 that all have the one in the middle."""
    found = adaptive_means(jnp.arange(9.0)[:, None], (3, 3), 2)
    np.testing.assert_array_equal(found[:, 0], [2, 3, 5, 6])


@pytest.mark.parametrize(("grid", "side"), [((5, 7), 2), ((4, 6), 2), ((5, 7), 3), ((2, 3), 1)])
def test_the_descriptor_is_torchs(grid: tuple[int, int], side: int) -> None:
    rng = np.random.default_rng(0)
    patches = rng.normal(size=(2, grid[0] * grid[1], 12)).astype(np.float32)
    weight, bias = rng.normal(size=(6, 12)).astype(np.float32), np.arange(6, dtype=np.float32)
    maps = torch.tensor(patches).mT.unflatten(2, grid)
    convolved = torch.conv2d(maps, torch.tensor(weight)[..., None, None], torch.tensor(bias))
    pooled = torch.nn.AdaptiveAvgPool2d((side, side))(convolved)
    expected = torch.nn.functional.normalize(pooled.flatten(1), dim=1)

    config = dataclasses.replace(CONFIG, aggregator=ConvApConfig(channels=6, side=side))
    params = ConvAp(Linear(jnp.asarray(weight.T), jnp.asarray(bias)))
    features = Features(jnp.zeros((2, 12)), jnp.asarray(patches))
    tokens = config.aggregator.apply(params, features, grid, key=None)
    found = jax.vmap(lambda one: to_descriptor(one, config.aggregator))(tokens)
    assert found.shape == (2, config.descriptor_dim) == (2, 6 * side**2)
    # Sums of 12 products and of at most 35 patches, scaled below 1.
    np.testing.assert_allclose(found, expected, atol=1e-6)
