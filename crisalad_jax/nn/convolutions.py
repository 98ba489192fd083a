"""Layers of convolutional backbones: convolutions with batch norm, and max pooling."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.nn import random_init
from crisalad_jax.nn.layers import BatchNorm, Conv, Valid, conv, init_batch_norm, train_batch_norm
from crisalad_jax.utils.pytree import pytree_dataclass

Map = Float[Array, "image _ _ _"]
"""Features of a batch of images in rows and columns, channels last."""
BATCH_NORM_EPSILON = 1e-5
"""Epsilon of torch's `nn.BatchNorm2d`, which all published backbones use."""


@pytree_dataclass
class ConvNorm:
    """A convolution and the batch norm after it."""

    conv: Conv
    norm: BatchNorm


def init_he_conv(
    key: PRNGKeyArray, kernel_size: int, d_in: int, d_out: int, *, bias: bool = False
) -> Conv:
    """Draw a convolution like torchvision: normal of variance 2 / (kernel_size^2 d_out), bias 0.

    This is the initialisation of He et al. (2015), in its fan-out mode.
    """
    deviation = math.sqrt(2 / (kernel_size**2 * d_out))
    weight = random_init.normal(key, (kernel_size, kernel_size, d_in, d_out), scale=deviation)
    return Conv(weight, random_init.zeros(d_out) if bias else None)


def init_conv_norm(
    key: PRNGKeyArray, kernel_size: int, d_in: int, d_out: int, *, bias: bool = False
) -> ConvNorm:
    """Draw a convolution, with a batch norm that starts as the identity."""
    return ConvNorm(init_he_conv(key, kernel_size, d_in, d_out, bias=bias), init_batch_norm(d_out))


def conv_norm(
    params: ConvNorm,
    x: Float[Array, "image height width d_in"],
    valid: Valid = None,
    *,
    stride: int = 1,
    epsilon: float = BATCH_NORM_EPSILON,
) -> tuple[Float[Array, "image rows columns d_out"], ConvNorm]:
    """Convolve, and normalise by the stored statistics or by those of a training batch.

    The stored statistics are folded into the convolution, which costs a pass over the weights but
    saves one over the much larger activations.

    Args:
        params: the layers.
        x: a batch of images.
        valid: mask of the images whose statistics are used; None uses the stored statistics.
        stride: stride of the convolution.
        epsilon: added to the variance.

    Returns:
        (y, updated): `updated` is `params`, with new running statistics if `valid` is given.
    """
    if valid is not None:
        y = conv(params.conv, x, stride=stride)
        y, norm = train_batch_norm(params.norm, y, valid, epsilon=epsilon)
        return y, dataclasses.replace(params, norm=norm)
    norm = params.norm
    scale = norm.weight * jax.lax.rsqrt(norm.running_var + epsilon)
    shift = norm.bias - norm.running_mean * scale
    if params.conv.bias is not None:
        shift = shift + params.conv.bias * scale
    return conv(Conv(params.conv.weight * scale, shift), x, stride=stride), params


def max_pool(
    x: Float[Array, "*batch height width dim"], size: int, *, stride: int = 2, padding: int = 0
) -> Float[Array, "*batch rows columns dim"]:
    """Return the maximum of each window of size x size pixels, ignoring padding.

    The gradient goes to the first of equal pixels, as in torch. `jax.jvp` is not supported.
    """
    images = x.reshape(-1, *x.shape[-3:])
    y = _max_pool(images, size, stride, padding)
    return y.reshape(*x.shape[:-3], *y.shape[1:])


def _pool(x: Array, size: int, stride: int, padding: int) -> Array:
    """Pool a batch.

    The gradient is a custom rule, because JAX's own stores all pixels and is slower on a CPU: it
    scatters each window's gradient to its maximum.
    """
    margins = ((0, 0), (padding, padding), (padding, padding), (0, 0))
    window, strides = (1, size, size, 1), (1, stride, stride, 1)
    return jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, window, strides, margins)


_max_pool = jax.custom_vjp(_pool, nondiff_argnums=(1, 2, 3))


def _max_pool_forward(x: Array, size: int, stride: int, padding: int) -> tuple[Array, Any]:
    """Save which pixel of each window was its first maximum, and the images' height and width."""
    y = _pool(x, size, stride, padding)
    rows, columns = y.shape[1:3]
    margin = (padding, padding)
    padded = jnp.pad(x, ((0, 0), margin, margin, (0, 0)), constant_values=-jnp.inf)
    number_type = np.min_scalar_type(size * size)
    winner = jnp.zeros(y.shape, number_type)
    for number, (top, left) in reversed(list(enumerate(np.ndindex(size, size)))):
        bottom, right = top + (rows - 1) * stride + 1, left + (columns - 1) * stride + 1
        pixels = padded[:, top:bottom:stride, left:right:stride]
        winner = jnp.where(pixels == y, jnp.asarray(number, number_type), winner)
    return y, (winner, x.shape[1:3])


def _max_pool_backward(
    size: int, stride: int, padding: int, kept: tuple[Array, tuple[int, int]], change: Array
) -> tuple[Array]:
    """Add the gradient of every window at its maximum; windows may overlap."""
    winner, (height, width) = kept
    zero = jnp.zeros((), change.dtype)
    total: Any = 0
    for number, (top, left) in enumerate(np.ndindex(size, size)):
        margins = [(0, 0, 0)] * 4
        for axis, start, length in ((1, top, height), (2, left, width)):
            end = start + (change.shape[axis] - 1) * stride + 1
            # Negative margins cut the padding off again.
            margins[axis] = (start - padding, length + padding - end, stride - 1)
        here = jnp.where(winner == number, change, zero)
        total = total + jax.lax.pad(here, zero, margins)
    return (total,)


_max_pool.defvjp(_max_pool_forward, _max_pool_backward)
