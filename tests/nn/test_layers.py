"""Small layers against torch's own, in float32.

Bounds of 1e-6 relative to outputs of order 1 are a few units of float32's last place.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax.nn.layers import (
    BatchNorm,
    Conv,
    DepthwiseConv,
    LayerNorm,
    Linear,
    conv,
    depthwise_conv,
    dropout,
    gelu,
    init_batch_norm,
    init_conv,
    init_depthwise_conv,
    init_linear,
    l2_normalise,
    layer_norm,
    linear,
    train_batch_norm,
)
from crisalad_jax.utils.target import GPU, TPU, Target, lowering_for


def normal(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


STRIDED = [(3, 1, 1), (4, 4, 0), (7, 2, 3), (2, 3, 0)]
"""Kernel size, stride and padding; the windows of the last leave a row and a column out."""


def slopes_in_bfloat16(
    apply: Callable[[jax.Array, jax.Array], jax.Array], weight: np.ndarray, x: np.ndarray
) -> tuple[jax.Array, jax.Array]:
    """The gradient by a float32 weight and by bfloat16 inputs."""

    def value(weight: jax.Array, x: jax.Array) -> jax.Array:
        y = apply(weight, x)
        towards = normal(3, *y.shape).round(1)
        return (y.astype(jnp.float32) * towards).sum()

    return jax.grad(value, argnums=(0, 1))(jnp.asarray(weight), jnp.asarray(x, jnp.bfloat16))


def exact_slope(apply: Callable[..., torch.Tensor], weight: np.ndarray, x: np.ndarray) -> Any:
    """Torch's gradient by the weight, in float64, of inputs and cotangents of 8 bits."""
    rounded = np.asarray(jnp.asarray(x, jnp.bfloat16), np.float64)
    weight = torch.tensor(weight, dtype=torch.float64, requires_grad=True)
    y = apply(torch.tensor(rounded), weight)
    towards = normal(3, *y.shape).round(1)
    y.backward(torch.tensor(np.asarray(jnp.asarray(towards, jnp.bfloat16), np.float64)))
    return weight.grad


@pytest.mark.parametrize("chosen", [GPU, TPU], ids=lambda chosen: chosen.platform)
def test_accelerators_sum_the_gradient_of_a_weight_in_float32(chosen: Target) -> None:
    """A sum of 4,096 products of 8-bit numbers is exact but for float32's own rounding."""
    x, weight = normal(0, 4096, 7), normal(1, 7, 3)

    def apply(weight: jax.Array, x: jax.Array) -> jax.Array:
        return linear(Linear(weight, None), x)

    with lowering_for(chosen):
        found, to_x = slopes_in_bfloat16(apply, weight, x)
    assert found.dtype == jnp.float32
    assert to_x.dtype == jnp.bfloat16
    expected = exact_slope(lambda x, weight: x @ weight, weight, x)
    # 4,096 terms of order 1; rounded to bfloat16 it would be off by up to 0.25.
    np.testing.assert_allclose(found, expected, atol=1e-3)


