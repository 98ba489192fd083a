"""BoQ's size, last norm and start; parity/ compares it with torch's transformer modules."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from torch.nn import functional as F

from crisalad_jax.nn.aggregators.queries import Boq, BoqConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import extract_features
from tests.conftest import random_params

CONFIG = ModelConfig(
    image_size=(28, 42),
    backbone=ViTConfig(dim=12, depth=1, heads=1, position_grid=2, adapter="none"),
    # Two heads.
    aggregator=BoqConfig(channels=128, queries=3, layers=2, rows=5),
    cross_image="none",
)


def test_the_published_model_has_12288_numbers() -> None:
    config = ModelConfig(image_size=(322, 322), aggregator="boq", cross_image="none")
    assert config.descriptor_dim == 12_288
    assert config.aggregator.heads == 6


def test_patches_go_through_the_last_norm_only_if_asked_for() -> None:
    params = random_params(CONFIG)
    images = np.random.default_rng(0).integers(0, 256, (2, 28, 42, 3), np.uint8)
    asked = dataclasses.replace(CONFIG.aggregator, last_norm=True)
    without = extract_features(params, images, CONFIG).patches
    found = extract_features(params, images, dataclasses.replace(CONFIG, aggregator=asked)).patches
    norm = params.backbone.norm
    weight, bias = (torch.tensor(np.asarray(x)) for x in (norm.weight, norm.bias))
    expected = F.layer_norm(torch.tensor(np.asarray(without)), (12,), weight, bias, 1e-6)
    # Float32's rounding in one layer norm.
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    assert np.abs(without - found).max() > 0.1


@pytest.mark.slow
def test_it_starts_as_torch_does() -> None:
    """Queries normal of deviation 1; attention Glorot-uniform with zero biases."""
    config = BoqConfig(channels=64, queries=40, layers=1)
    init = jax.jit(lambda key: config.init(key, CONFIG.backbone, CONFIG.grid))
    params = init(jax.random.key(0))
    assert isinstance(params, Boq)
    (block,) = params.boqs
    np.testing.assert_allclose(jnp.std(block.queries), 1, rtol=0.06)  # of 2,560 draws: 1.4 %
    for attention in (block.self_attn, block.cross_attn, block.encoder.attn):
        bound = np.sqrt(6 / (64 + 3 * 64))
        assert 0.99 * bound < jnp.abs(attention.qkv.weight).max() <= bound
        for layer in (attention.qkv, attention.proj):
            assert layer.bias is not None
            assert not layer.bias.any()
