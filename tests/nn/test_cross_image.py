"""The cross-image encoder against torch.nn.TransformerEncoder with masks, and its dropout."""

import jax
import jax.numpy as jnp
import numpy as np
import torch

from crisalad_jax.nn.cross_image import (
    CrossImageConfig,
    CrossImageEncoder,
    cross_image_encoder,
    init_cross_image,
)
from tests.nn.conftest import copy_attention

CONFIG = CrossImageConfig(layers=2, heads=4, feedforward=24, dropout=0.1)
IMAGES, TOKENS, DIM = 5, 3, 16


def torch_encoder(params) -> torch.nn.TransformerEncoder:
    layer = torch.nn.TransformerEncoderLayer(
        DIM, 4, 24, dropout=0.0, activation="gelu", batch_first=False
    )
    encoder = torch.nn.TransformerEncoder(layer, 2, enable_nested_tensor=False).eval()
    for theirs, ours in zip(encoder.layers, params.layers, strict=True):
        copy_attention(theirs.self_attn, ours.attn)
        for name in ("linear1", "linear2"):
            layer = getattr(ours, name)
            state = {"weight": layer.weight.T, "bias": layer.bias}
            getattr(theirs, name).load_state_dict(
                {key: torch.tensor(np.asarray(x)) for key, x in state.items()}
            )
    return encoder


def test_equals_torch_with_and_without_mask() -> None:
    # Layers that differ, as they do after training.
    layers = (init_cross_image(jax.random.key(seed), DIM, CONFIG).layers[0] for seed in range(2))
    params = CrossImageEncoder(tuple(layers))
    theirs = torch_encoder(params)
    tokens = jax.random.normal(jax.random.key(1), (IMAGES, TOKENS, DIM))
    given = torch.tensor(np.asarray(tokens))
    mask = np.random.default_rng(0).random((IMAGES, IMAGES)) < 0.5
    np.fill_diagonal(mask, True)
    for seen, expected in (
        (None, theirs(given)),
        (jnp.asarray(mask), theirs(given, mask=torch.tensor(~mask))),
    ):
        ours = cross_image_encoder(params, tokens, CONFIG, mask=seen, key=None)
        # Two layers of normalised numbers of order 1: some tens of float32's last place.
        np.testing.assert_allclose(ours, expected.detach(), atol=5e-6)


def test_starts_as_torch_does() -> None:
    """Glorot-uniform attention with zero biases: the largest weight comes close to the bound."""
    params = init_cross_image(jax.random.key(0), 64, CONFIG)
    # `nn.TransformerEncoder` copies its layer.
    first, second = params.layers
    jax.tree.map(np.testing.assert_array_equal, first, second)
    pointers = [x.unsafe_buffer_pointer() for x in jax.tree.leaves(params)]
    assert len(set(pointers)) == len(pointers)
    attn = first.attn
    bound = np.sqrt(6 / (64 + 192))
    assert 0.99 * bound < float(jnp.abs(attn.qkv.weight).max()) <= bound
    assert not attn.qkv.bias.any()
    assert not attn.proj.bias.any()


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
