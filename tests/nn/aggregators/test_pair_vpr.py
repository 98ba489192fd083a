"""Pair-VPR's decoder against torch's layers; the public code's outputs are in parity/."""

import dataclasses

import jax
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from crisalad_jax.nn.aggregators.pair_vpr import PairVpr, PairVprConfig
from crisalad_jax.nn.attention import Attention
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.layers import LayerNorm, Linear
from crisalad_jax.retrieval.reranking import pair_vpr
from crisalad_jax.utils.errors import InputError
from tests.conftest import random_params

PART = PairVprConfig(dim=16, width=128, layers=2, hidden=8, positions=25)
CONFIG = ModelConfig(
    image_size=(42, 56),
    backbone=ViTConfig(dim=32, depth=1, heads=2, position_grid=3, adapter="none"),
    aggregator=PART,
    cross_image="none",
)


def tensor(array: jax.Array) -> Tensor:
    return torch.from_numpy(np.array(array))


def linear(layer: Linear, x: Tensor) -> Tensor:
    assert layer.bias is not None
    return x @ tensor(layer.weight) + tensor(layer.bias)


def norm(layer: LayerNorm, x: Tensor) -> Tensor:
    return F.layer_norm(x, x.shape[-1:], tensor(layer.weight), tensor(layer.bias), 1e-6)


def attend(layer: Attention, x: Tensor, other: Tensor) -> Tensor:
    """Torch's attention of two heads, from `x` to `other`."""
    query, key, value = (
        part.unflatten(-1, (2, 64)).transpose(-2, -3)
        for part in (
            linear(layer.qkv, x)[..., :128],
            linear(layer.qkv, other)[..., 128:256],
            linear(layer.qkv, other)[..., 256:],
        )
    )
    mixed = F.scaled_dot_product_attention(query, key, value)
    return linear(layer.proj, mixed.transpose(-2, -3).flatten(-2))


def logit(params: PairVpr, first: Tensor, second: Tensor) -> float:
    grid = tensor(params.positions).reshape(1, 5, 5, 128).permute(0, 3, 1, 2)
    grid = F.interpolate(grid, size=(3, 4), mode="bicubic")[0].flatten(1).T
    x, memory = (linear(params.embed, patches) + grid for patches in (first, second))
    x = torch.cat([tensor(params.cls_token)[None], x])
    for layer in params.layers:
        normed = norm(layer.norm1, x)
        x = x + attend(layer.attn, normed, normed)
        x = x + attend(layer.cross_attn, norm(layer.norm2, x), norm(layer.norm_other, memory))
        x = x + linear(layer.mlp.fc2, F.gelu(linear(layer.mlp.fc1, norm(layer.norm3, x))))
    hidden = F.relu(linear(params.score.fc1, norm(params.norm, x)[0]))
    return linear(params.score.fc2, hidden).item()


def test_a_pairs_score_is_torchs() -> None:
    """In float32: sums of 128 numbers through two layers."""
    params = random_params(CONFIG)
    patches = np.random.default_rng(0).normal(size=(3, 12, 32)).astype(np.float32)
    own, torchs = params.aggregator, torch.from_numpy(patches)
    expected = [
        logit(own, torchs[0], torchs[i]) + logit(own, torchs[i], torchs[0]) for i in range(3)
    ]
    found = pair_vpr.scores(params, patches[0], patches, CONFIG)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
    assert np.ptp(expected) > 0.05
    one_way = logit(own, torchs[0], torchs[1]) - logit(own, torchs[1], torchs[0])
    assert abs(one_way) > 0.01  # the order within a pair matters


def test_sizes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match="positions: found 24, expected a square number"):
        dataclasses.replace(PART, positions=24)
    with pytest.raises(InputError, match="width: found 200, expected a multiple of its 3 heads"):
        dataclasses.replace(PART, width=200)
