"""Visual prompts against torch's `nn.TransformerEncoderLayer`, and how they leave the tokens."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from torch.nn import functional as F

import crisalad_jax as cj
from crisalad_jax.nn.adapters.prompts import PromptsConfig
from crisalad_jax.nn.backbones import vit
from crisalad_jax.nn.backbones.base import FeatureSpec
from crisalad_jax.nn.backbones.vit import NORM_EPSILON, ViTConfig, run_blocks
from crisalad_jax.nn.layers import Linear

CONFIG = ViTConfig(dim=16, depth=2, heads=2, mlp_ratio=2.0, adapter=PromptsConfig(count=3))


def torch_layer(params: Any) -> torch.nn.Module:
    """Make torch's pre-norm layer of a block, whose LayerScale is 1."""
    layer = torch.nn.TransformerEncoderLayer(
        16, 2, 32, 0.0, F.gelu, layer_norm_eps=NORM_EPSILON, batch_first=True, norm_first=True
    )

    def weights(ours: Linear) -> dict[str, torch.Tensor]:
        return {
            "weight": torch.tensor(np.array(ours.weight.T)),
            "bias": torch.tensor(np.array(ours.bias)),
        }

    attn = weights(params.attn.qkv)
    state = {"self_attn.in_proj_weight": attn["weight"], "self_attn.in_proj_bias": attn["bias"]}
    named = {
        "self_attn.out_proj": weights(params.attn.proj),
        "linear1": weights(params.mlp.fc1),
        "linear2": weights(params.mlp.fc2),
    }
    state |= {f"{name}.{k}": x for name, each in named.items() for k, x in each.items()}
    layer.load_state_dict(state, strict=False)  # norms start as ours
    return layer


def test_two_blocks_and_the_prompts_gradients_equal_torchs(monkeypatch) -> None:
    """Each block has its own prompts, and drops those of the block before."""
    # As a GPU pads: 3 prompts and 7 tokens to 16.
    monkeypatch.setattr(vit, "padded_length", lambda tokens, *_: 16)
    stack = CONFIG.init(jax.random.key(0)).blocks
    keys = jax.random.split(jax.random.key(1), 3)
    prompts = jax.random.normal(keys[0], (2, 3, 16))
    tokens = jax.random.normal(keys[1], (2, 7, 16))
    weights = jax.random.normal(keys[2], (2, 7, 16))

    def loss(prompts: jax.Array) -> tuple[jax.Array, jax.Array]:
        adapter = dataclasses.replace(stack.adapter, tokens=prompts)
        blocks = [dataclasses.replace(stack, adapter=adapter)]
        found, _ = run_blocks(blocks, tokens, (2, 3), CONFIG)
        return (found * weights).sum(), found

    gradient, found = jax.jit(jax.grad(loss, has_aux=True))(prompts)

    layers = [torch_layer(jax.tree.map(lambda x, i=i: x[i], stack)) for i in range(2)]
    theirs = torch.tensor(np.array(prompts), requires_grad=True)
    x = torch.tensor(np.array(tokens))
    for layer, own in zip(layers, theirs, strict=True):
        x = layer(torch.cat([own.expand(2, -1, -1), x], dim=1))[:, 3:]
    (x * torch.tensor(np.array(weights))).sum().backward()
    # Sums of at most 32 products of order 1, in float32.
    np.testing.assert_allclose(found, x.detach(), rtol=1e-5, atol=5e-6)
    np.testing.assert_allclose(gradient, theirs.grad, rtol=1e-4, atol=1e-5)


def test_features_have_no_prompts() -> None:
    params = CONFIG.init(jax.random.key(0))
    bound = np.sqrt(3 / 16)
    assert params.blocks.adapter.tokens.shape == (2, 3, 16)
    assert 0.9 * bound < abs(params.blocks.adapter.tokens).max() <= bound
    images = jnp.zeros((1, 28, 42, 3))
    found, _ = CONFIG.apply(params, images, FeatureSpec((1, 2)))
    assert (found.class_token.shape, found.patches.shape) == ((1, 16), (1, 6, 2 * 16))
    with pytest.raises(cj.InputError, match="class token's attention and adapters with prompts"):
        CONFIG.apply(params, images, FeatureSpec(class_attention=True))
