"""MixVPR against torch's modules as published, by hand, and bound to its grid."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

from crisalad_jax.nn.aggregators.base import to_descriptor
from crisalad_jax.nn.aggregators.mixvpr import FeatureMixer, MixVpr, MixVprConfig
from crisalad_jax.nn.backbones.base import Features
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.nn.layers import LayerNorm, Linear
from crisalad_jax.nn.model import parameter_shapes

CONFIG = ModelConfig(
    image_size=(28, 42),
    backbone=ViTConfig(dim=12, heads=1),
    aggregator=MixVprConfig(channels=5, rows=3, depth=2),
    cross_image=CrossImageConfig(layers=0),
)
PATCHES = np.random.default_rng(0).normal(size=(2, 6, 12)).astype(np.float32)


def descriptors(params: MixVpr, patches: np.ndarray) -> jax.Array:
    features = Features(jnp.zeros((len(patches), 12)), jnp.asarray(patches))
    tokens = CONFIG.aggregator.apply(params, features, (2, 3), key=None)
    return jax.vmap(lambda one: to_descriptor(one, CONFIG.aggregator))(tokens)


def linear_of(layer: nn.Module) -> Linear:
    assert isinstance(layer, nn.Linear)
    return Linear(jnp.asarray(layer.weight.detach().T.numpy()), jnp.asarray(layer.bias.detach()))


def test_the_descriptor_is_torchs() -> None:
    torch.manual_seed(0)
    mixers = [
        nn.Sequential(nn.LayerNorm(6), nn.Linear(6, 6), nn.ReLU(), nn.Linear(6, 6))
        for _ in range(2)
    ]
    channels, rows = nn.Linear(12, 5), nn.Linear(6, 3)
    maps = torch.tensor(PATCHES).mT
    for mixer in mixers:
        nn.init.uniform_(mixer[0].weight, 0.5, 1.5)
        nn.init.uniform_(mixer[0].bias, -0.5, 0.5)
        maps = maps + mixer(maps)
    maps = channels(maps.permute(0, 2, 1)).permute(0, 2, 1)
    expected = F.normalize(rows(maps).flatten(1), dim=1).detach()

    params = MixVpr(
        mix=tuple(
            FeatureMixer(
                LayerNorm(jnp.asarray(one[0].weight.detach()), jnp.asarray(one[0].bias.detach())),
                linear_of(one[1]),
                linear_of(one[3]),
            )
            for one in mixers
        ),
        channel_proj=linear_of(channels),
        row_proj=linear_of(rows),
    )
    found = descriptors(params, PATCHES)
    assert found.shape == (2, CONFIG.descriptor_dim) == (2, 15)
    # Four products of at most 12 terms after one another, scaled below 1.
    np.testing.assert_allclose(found, expected, atol=2e-6)


def test_it_starts_as_published() -> None:
    config = ModelConfig(aggregator="mixvpr", cross_image=CrossImageConfig(layers=0))
    assert config.descriptor_dim == 4096
    params = parameter_shapes(config).aggregator
    assert len(params.mix) == 4
    config = dataclasses.replace(CONFIG, image_size=(224, 224))
    params = config.aggregator.init(jax.random.key(0), config.backbone, config.grid)
    assert isinstance(params, MixVpr)
    for mixer in params.mix:
        for layer in (mixer.fc1, mixer.fc2):
            assert layer.weight.shape == (256, 256)
            # The deviation of 65,536 draws is known to 0.3 %.
            np.testing.assert_allclose(jnp.std(layer.weight), 0.02, rtol=0.01)
            assert layer.bias is not None
            assert not layer.bias.any()
