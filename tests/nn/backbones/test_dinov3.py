"""What DINOv3 adds to DINOv2's blocks; parity/test_dinov3.py has the whole beside transformers."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.checkpoints.formats import check_holds, infer, public_shapes, to_params
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.attention import rotate
from crisalad_jax.nn.backbones import Features, FeatureSpec
from crisalad_jax.nn.backbones.dinov3 import DinoV3Config
from crisalad_jax.nn.backbones.vit import ViT
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import OptimiserConfig
from crisalad_jax.training.losses import LossConfig
from crisalad_jax.training.losses.pairwise import MultiSimilarityConfig
from crisalad_jax.training.step import StepConfig, init_train_state, train_step
from crisalad_jax.training.trainable import merge_params
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import named_leaves
from tests.conftest import random_params

NO_ADAPTER = "none"
CONFIG = DinoV3Config(dim=32, depth=3, heads=2, registers=2, adapter=NO_ADAPTER)
BARE = "none"
MODEL = ModelConfig(
    image_size=(48, 64),
    backbone=CONFIG,
    aggregator=SaladConfig(clusters=3, cluster_dim=8, token_dim=16, hidden=16, dropout=0.0),
    cross_image=BARE,
)
PARAMS = random_params(MODEL)
GRID = (3, 4)


def images(seed: int = 0, count: int = 1) -> jax.Array:
    return jax.random.normal(jax.random.key(seed), (count, 48, 64, 3))


def heads(seed: int, tokens: int, dim: int = 16) -> jax.Array:
    return jax.random.normal(jax.random.key(seed), (2, tokens, 3, dim))


def test_tokens_in_front_are_not_rotated() -> None:
    x = heads(0, 15)
    turned = rotate(x, CONFIG.rotation(GRID))
    np.testing.assert_array_equal(turned[:, :3], x[:, :3])
    np.testing.assert_array_equal(turned[:, 3:], rotate(x[:, 3:], CONFIG.rotation(GRID)))


def test_half_precision_is_rounded_once() -> None:
    x = heads(0, 12).astype(jnp.bfloat16)
    once = rotate(x.astype(jnp.float32), CONFIG.rotation(GRID)).astype(jnp.bfloat16)
    assert rotate(x, CONFIG.rotation(GRID)).dtype == jnp.bfloat16
    np.testing.assert_array_equal(rotate(x, CONFIG.rotation(GRID)), once)


def with_key_bias(params: ViT, value: jax.Array) -> ViT:
    qkv = params.blocks.attn.qkv
    qkv = dataclasses.replace(qkv, bias=qkv.bias.at[:, 32:64].set(value))
    attn = dataclasses.replace(params.blocks.attn, qkv=qkv)
    return dataclasses.replace(params, blocks=dataclasses.replace(params.blocks, attn=attn))


def test_keys_have_no_bias() -> None:
    """Whatever the parameters hold, of features and of facets."""
    requests = FeatureSpec(), FeatureSpec((2,), "key")

    @jax.jit
    def features(value: Any) -> list[Features]:
        params = with_key_bias(PARAMS.backbone, value)
        return [CONFIG.apply(params, images(), request)[0] for request in requests]

    jax.tree.map(np.testing.assert_array_equal, features(0.0), features(5.0))


def test_inserted_tokens_have_no_place() -> None:
    """ImAge's tokens in another order come out in that order, and change nothing else."""
    tokens = jax.random.normal(jax.random.key(1), (4, 32))
    order = jnp.array([2, 0, 3, 1])
    first, second = (
        CONFIG.apply(PARAMS.backbone, images(), FeatureSpec(insertion=1, inserted=each))[0]
        for each in (tokens, tokens[order])
    )
    # The same sums in another order, through two blocks.
    np.testing.assert_allclose(first.inserted[:, order], second.inserted, atol=1e-5)
    np.testing.assert_allclose(first.patches, second.patches, atol=1e-5)
    assert np.abs(first.inserted - second.inserted).max() > 0.1