@pytest.mark.parametrize(("size", "stride", "padding"), STRIDED)
def test_accelerators_sum_the_gradient_of_a_kernel_in_float32(
    size: int, stride: int, padding: int
) -> None:
    x, weight = normal(0, 3, 12, 9, 4), normal(1, size, size, 4, 5)

    def apply(weight: jax.Array, x: jax.Array) -> jax.Array:
        return conv(Conv(weight, None), x, stride=stride, padding=padding)

    def theirs(x: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        x, weight = x.permute(0, 3, 1, 2), weight.permute(3, 2, 0, 1)
        y = torch.nn.functional.conv2d(x, weight, stride=stride, padding=padding)
        return y.permute(0, 2, 3, 1)

    expected, to_x = slopes_in_bfloat16(apply, weight, x)
    with lowering_for(GPU):
        found, ours = slopes_in_bfloat16(apply, weight, x)
    assert found.dtype == jnp.float32
    np.testing.assert_array_equal(ours.astype(jnp.float32), to_x.astype(jnp.float32))
    # Some 300 terms of order 1. The CPU's are rounded to 8 bits, of numbers up to 60.
    np.testing.assert_allclose(found, exact_slope(theirs, weight, x), atol=1e-4)
    np.testing.assert_allclose(found, expected, atol=0.25)


def test_the_sum_over_devices_is_of_float32() -> None:
    """The product of the weight's gradient has float32 outputs, over which devices sum."""

    def value(weight: jax.Array, x: jax.Array) -> jax.Array:
        return linear(Linear(weight, None), x).astype(jnp.float32).sum()

    shapes = jax.ShapeDtypeStruct((7, 3), "float32"), jax.ShapeDtypeStruct((5, 7), "bfloat16")
    for chosen in (GPU, TPU):
        with lowering_for(chosen):
            program = str(jax.make_jaxpr(jax.grad(value))(*shapes))
        assert ":f32[7,3] = dot_general" in program


@pytest.mark.parametrize("kind", ["linear", "conv", "depthwise"])
def test_bias_gradients_of_bfloat16_are_summed_in_float32(kind: str) -> None:
    x = jnp.asarray(normal(0, 8, 16, 16, 4)).astype(jnp.bfloat16)
    towards = jnp.asarray(np.random.default_rng(1).uniform(1, 2, x.shape)).astype(jnp.bfloat16)

    def apply(bias: jax.Array, image: jax.Array) -> jax.Array:
        if kind == "linear":
            return linear(Linear(jnp.eye(4), bias), image)
        if kind == "conv":
            return conv(Conv(jnp.ones((3, 3, 4, 4)), bias), image)
        return depthwise_conv(DepthwiseConv(jnp.ones((3, 3, 4)), bias), image)

    def total(bias: jax.Array) -> jax.Array:
        y = jax.vmap(apply, in_axes=(None, 0))(bias, x)
        return (y * towards).astype(jnp.float32).sum()

    expected = np.asarray(towards, np.float64).sum((0, 1, 2))
    # 2048 numbers added in float32. Where a processor adds bfloat16 by itself, 10 % were lost.
    np.testing.assert_allclose(jax.grad(total)(jnp.zeros(4)), expected, rtol=1e-5)


def test_gelu_of_bfloat16_is_computed_in_float32() -> None:
    x = torch.linspace(-4, 4, 401).bfloat16()
    expected = torch.nn.functional.gelu(x.double()).numpy()
    ours = gelu(jnp.asarray(x.float().numpy()).astype(jnp.bfloat16))
    assert ours.dtype == jnp.bfloat16
    # One rounding to 8 bits, 2^-9, and float32's of 1 + erf where that is 3e-5 (at -4).
    np.testing.assert_allclose(np.asarray(ours, np.float64), expected, rtol=5e-3)


def test_derivatives_that_jax_is_told_are_torchs() -> None:
    """Of GELU and of layer norm; of their gradients too, for which nothing is told."""
    x, towards, again = (normal(seed, 5, 7) for seed in (3, 4, 5))
    params = LayerNorm(jnp.asarray(normal(6, 7)), jnp.asarray(normal(7, 7)))
    weight, bias = torch.tensor(np.array(params.weight)), torch.tensor(np.array(params.bias))

    def torch_norm(x: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.layer_norm(x, (7,), weight, bias, 1e-6)

    pairs = (
        (gelu, torch.nn.functional.gelu),
        (lambda x: layer_norm(params, x, epsilon=1e-6), torch_norm),
    )
    for ours, theirs in pairs:
        at = torch.tensor(x, requires_grad=True)
        (first,) = torch.autograd.grad(theirs(at), at, torch.tensor(towards), create_graph=True)
        (second,) = torch.autograd.grad(first, at, torch.tensor(again))

        def gradient(x: jax.Array, ours: Any = ours) -> jax.Array:
            return jax.vjp(ours, x)[1](jnp.asarray(towards))[0]

        found, pull = jax.vjp(gradient, jnp.asarray(x))
        # Numbers of order 10, a dozen roundings each.
        np.testing.assert_allclose(found, first.detach(), atol=1e-5)
        np.testing.assert_allclose(pull(jnp.asarray(again))[0], second, atol=1e-5)


def test_layer_norm_of_bfloat16_is_computed_in_float32() -> None:
    x = jnp.asarray(100 + normal(0, 4, 64)).astype(jnp.bfloat16)
    unit = LayerNorm(jnp.ones(64), jnp.zeros(64))
    ours = layer_norm(unit, x, epsilon=1e-6)
    assert ours.dtype == jnp.bfloat16
    wide = np.asarray(x, np.float64)
    expected = (wide - wide.mean(1, keepdims=True)) / wide.std(1, keepdims=True)
    # One rounding to bfloat16, 2^-9 of values up to 4; a bfloat16 mean alone is off by 0.25.
    np.testing.assert_allclose(np.asarray(ours, np.float64), expected, atol=4 * 2**-8)


@pytest.mark.parametrize("size", [1, 3, 5])
def test_depthwise_conv_equals_torch(size: int) -> None:
    x, weight, bias = normal(0, 4, 6, 8), normal(1, size, size, 8), normal(2, 8)
    expected = torch.nn.functional.conv2d(
        torch.tensor(x).permute(2, 0, 1)[None],
        torch.tensor(weight).permute(2, 0, 1)[:, None],
        torch.tensor(bias),
        padding=size // 2,
        groups=8,
    )[0].permute(1, 2, 0)
    ours = depthwise_conv(DepthwiseConv(jnp.asarray(weight), jnp.asarray(bias)), jnp.asarray(x))
    # 25 products of order 1: their sum's rounding.
    np.testing.assert_allclose(ours, expected, atol=5e-6)


def test_gelu_equals_torch_and_not_the_tanh_form() -> None:
    x = np.linspace(-6, 6, 1001, dtype=np.float32)
    expected = torch.nn.functional.gelu(torch.tensor(x)).numpy()
    tanh = torch.nn.functional.gelu(torch.tensor(x), approximate="tanh").numpy()
    np.testing.assert_allclose(gelu(jnp.asarray(x)), expected, atol=2e-6)
    assert np.abs(tanh - expected).max() > 1e-4  # so the line above tells the two apart


def test_l2_normalise_has_unit_length_and_a_finite_gradient_at_zero() -> None:
    x = jnp.asarray(normal(0, 3, 8))
    expected = torch.nn.functional.normalize(torch.tensor(np.asarray(x)), dim=-1)
    np.testing.assert_allclose(l2_normalise(x), expected, atol=1e-6)
    zero = jnp.zeros((1, 8))
    np.testing.assert_array_equal(l2_normalise(zero), zero)
    assert jnp.isfinite(jax.grad(lambda v: l2_normalise(v).sum())(zero)).all()


def test_dropout() -> None:
    x = jnp.ones(100_000)
    assert dropout(x, 0.3, key=None) is x
    assert dropout(x, 0.0, key=jax.random.key(0)) is x
    dropped = np.asarray(dropout(x, 0.3, key=jax.random.key(0)))
    assert set(np.unique(dropped)) == {np.float32(0), np.float32(1 / 0.7)}
    # The share of zeros is binomial: deviation sqrt(0.21 / 1e5) = 0.0014; five of them.
    assert abs((dropped == 0).mean() - 0.3) < 0.007


def test_starts_are_torch_defaults() -> None:
    """Uniform within 1 / sqrt(fan in): the largest of many draws comes within 1 % of the bound."""
    key = jax.random.key(0)
    assert init_linear(key, 64, 4, bias=False).bias is None
    for layer, bound in (
        (init_linear(key, 64, 400), 1 / 8),
        (init_depthwise_conv(key, 3, 400), 1 / 3),
        (init_conv(key, 3, 16, 400), 1 / math.sqrt(3 * 3 * 16)),
    ):
        for values in (layer.weight, layer.bias):
            assert 0.99 * bound < float(jnp.abs(values).max()) <= bound


@pytest.mark.parametrize("images", [4, 1])
def test_batch_norm_in_training_equals_torchs(images: int) -> None:
    """Output, gradients, and running statistics after two batches, with a padded image.

    Values are of order 10 about means of order 10: float32 rounds them by 1e-6, and the variances,
    whose sums are of 12 to 48 squares, by some 1e-5 of themselves.
    """
    layer = torch.nn.BatchNorm2d(3, eps=1e-3).train()
    start = {name: normal(i, 3) for i, name in enumerate(("weight", "bias", "running_mean"))}
    start["running_var"] = np.array([0.1, 1.0, 10.0], np.float32)
    layer.load_state_dict({n: torch.tensor(x) for n, x in start.items()}, strict=False)
    params = BatchNorm(**{name: jnp.asarray(x) for name, x in start.items()})
    valid = jnp.arange(images + 1) < images
    for seed in (5, 6):
        x = 10 * normal(seed, images + 1, 3, 4, 3) + 10 * normal(seed + 10, 3)
        towards = normal(seed + 20, images, 3, 4, 3)
        tensor = torch.tensor(x[:images]).permute(0, 3, 1, 2).requires_grad_()
        theirs = layer(tensor)
        layer.zero_grad()
        theirs.backward(torch.tensor(towards).permute(0, 3, 1, 2))

        def total(params: BatchNorm, x: jax.Array, towards: np.ndarray = towards) -> Any:
            y, updated = train_batch_norm(params, x, valid, epsilon=1e-3)
            return (y[:images] * towards).sum(), (y[:images], updated)

        gradient = jax.value_and_grad(total, argnums=(0, 1), has_aux=True)
        (_, (ours, updated)), (of_params, of_x) = gradient(params, jnp.asarray(x))
        np.testing.assert_allclose(ours, theirs.detach().permute(0, 2, 3, 1), atol=1e-5)
        assert tensor.grad is not None
        np.testing.assert_allclose(of_x[:images], tensor.grad.permute(0, 2, 3, 1), atol=1e-5)
        assert not of_x[images:].any()
        for name in ("weight", "bias"):
            expected = getattr(layer, name).grad
            np.testing.assert_allclose(getattr(of_params, name), expected, rtol=1e-5, atol=1e-4)
        for name in ("running_mean", "running_var"):
            assert not getattr(of_params, name).any()
            np.testing.assert_allclose(getattr(updated, name), getattr(layer, name), rtol=1e-5)
        params = updated


def test_batch_norm_of_no_image_keeps_its_statistics() -> None:
    params = init_batch_norm(3)
    nothing = jnp.zeros(2, bool)
    y, updated = train_batch_norm(params, jnp.asarray(normal(0, 2, 5, 3)), nothing, epsilon=1e-3)
    assert np.isfinite(y).all()
    np.testing.assert_array_equal(updated.running_mean, params.running_mean)
    np.testing.assert_array_equal(updated.running_var, params.running_var)


def test_batch_norm_starts_as_torchs() -> None:
    theirs = {name: x.numpy() for name, x in torch.nn.BatchNorm2d(5).state_dict().items()}
    del theirs["num_batches_tracked"]
    ours = dataclasses.asdict(init_batch_norm(5))
    assert ours.keys() == theirs.keys()
    for name, values in theirs.items():
        np.testing.assert_array_equal(ours[name], values)
