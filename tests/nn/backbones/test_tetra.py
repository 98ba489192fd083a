"""TeTRA's ternary backbone against integers of NumPy, and against torch's layers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from torch.nn import functional

from crisalad_jax.nn.backbones.base import FeatureSpec
from crisalad_jax.nn.backbones.tetra import TetraVit, TetraVitConfig, ternary_linear
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.layers import Linear
from crisalad_jax.utils.errors import InputError

SMALL = TetraVitConfig(dim=16, depth=3, heads=2, hidden=24, position_grid=2)


def rounded(x: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steps of 8 bits, weights of -1, 0 and 1, and what their products are divided by."""
    fine = np.float32(127) / np.abs(x).max(axis=-1, keepdims=True)
    coarse = 1 / np.abs(weight).mean(dtype=np.float32)
    signs = np.clip(np.rint(weight * coarse), -1, 1).astype(np.int64)
    return np.rint(x * fine).astype(np.int64), signs, fine * coarse


def test_a_ternary_layer_is_a_product_of_integers() -> None:
    generator = np.random.default_rng(0)
    x = generator.standard_normal((5, 7, 12)).astype(np.float32)
    weight = generator.standard_normal((12, 6)).astype(np.float32)
    bias = generator.standard_normal(6).astype(np.float32)
    found = ternary_linear(Linear(jnp.asarray(weight), jnp.asarray(bias)), jnp.asarray(x))
    steps, signs, both = rounded(x, weight)
    assert set(np.unique(signs)) == {-1, 0, 1}
    # Two divisions in the place of one.
    np.testing.assert_allclose(found, (steps @ signs) / both + bias, rtol=1e-6, atol=1e-6)


def test_halves_round_to_even() -> None:
    """Of a largest size of 127, steps are the numbers themselves."""
    x = jnp.asarray([[127.0, 0.5, 1.5, 2.5, -0.5, -1.5]])
    weight = jnp.diag(jnp.full(6, 6.0))  # of mean 1
    found = ternary_linear(Linear(weight, None), x)
    np.testing.assert_array_equal(found, [[127, 0, 2, 2, 0, -2]])
    # A weight is 0 up to half of the mean size, that included.
    weights = jnp.asarray([[0.5, 0.51, -0.5, 2.0, 1.49, 1.0]])
    assert float(jnp.abs(weights).mean()) == pytest.approx(1.0)
    found = ternary_linear(Linear(weights, None), jnp.asarray([[1.0]]))
    np.testing.assert_array_equal(jnp.sign(found), [[0, 1, 0, 1, 1, 1]])


def test_gradients_pass_through_the_roundings() -> None:
    """As of the linear layer of the rounded numbers, those of 0 too."""
    generator = np.random.default_rng(1)
    x, weight = (generator.standard_normal(s).astype(np.float32) for s in ((3, 8), (8, 4)))

    def loss(x, weight):
        return (ternary_linear(Linear(weight, None), x) ** 2).sum()

    of_x, of_weight = jax.grad(loss, (0, 1))(x, weight)
    steps, signs, _ = rounded(x, weight)
    plain_x = steps * np.abs(x).max(axis=1, keepdims=True) / 127
    plain_weight = signs * np.abs(weight).mean()
    change = 2 * plain_x @ plain_weight
    np.testing.assert_allclose(of_x, change @ plain_weight.T, rtol=1e-4)
    np.testing.assert_allclose(of_weight, plain_x.T @ change, rtol=1e-4, atol=1e-5)


def by_torch(params: TetraVit, images: np.ndarray) -> np.ndarray:
    params = jax.tree.map(lambda x: torch.from_numpy(np.array(x)), params)
    side = 2

    def norm(layer, x):
        return functional.layer_norm(x, x.shape[-1:], layer.weight, layer.bias)

    def ternary(layer, x):
        steps, signs, both = rounded(x.numpy(), layer.weight.numpy())
        y = torch.from_numpy((steps @ signs) / both).float()
        return y if layer.bias is None else y + layer.bias

    def plain(layer, x):
        return functional.linear(x, layer.weight.T, layer.bias)

    def run(layer, x, linear):
        parts = linear(layer.attn.qkv, norm(layer.norm1, x)).chunk(3, dim=-1)
        heads = [part.unflatten(-1, (2, 8)).transpose(1, 2) for part in parts]
        mixed = functional.scaled_dot_product_attention(*heads).transpose(1, 2).flatten(2)
        x = x + linear(layer.attn.proj, norm(layer.norm2, mixed))
        hidden = functional.gelu(linear(layer.fc1, norm(layer.norm3, x)))
        hidden = hidden if layer.norm4 is None else norm(layer.norm4, hidden)
        return x + linear(layer.fc2, hidden)

    # Pixels of a patch by rows, then columns, then channels.
    rows = torch.from_numpy(images).unfold(1, 14, 14).unfold(2, 14, 14)
    patches = rows.permute(0, 1, 2, 4, 5, 3).reshape(len(images), side**2, -1)
    tokens = norm(params.token_norm, plain(params.patch_embed, norm(params.patch_norm, patches)))
    first = params.cls_token.expand(len(images), 1, -1)
    x = torch.cat([first, tokens], dim=1) + params.pos_embed
    for i in range(SMALL.depth - 1):
        x = run(jax.tree.map(lambda leaf, i=i: leaf[i], params.blocks), x, ternary)
    return run(params.last, x, plain).numpy()


def test_the_backbone_is_torchs() -> None:
    generator = np.random.default_rng(2)
    # Norms that do something, and weights of which the roundings differ.
    params = jax.tree.map(
        lambda x: jnp.asarray(x + 0.3 * generator.standard_normal(x.shape), jnp.float32),
        SMALL.init(jax.random.key(0)),
    )
    images = generator.standard_normal((2, 28, 28, 3)).astype(np.float32)
    features, _ = SMALL.apply(params, jnp.asarray(images), FeatureSpec(), remat="dots", valid=None)
    found = np.concatenate([features.class_token[:, None], features.patches], axis=1)
    # Float32 through three blocks: rounding is the same wherever no number is within it of a half.
    np.testing.assert_allclose(found, by_torch(params, images), rtol=1e-4, atol=1e-4)


def test_another_size_is_refused() -> None:
    words = "^image size: found 28 x 42, expected 28 x 28, the only size that this backbone has"
    with pytest.raises(InputError, match=words):
        ModelConfig(image_size=(28, 42), backbone=SMALL, aggregator="gem", cross_image="none")
    for field, value in (("dim", 15), ("depth", 1)):
        with pytest.raises(InputError, match=f"{field}: found {value}, expected"):
            dataclasses.replace(SMALL, **{field: value})
