"""The backbone's parts that parity/ does not compare with torch."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax.nn.adapters import TokenInfo
from crisalad_jax.nn.adapters.bottleneck import MlpAdapter, SideConfig
from crisalad_jax.nn.attention import attention
from crisalad_jax.nn.backbones.base import FeatureSpec
from crisalad_jax.nn.backbones.dinov3 import DinoV3Config
from crisalad_jax.nn.backbones.vit import (
    NORM_EPSILON,
    VisionTransformer,
    ViT,
    ViTConfig,
    block,
    feed_forward,
    run_blocks,
)
from crisalad_jax.nn.layers import LayerNorm, layer_norm
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.target import CPU, GPU, TPU, Target, lowering_for

CONFIG = ViTConfig(dim=16, depth=3, heads=2, position_grid=5)


def images(*size: int, seed: int = 0) -> jax.Array:
    return jax.random.normal(jax.random.key(seed), (*size, 3))


def test_the_published_hidden_width_of_vit_g() -> None:
    """blocks.*.mlp.w3.weight of dinov2_vitg14 is (1536, 4096)."""
    assert ViTConfig(dim=1536, depth=1, heads=24, ffn="swiglu").hidden == 4096


def test_serial_and_parallel_adapters_by_hand() -> None:
    """x' = x + ls1 * (a + S(a)) of attention a; x' + ls2 * (MLP + 0.2 P) of the normed x'."""
    kind = "serial-parallel"
    config = dataclasses.replace(CONFIG, depth=1, layer_scale_init=0.5, adapter=kind)
    layer = jax.tree.map(lambda leaf: leaf[0], config.init(jax.random.key(0)).blocks)
    key = jax.random.key(1)
    adapters = jax.tree.map(lambda leaf: jax.random.normal(key, leaf.shape), layer.adapter)
    tokens = jax.random.normal(jax.random.key(2), (1, 7, 16))

    def mlp(params: MlpAdapter, x: jax.Array) -> jax.Array:
        hidden = jnp.maximum(x @ params.down.weight + params.down.bias, 0)
        return hidden @ params.up.weight + params.up.bias

    def normed(norm: LayerNorm, x: jax.Array) -> jax.Array:
        return layer_norm(norm, x, epsilon=NORM_EPSILON)

    a = attention(layer.attn, normed(layer.norm1, tokens), 2)
    middle = tokens + 0.5 * (a + mlp(adapters.serial, a))
    y = normed(layer.norm2, middle)
    expected = middle + 0.5 * (feed_forward(layer.mlp, y) + 0.2 * mlp(adapters.parallel, y))
    found, _ = block(
        dataclasses.replace(layer, adapter=adapters), tokens, TokenInfo((2, 3)), config
    )
    # Sums of at most 16 products of order 10.
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-4)


BARE = dataclasses.replace(CONFIG, adapter="none")
SIDE = dataclasses.replace(CONFIG, adapter=SideConfig(alpha=0.5))


def test_side_adapters_take_the_sum_of_both_paths() -> None:
    """The trunk is that of no adapters; y = z + alpha A(z) of z = x + y, a block at a time."""
    params = SIDE.init(jax.random.key(0))
    up = params.blocks.adapter.up
    up = dataclasses.replace(up, weight=jax.random.normal(jax.random.key(1), up.weight.shape))
    changed = dataclasses.replace(params.blocks.adapter, up=up)
    params = dataclasses.replace(params, blocks=dataclasses.replace(params.blocks, adapter=changed))
    tokens = jax.random.normal(jax.random.key(2), (1, 1 + 6, 16))
    trunk, beside = tokens, tokens
    for i in range(CONFIG.depth):
        layer = jax.tree.map(lambda leaf, i=i: leaf[i], params.blocks)
        trunk, _ = block(dataclasses.replace(layer, adapter=None), trunk, TokenInfo((2, 3)), BARE)
        t = jax.tree.map(lambda leaf: torch.tensor(np.asarray(leaf)), layer.adapter)
        z = torch.tensor(np.asarray(trunk + beside))
        hidden = torch.nn.functional.gelu(z @ t.down.weight + t.down.bias)
        beside = (z + 0.5 * (hidden @ t.up.weight + t.up.bias)).numpy()
    found, _ = run_blocks([params.blocks], tokens, (2, 3), SIDE)
    # Sums of up to 16 numbers of order 10, three blocks deep.
    np.testing.assert_allclose(found, beside, rtol=1e-5, atol=2e-5)
    cut = SIDE.split_blocks(params, [1, 2]).blocks
    np.testing.assert_array_equal(run_blocks(cut, tokens, (2, 3), SIDE)[0], found)


