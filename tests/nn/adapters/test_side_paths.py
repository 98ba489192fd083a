"""SelaVPR++'s side paths against torch's convolutions and batch norms, over our own blocks."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from torch.nn import functional

import crisalad_jax as cj
from crisalad_jax.nn.adapters import TokenInfo
from crisalad_jax.nn.adapters.bottleneck import SideMultiResolutionConfig
from crisalad_jax.nn.backbones.base import FeatureSpec
from crisalad_jax.nn.backbones.vit import ViTConfig, block, run_blocks

GRID, DEPTH, LAST = (2, 3), 3, 2
BARE = ViTConfig(dim=32, depth=DEPTH, heads=2, position_grid=3, adapter="none")
SIDES = dataclasses.replace(BARE, adapter=SideMultiResolutionConfig(last=LAST, paths=2))


def drawn(key: int) -> Any:
    """Parameters with variances above 0."""
    params, keys = SIDES.init(jax.random.key(key)), iter(jax.random.split(jax.random.key(1), 200))
    blocks = jax.tree_util.tree_map_with_path(
        lambda path, leaf: (
            0.3 * jax.random.normal(next(keys), leaf.shape)
            + jax.tree_util.keystr(path).endswith(("running_var", "norm.weight"))
        ),
        params.blocks.adapter,
    )
    blocks = jax.tree_util.tree_map_with_path(
        lambda path, leaf: abs(leaf) if "running_var" in jax.tree_util.keystr(path) else leaf,
        blocks,
    )
    return dataclasses.replace(params, blocks=dataclasses.replace(params.blocks, adapter=blocks))


def convolved(t: Any, z: torch.Tensor, *, trains: bool) -> torch.Tensor:
    """The adapter as the zoo's facts describe it; it updates the running statistics in place."""
    hidden = torch.relu(z @ t.down.weight + t.down.bias)
    maps = hidden[:, 1:].swapaxes(1, 2).reshape(len(z), -1, *GRID)
    outputs = []
    for branch in ((t.branch1,), t.branch2, t.branch3):
        y = maps
        for layer in branch:
            weight = layer.conv.weight.permute(3, 2, 0, 1)
            y = functional.conv2d(y, weight, layer.conv.bias, padding=weight.shape[-1] // 2)
            n = layer.norm
            statistics = n.running_mean, n.running_var, n.weight, n.bias
            y = torch.relu(functional.batch_norm(y, *statistics, training=trains, eps=1e-3))
        outputs.append(y)
    mixed = torch.cat(outputs, dim=1).reshape(len(z), -1, GRID[0] * GRID[1]).swapaxes(1, 2)
    passed = torch.cat([hidden[:, :1], mixed], dim=1)
    return (passed + hidden) @ t.up.weight + t.up.bias


@pytest.mark.parametrize("trains", [pytest.param(False, marks=pytest.mark.slow), True])
def test_two_paths_equal_torchs(trains: bool) -> None:
    params = drawn(0)
    bare = dataclasses.replace(params.blocks, adapter=None)
    tokens = jax.random.normal(jax.random.key(2), (2, 1 + 6, 32))
    trunk, sides = tokens, [tokens, tokens]
    measured = []
    for i in range(DEPTH):
        layer = jax.tree.map(lambda leaf, i=i: leaf[i], bare)
        if i == DEPTH - LAST:
            sides = [trunk, trunk]
        trunk, _ = block(layer, trunk, TokenInfo(GRID), BARE)
        if i < DEPTH - LAST:
            continue
        for number in range(2):
            own = jax.tree.map(lambda x: x[i - DEPTH + LAST], params.blocks.adapter[number])  # noqa: B023
            t: Any = jax.tree.map(lambda leaf: torch.tensor(np.asarray(leaf)), own)
            z = torch.tensor(np.asarray(trunk + sides[number]))
            sides[number] += convolved(t, z, trains=trains).numpy()
            measured.append(t.branch3[1].norm.running_var.numpy())
    valid = jnp.ones(2, bool) if trains else None
    walked = [
        run_blocks([params.blocks], tokens, GRID, SIDES, valid=valid, path=path) for path in (0, 1)
    ]
    found = [tokens for tokens, _ in walked]
    # Sums of up to 400 numbers of order 10, two blocks deep.
    for ours, theirs in zip(found, sides, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)
    assert np.abs(found[0] - found[1]).max() > 0.1
    assert np.abs(sides[0] - trunk).max() > 0.1
    for number, expected in enumerate(measured):
        which, layer = number % 2, number // 2
        own = walked[which][1][0].adapter[which].branch3[1].norm
        assert own.weight is None
        np.testing.assert_allclose(own.running_var[layer], expected, rtol=1e-4)


def test_a_path_is_what_it_is_alone() -> None:
    params = drawn(0)
    pixels = jax.random.normal(jax.random.key(3), (2, 28, 42, 3))
    one = dataclasses.replace(SIDES, adapter=dataclasses.replace(SIDES.adapter, paths=1))
    for path in (0, 1):
        features, _ = SIDES.apply(params, pixels, FeatureSpec(path=path))
        own = dataclasses.replace(params.blocks, adapter=params.blocks.adapter[path])
        alone, _ = one.apply(dataclasses.replace(params, blocks=own), pixels)
        np.testing.assert_allclose(alone.patches, features.patches, rtol=1e-5, atol=1e-5)
    with pytest.raises(cj.InputError, match=r"for aggregator selavprpp-hash, .* two side paths"):
        cj.ModelConfig(backbone=one, aggregator="selavprpp-hash", cross_image="none")
