"""Attention of blocks and across images, against the weights of torch's nn.MultiheadAttention."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax.nn.aggregators.salad import FolConfig
from crisalad_jax.nn.attention import Attention
from crisalad_jax.nn.backbones.dinov3 import DinoV3Config
from crisalad_jax.nn.backbones.vit import embed, run_blocks
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import GatedCrossImageConfig
from crisalad_jax.nn.layers import gelu, layer_norm
from crisalad_jax.nn.model import (
    attention_maps,
    cross_image_attention,
    extract_features,
    extract_tokens,
)
from crisalad_jax.nn.pixels import normalise
from crisalad_jax.nn.tokens import as_sequence
from crisalad_jax.nn.torch_layers import encoder_layer
from crisalad_jax.utils.errors import InputError
from tests.conftest import MODEL, random_params

PICTURES = np.random.default_rng(0).integers(0, 256, (3, 42, 56, 3), dtype=np.uint8)
# Softmax of scores of order 1 in float32, whose sums two libraries take in other orders.
TOLERANCE = 1e-6


def torchs(params: Attention, x: Any, heads: int, mask: Any = None) -> tuple[Any, Any]:
    """The output and the weights of each head."""
    layer = torch.nn.MultiheadAttention(x.shape[-1], heads, batch_first=True)
    names = {"in_proj_weight": params.qkv.weight.T, "out_proj.weight": params.proj.weight.T}
    names |= {"in_proj_bias": params.qkv.bias, "out_proj.bias": params.proj.bias}
    layer.load_state_dict({name: torch.tensor(np.array(x)) for name, x in names.items()})
    x = torch.tensor(np.array(x))
    blocked = None if mask is None else torch.tensor(~np.asarray(mask))
    with torch.no_grad():
        return layer(x, x, x, attn_mask=blocked, average_attn_weights=False)


@pytest.mark.parametrize("block", [0, -1])
def test_maps_of_a_block_are_torchs_weights(block: int) -> None:
    params, backbone = random_params(MODEL), MODEL.backbone
    pixels = jnp.stack([normalise(jnp.asarray(image), MODEL.preprocessing) for image in PICTURES])
    tokens = embed(params.backbone, pixels, backbone)
    number = block % backbone.depth
    stacks = [params.backbone.blocks]
    tokens, _ = run_blocks(stacks, tokens, backbone.grid((42, 56)), backbone, count=number)
    layer = jax.tree.map(lambda x: x[number], params.backbone.blocks)
    normed = layer_norm(layer.norm1, tokens, epsilon=1e-6)
    _, expected = torchs(layer.attn, normed, backbone.heads)
    found = attention_maps(params, PICTURES, MODEL, block=block)
    assert found.shape == (3, 2, 13, 13)  # a class token and 3 x 4 patches
    assert np.std(np.asarray(expected)) > 0.01  # they are not even
    np.testing.assert_allclose(found, expected, atol=TOLERANCE)


@pytest.mark.parametrize("backbone", ["vit", "dinov3", "lora"])
def test_the_class_tokens_row_is_what_a_head_asks_for(backbone: str) -> None:
    """Features of FoL have that of the last block, summed over heads, by another way."""
    vit, size = MODEL.backbone, MODEL.image_size
    if backbone == "dinov3":
        vit, size = DinoV3Config(dim=32, depth=2, heads=2, registers=2), (48, 64)
    elif backbone == "lora":
        vit = dataclasses.replace(vit, adapter="lora")
    head = FolConfig(clusters=4, cluster_dim=8, token_dim=16, hidden=16)
    config = ModelConfig(size, backbone=vit, aggregator=head, cross_image="none")
    pictures = np.resize(PICTURES, (2, *config.image_size, 3))
    params = random_params(config)
    expected = extract_features(params, pictures, config).class_attention
    maps = attention_maps(params, pictures, config)
    found = maps[:, :, 0, 1 + vit.registers :].sum(axis=1)
    np.testing.assert_allclose(maps.sum(axis=-1), 1, atol=TOLERANCE)
    np.testing.assert_allclose(found, expected, atol=TOLERANCE)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("gated", [False, True])
def test_who_attends_to_whom_is_torchs(masked: bool, gated: bool) -> None:
    config = MODEL
    if gated:
        config = dataclasses.replace(MODEL, cross_image=GatedCrossImageConfig(2, 2, 16))
    params = random_params(config)
    encoder = params.cross_image.encoder if gated else params.cross_image
    mask = np.array([[1, 1, 0], [0, 1, 1], [1, 1, 1]], bool) if masked else None
    tokens = extract_tokens(params, PICTURES, config)
    tokens = as_sequence(tokens, global_token=True).swapaxes(0, 1)  # a sequence of images a token
    found = cross_image_attention(params, PICTURES, config, mask=mask)
    assert found.shape == (2, 6, 2, 3, 3)
    for layer, weights in zip(encoder.layers, found, strict=True):
        attended, expected = torchs(layer.attn, tokens, 2, mask)
        np.testing.assert_allclose(weights, expected, atol=TOLERANCE)
        tokens = encoder_layer(layer, tokens, jnp.asarray(attended.numpy()), gelu)
    assert np.std(found) > 0.01


@pytest.mark.parametrize(
    ("config", "call", "message"),
    [
        (
            MODEL,
            lambda p, c: attention_maps(p, PICTURES, c, block=2),
            "block: found 2, expected -2",
        ),
        (
            ModelConfig(backbone="resnet", aggregator="gem", cross_image="none"),
            lambda p, c: attention_maps(p, PICTURES, c),
            "backbone: found resnet, expected one that has attention",
        ),
        (
            dataclasses.replace(MODEL, cross_image="none"),
            lambda p, c: cross_image_attention(p, PICTURES, c),
            "cross_image: found none, expected one that has attention",
        ),
    ],
)
def test_what_has_no_attention_is_refused(config: Any, call: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call(random_params(config), config)
