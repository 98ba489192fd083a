"""The cross-image encoder against torch.nn.TransformerEncoder with masks, and its dropout."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax.nn.cross_image import (
    CrossImageConfig,
    CrossImageEncoder,
    cross_image_encoder,
    init_cross_image,
)

CONFIG = CrossImageConfig(layers=2, heads=4, feedforward=24, dropout=0.1)
IMAGES, TOKENS, DIM = 5, 3, 16


def torch_encoder(params) -> torch.nn.TransformerEncoder:
    layer = torch.nn.TransformerEncoderLayer(
        DIM, 4, 24, dropout=0.0, activation="gelu", batch_first=False
    )
    encoder = torch.nn.TransformerEncoder(layer, 2, enable_nested_tensor=False).eval()
    with torch.no_grad():
        for theirs, ours in zip(encoder.layers, params.layers, strict=True):
            pairs = [
                (theirs.self_attn.in_proj_weight, ours.attn.qkv.weight.T),
                (theirs.self_attn.in_proj_bias, ours.attn.qkv.bias),
                (theirs.self_attn.out_proj.weight, ours.attn.proj.weight.T),
                (theirs.self_attn.out_proj.bias, ours.attn.proj.bias),
                (theirs.linear1.weight, ours.linear1.weight.T),
                (theirs.linear1.bias, ours.linear1.bias),
                (theirs.linear2.weight, ours.linear2.weight.T),
                (theirs.linear2.bias, ours.linear2.bias),
            ]
            for target, source in pairs:
                target.copy_(torch.tensor(np.asarray(source)))
    return encoder


@pytest.mark.parametrize("masked", [False, True])
def test_equals_torch(masked: bool) -> None:
    # Layers that differ, as they do after training.
    layers = (init_cross_image(jax.random.key(seed), DIM, CONFIG).layers[0] for seed in range(2))
    params = CrossImageEncoder(tuple(layers))
    tokens = jax.random.normal(jax.random.key(1), (IMAGES, TOKENS, DIM))
    mask = None
    if masked:
        mask = np.random.default_rng(0).random((IMAGES, IMAGES)) < 0.5
        np.fill_diagonal(mask, True)
    forbidden = None if mask is None else torch.tensor(~mask)
    expected = torch_encoder(params)(torch.tensor(np.asarray(tokens)), mask=forbidden)
    ours = cross_image_encoder(
        params, tokens, CONFIG, mask=None if mask is None else jnp.asarray(mask), key=None
    )
    # Two layers of normalised numbers of order 1: some tens of float32's last place.
    np.testing.assert_allclose(ours, expected.detach().numpy(), atol=5e-6)


def test_starts_as_torch_does() -> None:
    """Glorot-uniform attention with zero biases: the largest weight comes close to the bound."""
    params = init_cross_image(jax.random.key(0), 64, CONFIG)
    # `nn.TransformerEncoder` copies its layer.
    first, second = params.layers
    theirs = torch.nn.TransformerEncoder(torch.nn.TransformerEncoderLayer(64, 4), 2).layers
    pairs = zip(theirs[0].parameters(), theirs[1].parameters(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)
    jax.tree.map(np.testing.assert_array_equal, first, second)
    pointers = [x.unsafe_buffer_pointer() for x in jax.tree.leaves(params)]
    assert len(set(pointers)) == len(pointers)
    attn = first.attn
    bound = np.sqrt(6 / (64 + 192))
    assert 0.99 * bound < float(jnp.abs(attn.qkv.weight).max()) <= bound
    assert not attn.qkv.bias.any()
    assert not attn.proj.bias.any()


def test_dropout_is_on_with_a_key_only() -> None:
    params = init_cross_image(jax.random.key(0), DIM, CONFIG)
    tokens = jax.random.normal(jax.random.key(1), (IMAGES, TOKENS, DIM))
    plain = cross_image_encoder(params, tokens, CONFIG, key=None)
    dropped = cross_image_encoder(params, tokens, CONFIG, key=jax.random.key(2))
    assert not np.allclose(plain, dropped, atol=1e-3)


def test_dropout_stands_where_torch_has_it(monkeypatch) -> None:
    """In each layer on attention weights, after attention, after GELU, and after linear2."""
    import crisalad_jax.nn.cross_image as module
    import crisalad_jax.nn.torch_layers as layers

    calls = []

    def record(x, rate, *, key):
        calls.append((x.shape, rate, key is not None))
        return x

    monkeypatch.setattr(module, "dropout", record)
    monkeypatch.setattr(layers, "dropout", record)
    params = init_cross_image(jax.random.key(0), DIM, CONFIG)
    tokens = jax.random.normal(jax.random.key(1), (IMAGES, TOKENS, DIM))
    cross_image_encoder(params, tokens, CONFIG, key=jax.random.key(2))
    layer = [
        ((TOKENS, 4, IMAGES, IMAGES), 0.1, True),
        ((IMAGES, TOKENS, DIM), 0.1, True),
        ((IMAGES, TOKENS, 24), 0.1, True),
        ((IMAGES, TOKENS, DIM), 0.1, True),
    ]
    assert calls == 2 * layer
