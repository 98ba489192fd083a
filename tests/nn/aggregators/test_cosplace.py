"""CosPlace's head against torch's modules in the published order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from torch.nn import functional as F

from crisalad_jax.nn.aggregators.base import to_descriptor
from crisalad_jax.nn.aggregators.gem import CosPlace, CosPlaceConfig
from crisalad_jax.nn.backbones.base import Features
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.layers import Linear

CONFIG = CosPlaceConfig(dim=7)


@pytest.mark.parametrize("p", [3.0, 1.6])
def test_the_descriptor_is_torchs(p: float) -> None:
    rng = np.random.default_rng(0)
    patches = rng.normal(size=(2, 6, 12)).astype(np.float32)
    weight, bias = rng.normal(size=(7, 12)).astype(np.float32), np.arange(7, dtype=np.float32)
    unit = F.normalize(torch.tensor(patches).mT, dim=1).clamp(min=1e-6)
    # A sum of powers over the 6 patches, where the head has their mean.
    mean = F.lp_pool1d(unit, p, kernel_size=6)[..., 0] / 6 ** (1 / p)
    expected = F.normalize(F.linear(mean, torch.tensor(weight), torch.tensor(bias)), dim=1)

    params = CosPlace(jnp.asarray(p), Linear(jnp.asarray(weight.T), jnp.asarray(bias)))
    features = Features(jnp.zeros((2, 12)), jnp.asarray(patches))
    tokens = CONFIG.apply(params, features, (2, 3), key=None)
    assert tokens.local.shape == (2, 0, 7)
    found = jax.vmap(lambda one: to_descriptor(one, CONFIG))(tokens)
    # Two powers of a few roundings and 12 products, scaled below 1.
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_it_starts_as_published() -> None:
    params = CONFIG.init(jax.random.key(0), ViTConfig(dim=12, heads=1), (16, 16))
    assert isinstance(params, CosPlace)
    assert float(params.p) == 3.0
    bound = 12**-0.5  # torch's nn.Linear
    assert 0.7 * bound < jnp.abs(params.fc.weight).max() <= bound
    assert params.fc.bias is not None
    assert params.fc.bias.any()  # EigenPlaces and CosPlace alike have a bias
