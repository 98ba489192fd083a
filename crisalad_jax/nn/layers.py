"""The small layers: linear, layer norm, convolutions on a patch grid, GELU, dropout, L2."""

import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PRNGKeyArray

from crisalad_jax.platform import product_dtype
from crisalad_jax.pytree import params

Keys = Key[Array, "*keys"]
"""One for all, or one for each of a batch."""


@params
class Linear:
    """Weights of `x @ weight + bias`; torch stores `weight` transposed."""

    weight: Float[Array, "*stack d_in d_out"]
    bias: Float[Array, "*stack d_out"] | None


@params
class LayerNorm:
    """Gain and shift of a layer norm."""

    weight: Float[Array, "*stack dim"]
    bias: Float[Array, "*stack dim"]


@params
class DepthwiseConv:
    """One k x k filter a channel."""

    weight: Float[Array, "*stack k k dim"]
    bias: Float[Array, "*stack dim"]


@params
class Conv:
    """A k x k convolution; torch stores `weight` as (dim_out, dim_in, k, k)."""

    weight: Float[Array, "*stack k k d_in d_out"]
    bias: Float[Array, "*stack d_out"]


@params
class BatchNorm:
    """Gain and shift of a batch norm, and the statistics it normalises by.

    The statistics are constants: they do not train, and no batch changes them.
    """

    weight: Float[Array, "*stack dim"]
    bias: Float[Array, "*stack dim"]
    running_mean: Float[Array, "*stack dim"]
    running_var: Float[Array, "*stack dim"]


def init_linear(key: PRNGKeyArray, d_in: int, d_out: int, *, bias: bool = True) -> Linear:
    """Start as torch's `nn.Linear` does: weight and bias uniform within 1 / sqrt(d_in)."""
    weight_key, bias_key = jax.random.split(key)
    bound = 1 / math.sqrt(d_in)
    return Linear(
        jax.random.uniform(weight_key, (d_in, d_out), minval=-bound, maxval=bound),
        jax.random.uniform(bias_key, (d_out,), minval=-bound, maxval=bound) if bias else None,
    )


def init_layer_norm(dim: int) -> LayerNorm:
    """Start at gain 1 and shift 0."""
    return LayerNorm(jnp.ones(dim), jnp.zeros(dim))


def init_depthwise_conv(key: PRNGKeyArray, kernel_size: int, dim: int) -> DepthwiseConv:
    """Start as torch's `nn.Conv2d(groups=dim)` does: uniform within 1 / kernel_size."""
    weight_key, bias_key = jax.random.split(key)
    bound = 1 / kernel_size
    return DepthwiseConv(
        jax.random.uniform(
            weight_key, (kernel_size, kernel_size, dim), minval=-bound, maxval=bound
        ),
        jax.random.uniform(bias_key, (dim,), minval=-bound, maxval=bound),
    )


def init_conv(key: PRNGKeyArray, kernel_size: int, d_in: int, d_out: int) -> Conv:
    """Start as torch's `nn.Conv2d` does: uniform within 1 / sqrt(kernel_size^2 d_in)."""
    weight_key, bias_key = jax.random.split(key)
    bound = 1 / (kernel_size * math.sqrt(d_in))
    shape = (kernel_size, kernel_size, d_in, d_out)
    return Conv(
        jax.random.uniform(weight_key, shape, minval=-bound, maxval=bound),
        jax.random.uniform(bias_key, (d_out,), minval=-bound, maxval=bound),
    )


def init_batch_norm(dim: int) -> BatchNorm:
    """Start as torch's `nn.BatchNorm2d` does: with mean 0 and variance 1, it changes nothing."""
    return BatchNorm(jnp.ones(dim), jnp.zeros(dim), jnp.zeros(dim), jnp.ones(dim))