def test_sides_are_multiples_of_16() -> None:
    with pytest.raises(InputError, match=r"56 x 64, expected .* multiples of 16 .*48 x 64|64 x 64"):
        CONFIG.apply(PARAMS.backbone, jnp.zeros((1, 56, 64, 3)))
    with pytest.raises(InputError, match="heads: found 2, expected a divisor of a fourth of dim"):
        DinoV3Config(dim=12, depth=1, heads=2)


@pytest.mark.slow
def test_a_step_moves_the_last_block_and_no_bias_of_keys() -> None:
    """In a model with adapters beside its blocks."""
    backbone = dataclasses.replace(CONFIG, adapter="mlp")
    model = dataclasses.replace(MODEL, backbone=backbone, remat="full", compute_dtype="bfloat16")
    optimiser = OptimiserConfig(learning_rate=1e-3, weight_decay=0.0)
    step = StepConfig(model, LossConfig(kind=MultiSimilarityConfig(base=0.5)), optimiser, 10)
    before = random_params(model)
    state, frozen = init_train_state(before, "last-1-blocks,norm,head", step)
    pictures = np.random.default_rng(0).integers(0, 256, (4, 48, 64, 3), np.uint8)
    batch = pictures, jnp.array([0, 0, 1, 1]), np.ones(4, bool)
    state, metrics = train_step(state, frozen, *batch, jax.random.key(0), step)
    assert metrics.updated
    after = named_leaves(merge_params(state.trainable, frozen, model))
    moved = {name: np.asarray(after[name] - leaf) for name, leaf in named_leaves(before).items()}
    for name, change in moved.items():
        if name.startswith("backbone.blocks."):
            assert not change[:2].any(), name
            assert change[2].any(), name
        else:
            head = not name.startswith("backbone.") or name.startswith("backbone.norm.")
            assert bool(change.any()) == head, name
    assert not moved["backbone.blocks.attn.qkv.bias"][:, 32:64].any()


BACKBONE = ModelConfig(
    aggregator="class-token",
    backbone=DinoV3Config(dim=64, depth=2, heads=1, adapter=NO_ADAPTER),
    cross_image=BARE,
)


def published_state() -> dict[str, np.ndarray]:
    """A file of facebookresearch/dinov3's names, with biases of queries and of values."""
    rng = np.random.default_rng(0)
    state = {
        name: rng.standard_normal(shape).astype(np.float32)
        for name, shape in public_shapes(BACKBONE, "dinov3").items()
    }
    periods = 100 ** (np.arange(16) / 16)
    state["rope_embed.periods"] = periods.astype(jnp.bfloat16).astype(np.float32)
    for i in range(2):
        state[f"blocks.{i}.attn.qkv.bias_mask"] = np.repeat(np.float32([1, 0, 1]), 64)
    return state


def test_a_masked_bias_is_none() -> None:
    """The public code multiplies biases by the mask, whatever the file holds below it."""
    state = published_state()
    state["blocks.1.attn.qkv.bias_mask"][:] = 0
    params, _ = to_params(state, BACKBONE, "dinov3", source="file")
    found = params.backbone.blocks.attn.qkv.bias
    bias, mask = (state[f"blocks.0.attn.qkv.{name}"] for name in ("bias", "bias_mask"))
    np.testing.assert_array_equal(found, np.stack([bias * mask, np.zeros(192)]))


def test_other_periods_are_refused() -> None:
    state = published_state()
    state["rope_embed.periods"] *= 1.01
    with pytest.raises(
        InputError, match=r"^file: rope_embed.periods found \[1.0\d+, .*about \[1.0"
    ):
        infer(state, source="file")


def test_each_generation_keeps_to_its_layouts() -> None:
    for layout in ("dinov2", "huggingface"):
        with pytest.raises(InputError, match="found a model of backbone dinov3, expected vit"):
            check_holds(BACKBONE, layout)
    with pytest.raises(InputError, match="found a model of backbone vit, expected dinov3"):
        check_holds(dataclasses.replace(BACKBONE, backbone="vit"), "huggingface-dinov3")
    with pytest.raises(InputError, match="expected vit or resnet or vgg"):
        check_holds(BACKBONE, "reference")