@pytest.mark.parametrize(
    ("config", "request_", "words"),
    [
        (
            SIDE,
            FeatureSpec((1,)),
            "levels or a facet and adapters on a side path, expected only one of these",
        ),
        (SIDE, FeatureSpec(class_attention=True), "token's attention and adapters on a side path"),
        (
            SIDE,
            FeatureSpec(insertion=1, inserted=jnp.ones((2, 16))),
            "inserted tokens and adapters on a side path",
        ),
        (
            CONFIG,
            FeatureSpec((2,), class_attention=True),
            "levels or a facet and the class token's",
        ),
        (CONFIG, FeatureSpec((1, 2), "key"), r"found \(1, 2\) of facet key, expected numbers"),
        (
            CONFIG,
            FeatureSpec((2, 1)),
            r"found \(2, 1\) of facet token, expected numbers of blocks in order, 1 to 3",
        ),
    ],
)
def test_requests_that_cannot_be_met_are_refused(
    config: ViTConfig, request_: FeatureSpec, words: str
) -> None:
    params = jax.eval_shape(config.init, jax.random.key(0))
    with pytest.raises(InputError, match=words):
        jax.eval_shape(lambda p, x: config.apply(p, x, request_), params, images(1, 28, 42))


def test_sincos_positions_tell_places_apart_and_fall_off_with_distance() -> None:
    config = dataclasses.replace(CONFIG, position_init="sincos", dim=64)
    code = config.init(jax.random.key(0)).pos_embed.reshape(25, 64)
    similarity = np.asarray(code @ code.T)
    # sin^2 + cos^2 = 1 for each of 64 / 4 frequencies, of rows and of columns.
    np.testing.assert_allclose(np.diag(similarity), 32, rtol=1e-5)
    assert (similarity[0, 1:] < 31.9).all()
    assert similarity[0, 1] > similarity[0, 2] > similarity[0, 3]


@pytest.mark.parametrize("depths", [pytest.param((1, 2, 3), marks=pytest.mark.slow), (2, 3), (3,)])
def test_levels_are_the_normed_tokens_of_backbones_cut_short(depths: tuple[int, ...]) -> None:
    params = CONFIG.init(jax.random.key(0))
    expected = [
        CONFIG.apply(
            dataclasses.replace(params, blocks=jax.tree.map(lambda x, d=d: x[:d], params.blocks)),
            images(1, 28, 42),
        )[0]
        for d in depths
    ]
    two = tuple(
        jax.tree.map(lambda leaf, s=s: leaf[s], params.blocks) for s in (slice(2), slice(2, 3))
    )
    for blocks in (params.blocks, two):  # as it stands, and as training cuts it
        whole = dataclasses.replace(params, blocks=blocks)
        found, _ = CONFIG.apply(whole, images(1, 28, 42), FeatureSpec(depths))
        # The same sums, compiled twice.
        np.testing.assert_allclose(found.class_token, expected[-1].class_token, atol=1e-6)
        patches = np.concatenate([features.patches for features in expected], axis=-1)
        np.testing.assert_allclose(found.patches, patches, atol=1e-6)


def test_norms_have_dinov2s_epsilon() -> None:
    """Its code norms with an epsilon of 1e-6; here the tokens' deviation is of that size."""
    config = dataclasses.replace(CONFIG, depth=1, layer_scale_init=1e-3)
    params = jax.tree.map(lambda leaf: 1e-3 * leaf, config.init(jax.random.key(0)))
    params = dataclasses.replace(params, norm=LayerNorm(jnp.full(16, 2.0), jnp.full(16, 0.5)))
    requests = FeatureSpec(norm=False), FeatureSpec()
    features = [config.apply(params, images(1, 28, 42), request)[0] for request in requests]
    raw, found = (np.asarray(each.patches) for each in features)
    assert 1e-4 < raw.std() < 1e-2
    weight, bias = torch.full((16,), 2.0), torch.full((16,), 0.5)
    expected = torch.nn.functional.layer_norm(torch.tensor(raw), (16,), weight, bias, eps=1e-6)
    # Rounding of means and squares in float32.
    np.testing.assert_allclose(found, expected, atol=1e-4)


