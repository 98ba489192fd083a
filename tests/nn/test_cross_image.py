"""Cross-image encoders; parity/ compares the paper's with torch's."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import crisalad_jax as cj
from crisalad_jax.nn.cross_image import CrossImageConfig, GatedCrossImageConfig
from tests.conftest import MODEL

CONFIG = CrossImageConfig(layers=2, heads=4, feedforward=24, dropout=0.1)
IMAGES, TOKENS, DIM = 5, 3, 16


def test_starts_as_torch_does() -> None:
    """Glorot-uniform attention with zero biases: the largest weight comes close to the bound."""
    params = CONFIG.init(jax.random.key(0), 64)
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
    params = CONFIG.init(jax.random.key(0), DIM)
    tokens = jax.random.normal(jax.random.key(1), (IMAGES, TOKENS, DIM))
    CONFIG.apply(params, tokens, mask=None, key=jax.random.key(2))
    layer = [
        ((TOKENS, 4, IMAGES, IMAGES), 0.1, True),
        ((IMAGES, TOKENS, DIM), 0.1, True),
        ((IMAGES, TOKENS, 24), 0.1, True),
        ((IMAGES, TOKENS, DIM), 0.1, True),
    ]
    assert calls == 2 * layer


RELATED = CrossImageConfig(heads=2, feedforward=16, dropout=0.0)
GATE = GatedCrossImageConfig(heads=2, feedforward=16, dropout=0.0)
GATED = dataclasses.replace(MODEL, cross_image=GATE)


def test_an_untrained_gate_leaves_descriptors_alone() -> None:
    """y = x + tanh(g) (f(x) - x): at g = 0 no encoder, at infinity the paper's."""
    params = cj.init_crisalad(jax.random.key(0), GATED)
    images = np.random.default_rng(0).integers(0, 256, (3, *MODEL.input_size, 3), dtype=np.uint8)
    tokens = cj.extract_tokens(params, images, GATED)
    bare = dataclasses.replace(MODEL, cross_image="none")
    alone = cj.attend_across_images(dataclasses.replace(params, cross_image=None), tokens, bare)
    np.testing.assert_array_equal(cj.attend_across_images(params, tokens, GATED), alone)

    def gated(gate: jax.Array) -> jax.Array:
        encoder = dataclasses.replace(params.cross_image, gate=gate)
        return cj.attend_across_images(
            dataclasses.replace(params, cross_image=encoder), tokens, GATED
        )

    paper = dataclasses.replace(params, cross_image=params.cross_image.encoder)
    config = dataclasses.replace(MODEL, cross_image=RELATED)
    # tanh(20) is 1 in float32; x + (f - x) rounds once more than f.
    found, expected = gated(jnp.float32(20)), cj.attend_across_images(paper, tokens, config)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    slope = jax.grad(lambda gate: (gated(gate) * alone[::-1]).sum())(jnp.float32(0))
    step = 2.0**-8
    ends = [(gated(jnp.float32(x)) * alone[::-1]).sum() for x in (-step, step)]
    # The error falls with the square of the step, from 3e-3 at 2^-6; float32 over 2^-7 adds 1e-5.
    assert abs(slope) > 0.01
    np.testing.assert_allclose(slope, (ends[1] - ends[0]) / (2 * step), atol=1e-3)


def test_an_encoder_of_ones_own(own_parts: None) -> None:
    """The mean of those in sight, without parameters; what it returns is checked."""

    @cj.register_cross_image("mean-of-all")
    @dataclasses.dataclass(frozen=True)
    class MeanOfAll(cj.CrossImage):
        """The mean of the images in sight."""

        extra: int = 0

        def init(self, key: Any, dim: int) -> None:
            return None

        def apply(self, params: Any, tokens: Any, *, mask: Any, key: Any) -> Any:
            weights = mask / mask.sum(axis=1, keepdims=True)
            return jnp.einsum("ij,jtd->itd", weights, tokens)[..., self.extra :]

    config = dataclasses.replace(MODEL, cross_image="mean-of-all")
    params = cj.init_crisalad(jax.random.key(0), config)
    assert params.cross_image is None
    rng = np.random.default_rng(0)
    shape = MODEL.token_shape
    tokens = cj.Tokens(
        *(
            jnp.asarray(rng.normal(size=(3, *s)), jnp.float32)
            for s in ((shape.global_dim,), (shape.tokens, shape.token_dim))
        )
    )
    # The last image may attend to none, and therefore attends to itself.
    mask = np.array([[1, 1, 0], [0, 1, 0], [0, 0, 0]], bool)
    weights = np.array([[0.5, 0.5, 0], [0, 1, 0], [0, 0, 1]])
    flat = weights @ np.concatenate(
        [tokens.global_token, np.asarray(tokens.local).swapaxes(1, 2).reshape(3, -1)], axis=1
    )
    expected = flat / np.linalg.norm(flat, axis=1, keepdims=True)
    found = cj.attend_across_images(params, tokens, config, mask=mask)
    np.testing.assert_allclose(found, expected, atol=1e-6)  # unit vectors in float32
    wrong = dataclasses.replace(config, cross_image=MeanOfAll(extra=1))
    with pytest.raises(
        cj.InputError, match=r"^cross_image mean-of-all: found to return float32\[3,"
    ):
        cj.attend_across_images(params, tokens, wrong, mask=mask)


def test_recipes_take_an_encoder() -> None:
    found = cj.recipe("tiny", "scratch+gated").model.cross_image
    assert found == GatedCrossImageConfig(heads=4, feedforward=128, dropout=0.0)
    assert cj.recipe("b14", "salad+transformer").model.cross_image == CrossImageConfig()