def widen(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """`x` in float32 at least.

    Elementwise work on bfloat16 is done wide and rounded once. What a parameter is broadcast over
    must be wide above all: its gradient is a sum over all tokens and images, and hardware with
    bfloat16 arithmetic of its own would add them up in 8 bits.
    """
    return x.astype(jnp.promote_types(x.dtype, jnp.float32))


def linear(params: Linear, x: Float[Array, "*batch d_in"]) -> Float[Array, "*batch d_out"]:
    """Affine map of the last axis, in the type of `x`. On a CPU it is rounded once, at the end.

    All of the batch are rows of one matrix: for the gradient of a weight XLA would else turn what
    comes back, by a copy.
    """
    rows, weight = x.reshape(-1, x.shape[-1]), params.weight.astype(x.dtype)
    y = jnp.matmul(rows, weight, preferred_element_type=product_dtype(x.dtype))
    y = (y if params.bias is None else widen(y) + params.bias).astype(x.dtype)
    return y.reshape(*x.shape[:-1], weight.shape[-1])


def layer_norm(
    params: LayerNorm, x: Float[Array, "*batch dim"], *, epsilon: float
) -> Float[Array, "*batch dim"]:
    """Normalise the last axis to mean 0 and variance 1, in float32, and return the type of `x`."""
    y = _standardise(widen(x), epsilon) * params.weight + params.bias
    return y.astype(x.dtype)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _standardise(x: Array, epsilon: float) -> Array:
    """Mean 0 and variance 1 along the last axis.

    The derivative is told to JAX because by itself it would keep three arrays for it, not one.
    """
    return _standardised(x, epsilon)[0]


def _standardised(x: Array, epsilon: float) -> tuple[Array, Array]:
    centred = x - x.mean(axis=-1, keepdims=True)
    scale = jax.lax.rsqrt(jnp.square(centred).mean(axis=-1, keepdims=True) + epsilon)
    return centred * scale, scale


@_standardise.defjvp
def _standardise_jvp(
    epsilon: float, primals: tuple[Array], tangents: tuple[Array]
) -> tuple[Array, Array]:
    y, scale = _standardised(*primals, epsilon)
    (change,) = tangents
    along = (y * change).mean(axis=-1, keepdims=True)
    return y, scale * (change - change.mean(axis=-1, keepdims=True) - y * along)


def depthwise_conv(
    params: DepthwiseConv, x: Float[Array, "height width dim"]
) -> Float[Array, "height width dim"]:
    """Convolve every channel with its own filter (cross-correlation, as torch), zero padding.

    A sum of k x k shifted products: for small filters XLA fuses it into one pass over `x`, where
    its grouped convolution is many times slower on a CPU.
    """
    size = params.weight.shape[0]
    height, width, _ = x.shape
    margin = size // 2
    padded = widen(jnp.pad(x, ((margin, margin), (margin, margin), (0, 0))))
    taps = [
        padded[i : i + height, j : j + width] * params.weight[i, j]
        for i in range(size)
        for j in range(size)
    ]
    return sum(taps, start=params.bias).astype(x.dtype)


def conv(params: Conv, x: Float[Array, "height width d_in"]) -> Float[Array, "height width d_out"]:
    """Convolve (cross-correlate, as torch) at stride 1 with zero padding, in the type of `x`."""
    y = jax.lax.conv_general_dilated(
        x[None],
        params.weight.astype(x.dtype),
        window_strides=(1, 1),
        padding="SAME",
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )
    return (widen(y[0]) + params.bias).astype(x.dtype)


def batch_norm(
    params: BatchNorm, x: Float[Array, "*batch dim"], *, epsilon: float
) -> Float[Array, "*batch dim"]:
    """Normalise by the stored statistics, as torch does in evaluation; returns the type of `x`."""
    wide = widen(x)
    scale = params.weight * jax.lax.rsqrt(params.running_var + epsilon)
    return ((wide - params.running_mean) * scale + params.bias).astype(x.dtype)


@jax.custom_jvp
def gelu(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Exact GELU. The erf form: `jax.nn.gelu`'s erfc form takes twice as long on a CPU.

    The derivative is told to JAX because by itself it would keep three arrays for it, not one.
    """
    wide = widen(x)
    return (wide * _normal_cdf(wide)).astype(x.dtype)


def _normal_cdf(x: Array) -> Array:
    return 0.5 * (1 + jax.lax.erf(x * math.sqrt(0.5)))


@gelu.defjvp
def _gelu_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (change,) = primals, tangents
    wide = widen(x)
    below = _normal_cdf(wide)
    density = jnp.exp(-0.5 * jnp.square(wide)) / math.sqrt(2 * math.pi)
    slope = below + wide * density
    return (wide * below).astype(x.dtype), (slope * widen(change)).astype(x.dtype)


def dropout(x: Float[Array, "*shape"], rate: float, *, key: Keys | None) -> Float[Array, "*shape"]:
    """Zero a share `rate` of `x` and scale the rest up. `key=None` means inference: `x` itself.

    Given a key for each of the leading axis, what one draws does not depend on the others.
    """
    if key is None or rate == 0:
        return x
    draw = functools.partial(jax.random.bernoulli, p=1 - rate, shape=x.shape[key.ndim :])
    keep = jax.vmap(draw)(key) if key.ndim else draw(key)
    return jnp.where(keep, x / (1 - rate), 0)


def split_key(key: Keys | None, count: int) -> list[Keys | None]:
    """`count` keys from one, or from each of several; None as often where nothing is random."""
    if key is None:
        return [None] * count
    split = functools.partial(jax.random.split, num=count)
    return list(jnp.moveaxis(jax.vmap(split)(key), 1, 0) if key.ndim else split(key))


def l2_normalise(x: Float[Array, "*batch dim"]) -> Float[Array, "*batch dim"]:
    """Scale the last axis to length 1, as torch's `F.normalize`: below 1e-12 counts as 1e-12.

    The root is taken of a number kept from 0, so that a zero vector has gradient 0 and not NaN.
    """
    squared = jnp.sum(x * x, axis=-1, keepdims=True)
    return x * jax.lax.rsqrt(jnp.maximum(squared, 1e-24))