HALF = ViTConfig(dim=32, depth=2, heads=2, position_grid=3)
"""Of heads of 16, which cuDNN takes; 3 x 4 patches and a class token are padded to 16 tokens."""
INSERTED = jax.random.normal(jax.random.key(9), (2, 32))
REQUESTS = {
    "the last tokens": FeatureSpec(),
    "two levels": FeatureSpec((1, 2)),
    "a level before the last": FeatureSpec((1,)),
    "keys": FeatureSpec((2,), "key", norm=False),
    "class attention": FeatureSpec(class_attention=True),
    "inserted tokens": FeatureSpec(insertion=1, inserted=INSERTED),
}
SLOW = pytest.mark.slow
KINDS = {
    "depthwise": (),
    **dict.fromkeys(("multi-resolution", "serial-parallel", "side", "none"), SLOW),
}


def fresh(config: VisionTransformer) -> ViT:
    """Parameters of which every one matters: adapters do not start at 0."""
    params = config.init(jax.random.key(0))
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    noisy = [
        leaf + 0.1 * jax.random.normal(key, leaf.shape)
        for leaf, key in zip(leaves, keys, strict=True)
    ]
    return jax.tree.unflatten(tree, noisy)


@pytest.mark.parametrize(
    ("config", "name"),
    [
        *(pytest.param(HALF, name, marks=SLOW) for name in REQUESTS),
        *(
            pytest.param(dataclasses.replace(HALF, adapter=kind), "the last tokens", marks=marks)
            for kind, marks in KINDS.items()
        ),
        (dataclasses.replace(HALF, registers=3), "inserted tokens"),
        pytest.param(DinoV3Config(dim=32, depth=2, heads=2), "the last tokens", marks=SLOW),
        (DinoV3Config(dim=32, depth=2, heads=2), "keys"),
    ],
    ids=lambda each: each if isinstance(each, str) else "",
)
def test_padding_for_cudnn_changes_no_feature(
    stand_in: list[Any], config: VisionTransformer, name: str
) -> None:
    params, side = fresh(config), config.patch_size
    pixels = images(2, 3 * side, 4 * side).astype(jnp.bfloat16)

    def features(chosen: Target) -> list[np.ndarray]:
        with lowering_for(chosen):
            found, _ = config.apply(params, pixels, REQUESTS[name])
        return [np.asarray(leaf, np.float32) for leaf in jax.tree.leaves(found)]

    expected, found = features(CPU), features(GPU)
    # The blocks pad once: where attention is reached, its tokens are eights already.
    assert not any(shape[1] % 8 for shape, _ in stand_in)
    assert stand_in or name == "keys"
    for ours, theirs in zip(found, expected, strict=True):
        # bfloat16 keeps 8 bits, and the two divide at different places, in two blocks.
        np.testing.assert_allclose(ours, theirs, atol=0.04 * np.abs(theirs).max())


@pytest.mark.parametrize(
    "name",
    [
        "the last tokens",
        *(pytest.param(x, marks=pytest.mark.slow) for x in ("inserted tokens", "class attention")),
    ],
)
def test_a_tpus_kernel_changes_no_feature(interpreted: list[Any], name: str) -> None:
    """Where 13 tokens are padded to 16, and 15 to as many."""
    config = dataclasses.replace(HALF, dim=128)
    inserted = jax.random.normal(jax.random.key(9), (2, 128))
    request = dataclasses.replace(
        REQUESTS[name], inserted=None if REQUESTS[name].inserted is None else inserted
    )
    params, pixels = fresh(config), images(2, 42, 56)
    expected, _ = config.apply(params, pixels, request)
    with lowering_for(TPU), jax.default_matmul_precision("highest"):
        found, _ = config.apply(params, pixels, request)
    assert {shape.shape for shape in interpreted} == {(2, 16, 128)}
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        # Two blocks in float32, of features up to 4.
        np.testing.assert_allclose(ours, theirs, atol=1e-5)
