"""Cross-image encoders; parity/ compares the paper's with torch's."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

import crisalad_jax as cj
from crisalad_jax.nn.cross_image import (
    CrossImageConfig,
    GatedCrossImageConfig,
    SageCrossImageConfig,
)
from crisalad_jax.nn.model import describe_training_batch
from tests.conftest import MODEL, random_params

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
    opened = dataclasses.replace(params.cross_image, gate=jnp.float32(0.5))
    assert GATED.cross_image.numbers(opened) == {"gate": jnp.tanh(jnp.float32(0.5))}
    slope = jax.grad(lambda gate: (gated(gate) * alone[::-1]).sum())(jnp.float32(0))
    step = 2.0**-8
    ends = [(gated(jnp.float32(x)) * alone[::-1]).sum() for x in (-step, step)]
    # The error falls with the square of the step, from 3e-3 at 2^-6; float32 over 2^-7 adds 1e-5.
    assert abs(slope) > 0.01
    np.testing.assert_allclose(slope, (ends[1] - ends[0]) / (2 * step), atol=1e-3)


NAMES = {
    "attn.qkv.weight": "self_attn.in_proj_weight",
    "attn.qkv.bias": "self_attn.in_proj_bias",
    "attn.proj.weight": "self_attn.out_proj.weight",
    "attn.proj.bias": "self_attn.out_proj.bias",
}
"""By our name, torch's; all others are the same."""


def to_torch(layer: Any) -> dict[str, torch.Tensor]:
    """A layer's arrays by torch's names; its linear layers' weights are transposed."""
    leaves = cj.named_leaves(layer).items()
    return {NAMES.get(name, name): torch.tensor(np.asarray(leaf).T) for name, leaf in leaves}


SAGE = dataclasses.replace(
    MODEL, cross_image=SageCrossImageConfig(heads=2, feedforward=16, width=12, dropout=0.0)
)


def test_sages_encoder_is_torchs_over_pieces_of_descriptors() -> None:
    """Of 48 numbers four pieces of 12, across the images; torch's attends along the first axis."""
    params = random_params(SAGE)
    images = np.random.default_rng(0).integers(0, 256, (3, *MODEL.input_size, 3), dtype=np.uint8)
    tokens = cj.extract_tokens(params, images, SAGE)
    bare = dataclasses.replace(MODEL, cross_image="none")
    alone = cj.attend_across_images(dataclasses.replace(params, cross_image=None), tokens, bare)
    layer = torch.nn.TransformerEncoderLayer(12, 2, 16, dropout=0.0, activation="gelu")
    theirs = torch.nn.TransformerEncoder(layer, 2, enable_nested_tensor=False)
    for ours, one in zip(params.cross_image.layers, theirs.layers, strict=True):
        one.load_state_dict(to_torch(ours))
    entered = torch.tensor(np.asarray(alone).reshape(3, 4, 12), requires_grad=True)
    expected = theirs(entered).reshape(3, 48)

    def attend(encoder: Any, tokens: cj.Tokens) -> jax.Array:
        own = dataclasses.replace(params, cross_image=encoder)
        return cj.attend_across_images(own, tokens, SAGE)

    # Two layers in float32, of numbers of order 1.
    found = attend(params.cross_image, tokens)
    np.testing.assert_allclose(found, expected.detach(), atol=1e-5)
    lengths = np.linalg.norm(found, axis=1)
    assert not SAGE.unit_length
    assert (lengths > 2).all()  # of sqrt(48) but for the last norm's scale
    target = np.random.default_rng(1).standard_normal((3, 48)).astype(np.float32)
    (expected * torch.tensor(target)).sum().backward()
    gradient = jax.grad(lambda encoder: (attend(encoder, tokens) * target).sum())(
        params.cross_image
    )
    for ours, one in zip(gradient.layers, theirs.layers, strict=True):
        by_name = to_torch(ours)
        for name, parameter in one.named_parameters():
            assert parameter.grad is not None
            np.testing.assert_allclose(by_name[name], parameter.grad, atol=3e-5, err_msg=name)
    # In no sight of each other: each as a batch of its own.
    single = cj.attend_across_images(params, tokens, SAGE, mask=cj.self_mask(3))
    each = [theirs(entered[i : i + 1]).reshape(48).detach() for i in range(3)]
    np.testing.assert_allclose(single, torch.stack(each), atol=1e-5)
    weights = cj.cross_image_attention(params, images, SAGE)
    assert weights.shape == (2, 4, 2, 3, 3)
    np.testing.assert_allclose(weights.sum(axis=-1), 1, atol=1e-6)  # a softmax in float32


def test_a_loss_takes_unit_vectors_whatever_the_encoder_leaves() -> None:
    params = random_params(SAGE)
    images = np.random.default_rng(0).integers(0, 256, (2, *MODEL.input_size, 3), dtype=np.uint8)
    fixed = dataclasses.replace(SAGE, aggregator=dataclasses.replace(SAGE.aggregator, dropout=0.0))
    options: Any = {"valid": jnp.ones(2, bool), "measured": None, "key": jax.random.key(0)}
    found, _, _ = describe_training_batch(params, jnp.asarray(images), fixed, **options)
    plain = np.asarray(cj.describe(params, images, fixed))
    expected = plain / np.linalg.norm(plain, axis=1, keepdims=True)
    np.testing.assert_allclose(found, expected, atol=1e-5)  # of two programs


def test_the_width_of_pieces_divides_the_descriptor() -> None:
    with pytest.raises(
        cj.InputError, match=r"^SageCrossImageConfig.width: found 13, expected a div"
    ):
        dataclasses.replace(SAGE, cross_image=SageCrossImageConfig(width=13))
    with pytest.raises(
        cj.InputError, match=r"heads: found 16, expected a divisor of the 12 dimensions"
    ):
        dataclasses.replace(SAGE, cross_image=SageCrossImageConfig(width=12))
    published = cj.ModelConfig(cross_image="sage-encoder")
    assert (published.descriptor_dim, published.sequence_dim) == (8448, 768)
    tiny = cj.recipe("tiny", "scratch+sage-encoder").model
    assert tiny.descriptor_dim == 576
    assert not tiny.unit_length
    assert dataclasses.replace(tiny, projection=cj.ProjectionConfig(dim=8)).unit_length


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
