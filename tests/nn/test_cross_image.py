"""The cross-image encoder's start and dropout; parity/ compares it with torch's."""

import jax
import jax.numpy as jnp
import numpy as np

from crisalad_jax.nn.cross_image import (
    CrossImageConfig,
    cross_image_encoder,
    init_cross_image,
)

CONFIG = CrossImageConfig(layers=2, heads=4, feedforward=24, dropout=0.1)
IMAGES, TOKENS, DIM = 5, 3, 16


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
