"""The adapter against a torch computation from its description, and its parameter count."""

import dataclasses
import functools
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax.nn.adapter import (
    AdapterConfig,
    SerialParallelAdapter,
    adapter,
    init_adapter,
)
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.utils.pytree import named_leaves

GRID = (3, 5)


@pytest.mark.parametrize(
    ("special", "kernel_size", "bias"),
    [(1, 1, "convolutions"), (1, 3, "up"), (5, 3, "convolutions"), (5, 5, "up")],
)
def test_equals_torch(special: int, kernel_size: int, bias: Literal["convolutions", "up"]) -> None:
    chosen = AdapterConfig(kernel_size=kernel_size, bias=bias)
    config = ViTConfig(dim=16, heads=2, adapter=chosen)
    params = init_adapter(jax.random.key(0), config.dim, config.adapter)
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
    expected = (branch + hidden) @ t.up.weight + (0 if t.up.bias is None else t.up.bias)
    # Chains of at most 25 products of order 1, then 8 of order 10.
    np.testing.assert_allclose(adapter(params, tokens, GRID)[0], expected, atol=2e-5)


@pytest.mark.parametrize("bias", ["convolutions", "up"])
def test_the_papers_adapter_has_its_parameter_count(bias: Literal["convolutions", "up"]) -> None:
    """741.504 K in Table 3, in both readings."""
    make = functools.partial(init_adapter, dim=768, config=AdapterConfig(bias=bias))
    shapes = named_leaves(jax.eval_shape(make, jax.random.key(0)))
    assert sum(leaf.size for leaf in shapes.values()) == 741_504
    biases = {name.partition(".")[0] for name in shapes if name.endswith("bias")}
    assert biases == ({"depthwise", "pointwise"} if bias == "convolutions" else {"up"})


def test_cricavprs_adapter_has_its_parameter_count() -> None:
    """761.472 K in Table 3, which counts neither the batch norms nor the convolutions' biases."""
    config = AdapterConfig(kind="multi-resolution")
    make = functools.partial(init_adapter, dim=768, config=config)
    shapes = jax.eval_shape(make, jax.random.key(0))
    counted = [
        leaf.size
        for name, leaf in named_leaves(shapes).items()
        if ".norm." not in name and not name.endswith("conv.bias")
    ]
    assert sum(counted) == 761_472


@pytest.mark.parametrize(
    "kind", ["depthwise", "multi-resolution", "mlp", "side", "serial-parallel"]
)
def test_an_untrained_adapter_adds_nothing(kind: str) -> None:
    params = init_adapter(jax.random.key(0), 32, AdapterConfig(kind=kind))
    tokens = jax.random.normal(jax.random.key(2), (16, 32))
    parts = [params]
    if isinstance(params, SerialParallelAdapter):
        parts = [params.serial, params.parallel]
        assert (params.serial.down.weight != params.parallel.down.weight).any()
    for each in parts:
        np.testing.assert_array_equal(adapter(each, tokens, GRID)[0], jnp.zeros((16, 32)))


def test_cricavprs_convolutions_start_at_1e_5() -> None:
    """Weights and biases, as Lu-Feng/CricaVPR's train.py sets them; batch norms as torch's."""
    config = AdapterConfig(kind="multi-resolution")
    params = named_leaves(init_adapter(jax.random.key(0), 32, config))
    convolutions = [name for name in params if ".conv." in name]
    assert len(convolutions) == 10
    starts = dict.fromkeys(convolutions, np.float32(1e-5))
    starts |= {name: 0.0 for name in params if name.endswith(("norm.bias", "running_mean"))}
    starts |= {name: 1.0 for name in params if name.endswith(("norm.weight", "running_var"))}
    starts |= {"up.weight": 0.0, "up.bias": 0.0}
    assert params.keys() - starts.keys() == {"down.weight", "down.bias"}
    for name, value in starts.items():
        np.testing.assert_array_equal(params[name], value, err_msg=name)
