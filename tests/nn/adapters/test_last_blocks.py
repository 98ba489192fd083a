"""Adapters of the last blocks alone, against adapters of all blocks of which the first add 0."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

import crisalad_jax as cj
from crisalad_jax.nn.adapters import TokenInfo
from crisalad_jax.nn.adapters.bottleneck import SideConfig
from crisalad_jax.nn.adapters.dynamic_power import DynamicPowerConfig
from crisalad_jax.nn.adapters.lora import LoraConfig
from crisalad_jax.nn.backbones.base import FeatureSpec
from crisalad_jax.nn.backbones.vit import ViTConfig, embed, run_blocks
from crisalad_jax.nn.layers import TwoLayer
from crisalad_jax.training.trainable import count_trainable, merge_params, split_params
from tests.nn.adapters.test_lora import random_like

DEPTH, LAST = 5, 2
GRID = (2, 3)


def late(adapter: Any) -> Any:
    """The same adapter, in the last two blocks."""
    kind = dataclasses.make_dataclass(
        f"Late{type(adapter).__name__}",
        [("last", int, LAST)],
        bases=(type(adapter),),
        frozen=True,
    )
    kind.part_name = f"late-{adapter.part_name}"
    return kind(
        **{field.name: getattr(adapter, field.name) for field in dataclasses.fields(adapter)}
    )


def backbone(adapter: Any) -> ViTConfig:
    return ViTConfig(dim=16, depth=DEPTH, heads=2, position_grid=3, adapter=adapter)


def pair(adapter: Any, silent: str) -> tuple[Any, Any, ViTConfig, ViTConfig]:
    """Parameters with adapters in all blocks, whose first ones add 0, and in the last alone."""
    whole, few = backbone(adapter), backbone(late(adapter))
    params = random_like(whole.init(jax.random.key(0)), 1)

    def quiet(path: Any, leaf: jax.Array) -> jax.Array:
        return leaf.at[: DEPTH - LAST].set(0) if silent in jax.tree_util.keystr(path) else leaf

    adapters = jax.tree_util.tree_map_with_path(quiet, params.blocks.adapter)
    last = jax.tree.map(lambda leaf: leaf[-LAST:], adapters)
    full, partial = (
        dataclasses.replace(params, blocks=dataclasses.replace(params.blocks, adapter=each))
        for each in (adapters, last)
    )
    shapes = jax.tree.map(jnp.shape, few.init(jax.random.key(0)))
    assert shapes == jax.tree.map(jnp.shape, partial)
    return full, partial, whole, few


def pixels() -> jax.Array:
    return jax.random.normal(jax.random.key(3), (2, 28, 42, 3))


@pytest.mark.parametrize(
    "request_",
    [
        pytest.param(FeatureSpec(class_token=True), id="whole", marks=pytest.mark.slow),
        pytest.param(FeatureSpec(levels=(2, 4, 5)), id="levels", marks=pytest.mark.slow),
        pytest.param(FeatureSpec(levels=(2,)), id="before them"),
    ],
)
def test_features_and_gradients_are_those_of_adapters_that_add_0(request_) -> None:
    full, partial, whole, few = pair(cj.make_part("adapter", "depthwise"), ".up")

    def total(params: Any, config: ViTConfig) -> Any:
        features, _ = config.apply(params, pixels(), request_)
        return jnp.sin(features.patches).sum(), features.patches

    (_, expected), gradient = jax.value_and_grad(total, has_aux=True)(full, whole)
    (_, found), own = jax.value_and_grad(total, has_aux=True)(partial, few)
    # The same sums in the same order: only the fusion of operations may differ.
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
    wanted = dataclasses.replace(
        gradient.blocks, adapter=jax.tree.map(lambda x: x[-LAST:], gradient.blocks.adapter)
    )
    for ours, theirs in zip(*map(jax.tree.leaves, (own.blocks, wanted)), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-4 * abs(theirs).max())


def test_lora_of_the_last_blocks_is_merged_into_them() -> None:
    _, partial, _, few = pair(LoraConfig(rank=2), "up")
    plain, merged = few.merge_adapters(partial)
    assert plain.adapter.part_name == "none"
    expected = few.apply(partial, pixels())[0].patches
    # Weights and updates are added before the product, not after: float32's rounding.
    np.testing.assert_allclose(plain.apply(merged, pixels())[0].patches, expected, atol=2e-5)


def test_a_side_path_starts_at_the_first_block_that_has_one() -> None:
    _, partial, _, few = pair(SideConfig(), "up")
    features, _ = few.apply(partial, pixels(), FeatureSpec(norm=False))
    bare = backbone("none")
    stack = dataclasses.replace(partial.blocks, adapter=None)
    first, second = (
        jax.tree.map(lambda leaf, part=part: leaf[part], stack)
        for part in (slice(DEPTH - LAST), slice(DEPTH - LAST, None))
    )
    tokens, _ = run_blocks([first], embed(partial, pixels(), bare), GRID, bare)
    rest = dataclasses.replace(second, adapter=partial.blocks.adapter)
    # From here it is a whole path, beside all of the blocks that are left.
    expected, _ = run_blocks([rest], tokens, GRID, backbone(SideConfig()))
    np.testing.assert_allclose(features.patches, expected[:, 1:], rtol=1e-5, atol=1e-5)


def model(adapter: Any) -> cj.ModelConfig:
    return cj.ModelConfig(
        image_size=(28, 42), backbone=backbone(adapter), aggregator="gem", cross_image="none"
    )


@pytest.mark.parametrize(
    "trainable",
    [
        "adapters,head",
        pytest.param("last-3-blocks,norm,adapters,head", marks=pytest.mark.slow),
        pytest.param("all", marks=pytest.mark.slow),
    ],
)
def test_they_train_and_are_joined_again(trainable) -> None:
    config = model(DynamicPowerConfig(last=LAST, hidden=4))
    params = cj.init_crisalad(jax.random.key(0), config)
    parts = split_params(params, config, trainable)
    joined = merge_params(*parts, config)
    assert jax.tree.structure(joined) == jax.tree.structure(params)
    for ours, theirs in zip(*map(jax.tree.leaves, (joined, params)), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    own = LAST * (16 * 4 + 4 + 4 + 1)
    if trainable == "adapters,head":
        assert count_trainable(config, trainable) == own + 1  # and GeM's exponent

    def total(trained: Any, frozen: Any) -> jax.Array:
        params = jax.tree.map(
            lambda a, b: b if a is None else a, trained, frozen, is_leaf=lambda x: x is None
        )
        return jnp.sin(config.backbone.apply(params.backbone, pixels())[0].patches).sum()

    gradient = jax.grad(total)(*parts)
    whole = jax.grad(lambda p: total(p, p))(params)
    found = [g for g in jax.tree.leaves(gradient.backbone) if g.size]
    assert len(found) >= 4
    joined = jax.tree.leaves(merge_params(gradient, jax.tree.map(jnp.zeros_like, parts[1]), config))
    for ours, theirs in zip(joined, jax.tree.leaves(whole), strict=True):
        if jnp.any(ours):
            rows = jnp.any(ours.reshape(len(ours), -1), axis=1) if ours.ndim else slice(None)
            np.testing.assert_allclose(ours[rows], theirs[rows], rtol=1e-3, atol=1e-4)


def test_dynamic_power_equals_torchs() -> None:
    config = DynamicPowerConfig(hidden=4)
    x = jax.random.normal(jax.random.key(0), (3, 7, 16)).at[0, 0, 0].set(0)
    params: TwoLayer = random_like(config.init(jax.random.key(1), backbone("none").block_shape), 2)
    t: Any = jax.tree.map(lambda leaf: torch.from_numpy(np.asarray(leaf)), params)
    tokens = torch.from_numpy(np.asarray(x))
    hidden = torch.relu(tokens[:, :6].mean(1, keepdim=True) @ t.fc1.weight + t.fc1.bias)
    p = torch.sigmoid(hidden @ t.fc2.weight + t.fc2.bias)
    expected = tokens.sign() * (tokens.abs() + 1e-6).pow(p)
    # The seventh token is padding, which no mean has. Ten roundings of numbers up to 3.
    found = config.output_update(params, x, TokenInfo((2, 2), length=6))
    np.testing.assert_allclose(found, expected.numpy(), rtol=2e-6, atol=2e-6)
    assert found[0, 0, 0] == 0
    assert float(p.std()) > 0.2 or len(np.unique(p.numpy())) == 3  # an exponent an image


def test_prompts_are_of_all_blocks() -> None:
    with pytest.raises(cj.InputError, match=r"adapter: found .*, expected one in all blocks"):
        backbone(late(cj.make_part("adapter", "prompts")))
