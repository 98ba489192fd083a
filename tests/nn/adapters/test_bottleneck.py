"""Bottleneck adapters against torch computations of their descriptions, and parameter counts."""

import dataclasses
import functools
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax.nn.adapters import ADAPTERS, TokenInfo
from crisalad_jax.nn.adapters.bottleneck import DepthwiseConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.utils.pytree import named_leaves

GRID = (3, 5)
SMALL, BASE = ViTConfig(dim=32, heads=2).block_shape, ViTConfig().block_shape


@pytest.mark.parametrize(
    ("special", "kernel_size", "bias"),
    [(1, 1, "convolutions"), (1, 3, "up"), (5, 3, "convolutions"), (5, 5, "up")],
)
def test_equals_torch(special: int, kernel_size: int, bias: Literal["convolutions", "up"]) -> None:
    config = DepthwiseConfig(kernel_size=kernel_size, bias=bias, alpha=0.5)
    params = config.init(jax.random.key(0), ViTConfig(dim=16, heads=2).block_shape)
    up = jax.tree.map(lambda x: jax.random.normal(jax.random.key(1), x.shape), params.up)
    params = dataclasses.replace(params, up=up)
    tokens = jax.random.normal(jax.random.key(2), (special + 15, 16))

    t = jax.tree.map(lambda leaf: torch.tensor(np.asarray(leaf)), params)
    hidden = torch.relu(torch.tensor(np.asarray(tokens)) @ t.down.weight)
    maps = hidden[special:].T.reshape(1, 8, *GRID)
    maps = torch.nn.functional.conv2d(
        maps,
        t.depthwise.weight.permute(2, 0, 1)[:, None],
        t.depthwise.bias,
        padding=kernel_size // 2,
        groups=8,
    )
    maps = torch.nn.functional.conv2d(maps, t.pointwise.weight.T[..., None, None], t.pointwise.bias)
    branch = torch.cat([hidden[:special], torch.relu(maps)[0].reshape(8, -1).T])
    bias = 0 if t.up.bias is None else t.up.bias
    expected = 0.5 * ((branch + hidden) @ t.up.weight + bias)
    # Chains of at most 25 products of order 1, then 8 of order 10.
    np.testing.assert_allclose(
        config.mlp_update(params, tokens, TokenInfo(GRID))[0], expected, atol=2e-5
    )


@pytest.mark.parametrize("bias", ["convolutions", "up"])
def test_the_papers_adapter_has_its_parameter_count(bias: Literal["convolutions", "up"]) -> None:
    """741.504 K in Table 3, in both readings."""
    make = functools.partial(DepthwiseConfig(bias=bias).init, shape=BASE)
    shapes = named_leaves(jax.eval_shape(make, jax.random.key(0)))
    assert sum(leaf.size for leaf in shapes.values()) == 741_504
    biases = {name.partition(".")[0] for name in shapes if name.endswith("bias")}
    assert biases == ({"depthwise", "pointwise"} if bias == "convolutions" else {"up"})


def test_cricavprs_adapter_has_its_parameter_count() -> None:
    """761.472 K in Table 3, which counts neither the batch norms nor the convolutions' biases."""
    make = functools.partial(ADAPTERS.make("multi-resolution").init, shape=BASE)
    shapes = jax.eval_shape(make, jax.random.key(0))
    counted = [
        leaf.size
        for name, leaf in named_leaves(shapes).items()
        if ".norm." not in name and not name.endswith("conv.bias")
    ]
    assert sum(counted) == 761_472


@pytest.mark.parametrize("name", ["depthwise", "multi-resolution", "mlp", "serial-parallel"])
def test_an_untrained_adapter_adds_nothing(name: str) -> None:
    config = ADAPTERS.make(name)
    params = config.init(jax.random.key(0), SMALL)
    tokens = jax.random.normal(jax.random.key(2), (16, 32))
    np.testing.assert_array_equal(
        config.mlp_update(params, tokens, TokenInfo(GRID))[0], jnp.zeros((16, 32))
    )
    if name == "serial-parallel":
        assert (params.serial.down.weight != params.parallel.down.weight).any()
        serial = config.attention_update(params, tokens, TokenInfo(GRID))
        np.testing.assert_array_equal(serial, jnp.zeros((16, 32)))


def test_cricavprs_convolutions_start_at_1e_5() -> None:
    """Weights and biases, as Lu-Feng/CricaVPR's train.py sets them; batch norms as torch's."""
    params = named_leaves(ADAPTERS.make("multi-resolution").init(jax.random.key(0), SMALL))
    convolutions = [name for name in params if ".conv." in name]
    assert len(convolutions) == 10
    starts = dict.fromkeys(convolutions, np.float32(1e-5))
    starts |= {name: 0.0 for name in params if name.endswith(("norm.bias", "running_mean"))}
    starts |= {name: 1.0 for name in params if name.endswith(("norm.weight", "running_var"))}
    starts |= {"up.weight": 0.0, "up.bias": 0.0}
    assert params.keys() - starts.keys() == {"down.weight", "down.bias"}
    for name, value in starts.items():
        np.testing.assert_array_equal(params[name], value, err_msg=name)
