"""Small layers: linear, norms, convolutions on a patch grid, GELU, dropout, L2 normalisation."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key, PRNGKeyArray, PyTree

from crisalad_jax.nn import random_init
from crisalad_jax.nn.products import convolve, matmul
from crisalad_jax.utils.pytree import pytree_dataclass

Keys = Key[Array, "*keys"] | None
"""One random key for a whole batch, or one for each entry; None means inference."""
Grid = tuple[int, int]
"""Rows and columns of patches."""
Valid = Bool[Array, " image"] | None
"""Mask of the images whose statistics batch norms use in training; None uses the stored ones."""
TAPS = "taps"
"""Name of the scope of the elementwise products that make up a depthwise convolution."""
STATISTICS = ("running_mean", "running_var")
"""Fields of `BatchNorm` that are measured, not learnt."""
MOMENTUM = 0.1
"""Weight of a batch in the running statistics: torch's default."""


@pytree_dataclass
class Linear:
    """The weights of `x @ weight + bias`; torch stores `weight` transposed."""

    weight: Float[Array, "*stack d_in d_out"]
    bias: Float[Array, "*stack d_out"] | None


@pytree_dataclass
class TwoLayer:
    """A network with one hidden layer: linear, ReLU, linear."""

    fc1: Linear
    fc2: Linear


@pytree_dataclass
class LayerNorm:
    """Gain and shift of a layer norm."""

    weight: Float[Array, "*stack dim"]
    bias: Float[Array, "*stack dim"]


@pytree_dataclass
class DepthwiseConv:
    """One k x k filter for each channel."""

    weight: Float[Array, "*stack k k dim"]
    bias: Float[Array, "*stack dim"] | None


@pytree_dataclass
class Conv:
    """A k x k convolution; torch stores `weight` as (dim_out, dim_in, k, k)."""

    weight: Float[Array, "*stack k k d_in d_out"]
    bias: Float[Array, "*stack d_out"] | None


@pytree_dataclass
class BatchNorm:
    """Gain and shift of a batch norm, and the running statistics of the batches it has seen.

    Gradients do not change the statistics; `train_batch_norm` returns updated ones.
    """

    weight: Float[Array, "*stack dim"]
    bias: Float[Array, "*stack dim"]
    running_mean: Float[Array, "*stack dim"]
    running_var: Float[Array, "*stack dim"]


def init_linear(key: PRNGKeyArray, d_in: int, d_out: int, *, bias: bool = True) -> Linear:
    """Draw a linear layer like torch's `nn.Linear`: uniform within +- 1 / sqrt(d_in)."""
    return Linear(*_within(key, (d_in, d_out), fan=d_in, bias=bias))


def _within(
    key: PRNGKeyArray, shape: tuple[int, ...], *, fan: int, bias: bool = True
) -> tuple[Float[Array, "*shape"], Float[Array, " d_out"] | None]:
    """Draw weight and bias uniformly within 1 / sqrt(fan), like torch's layers."""
    weight_key, bias_key = random_init.split(key)
    bound = 1 / math.sqrt(fan)
    draw = functools.partial(random_init.uniform, minval=-bound, maxval=bound)
    return draw(weight_key, shape), draw(bias_key, shape[-1:]) if bias else None


def init_small_linear(key: PRNGKeyArray, d_in: int, d_out: int, *, bias: bool = True) -> Linear:
    """Draw a ViT's linear layer: normal of deviation 0.02, truncated at twice that; bias 0."""
    weight = random_init.truncated_normal(key, -2.0, 2.0, (d_in, d_out), scale=0.02)
    return Linear(weight, random_init.zeros(d_out) if bias else None)


def init_layer_norm(dim: int) -> LayerNorm:
    """Make a layer norm with gain 1 and shift 0."""
    return LayerNorm(random_init.ones(dim), random_init.zeros(dim))


def init_depthwise_conv(
    key: PRNGKeyArray, kernel_size: int, dim: int, *, bias: bool = True
) -> DepthwiseConv:
    """Draw filters like torch's `nn.Conv2d(groups=dim)`: uniform within +- 1 / kernel_size."""
    shape = kernel_size, kernel_size, dim
    return DepthwiseConv(*_within(key, shape, fan=kernel_size**2, bias=bias))


def init_conv(key: PRNGKeyArray, kernel_size: int, d_in: int, d_out: int) -> Conv:
    """Draw a layer like torch's `nn.Conv2d`: uniform within +- 1 / sqrt(kernel_size^2 d_in)."""
    shape = kernel_size, kernel_size, d_in, d_out
    return Conv(*_within(key, shape, fan=kernel_size**2 * d_in))


def init_transposed_conv(key: PRNGKeyArray, kernel_size: int, d_in: int, d_out: int) -> Conv:
    """Draw like torch's `nn.ConvTranspose2d`: uniform within +- 1 / sqrt(kernel_size^2 d_out)."""
    shape = kernel_size, kernel_size, d_in, d_out
    return Conv(*_within(key, shape, fan=kernel_size**2 * d_out))


def init_batch_norm(dim: int) -> BatchNorm:
    """Make a batch norm like torch's `nn.BatchNorm2d`: mean 0 and variance 1, the identity."""
    return BatchNorm(
        random_init.ones(dim), random_init.zeros(dim), random_init.zeros(dim), random_init.ones(dim)
    )


def at_least_float32(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Convert `x` to float32, unless its type is wider.

    Elementwise work on bfloat16 is done in float32 and rounded once. Above all, operands that a
    parameter is broadcast over must be float32: the parameter's gradient is a sum over all tokens
    and images, which hardware with native bfloat16 would accumulate in 8 bits.
    """
    return x.astype(jnp.promote_types(x.dtype, jnp.float32))


def residual_sum(
    x: Float[Array, "*batch dim"], update: Float[Array, "*batch dim"]
) -> Float[Array, "*batch dim"]:
    """Add an update in at least float32, and round once to the type of `x`."""
    return (at_least_float32(x) + at_least_float32(update)).astype(x.dtype)


def linear(params: Linear, x: Float[Array, "*batch d_in"]) -> Float[Array, "*batch d_out"]:
    """Apply an affine map to the last axis, in the type of `x`; a CPU rounds once, at the end.

    The batch is reshaped to rows of one matrix: otherwise XLA would copy the cotangent to transpose
    it for the gradient of the weight.
    """
    y = matmul(x.reshape(-1, x.shape[-1]), params.weight)
    y = (y if params.bias is None else at_least_float32(y) + params.bias).astype(x.dtype)
    return y.reshape(*x.shape[:-1], y.shape[-1])


LinearUpdate = Callable[[str, Array], Array | None]
"""Function from a linear layer's name and input to what an adapter adds to its output, or None."""


def no_update(name: str, x: Array) -> None:
    """Return None: add nothing to the output of any layer."""


def adapted_linear(
    name: str, params: Linear, x: Float[Array, "*batch d_in"], update: LinearUpdate
) -> Float[Array, "*batch d_out"]:
    """Apply `linear`, and add what `update` returns for the layer called `name`, if anything."""
    y, extra = linear(params, x), update(name, x)
    return y if extra is None else y + extra


def columns(params: Linear, start: int, stop: int) -> Linear:
    """Return the part of a linear layer that computes the outputs `start:stop`."""
    return jax.tree.map(lambda x: x[..., start:stop], params)


def layer_norm(
    params: LayerNorm, x: Float[Array, "*batch dim"], *, epsilon: float = 1e-5
) -> Float[Array, "*batch dim"]:
    """Normalise the last axis to mean 0 and variance 1, and return the result in the dtype of `x`.

    Mean and variance are computed in at least float32. The default of `epsilon` is torch's.
    """
    y = _standardise(at_least_float32(x), epsilon) * params.weight + params.bias
    return y.astype(x.dtype)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _standardise(x: Array, epsilon: float) -> Array:
    """Normalise the last axis to mean 0 and variance 1.

    The derivative is a custom rule, because JAX's own would store three arrays, not one.
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
    """Convolve every channel with its own filter (cross-correlation, as in torch) and zero padding.

    It is a sum of k x k shifted products, which XLA fuses into one pass over `x` for small filters.
    XLA's grouped convolution is many times slower on a CPU.
    """
    size = params.weight.shape[0]
    height, width, _ = x.shape
    margin = size // 2
    padded = at_least_float32(jnp.pad(x, ((margin, margin), (margin, margin), (0, 0))))
    with jax.named_scope(TAPS):
        taps = [
            padded[i : i + height, j : j + width] * params.weight[i, j]
            for i in range(size)
            for j in range(size)
        ]
    y = sum(taps[1:], start=taps[0]) if params.bias is None else sum(taps, start=params.bias)
    return y.astype(x.dtype)


def conv(
    params: Conv,
    x: Float[Array, "*batch height width d_in"],
    *,
    stride: int = 1,
    padding: int | None = None,
) -> Float[Array, "*batch rows columns d_out"]:
    """Convolve (cross-correlate, as in torch) with zero padding, in the type of `x`.

    The padding is half a kernel by default, so that a side of n pixels becomes ceil(n / stride) for
    kernels of odd size.
    """
    margin = params.weight.shape[0] // 2 if padding is None else padding
    images = x.reshape(-1, *x.shape[-3:])
    y = convolve(images, params.weight, stride=stride, margin=margin)
    if params.bias is not None:
        y = at_least_float32(y) + params.bias
    return y.astype(x.dtype).reshape(*x.shape[:-3], *y.shape[1:])


def train_batch_norm(
    params: BatchNorm,
    x: Float[Array, "image *shape dim"],
    valid: Bool[Array, " image"],
    *,
    epsilon: float,
) -> tuple[Float[Array, "image *shape dim"], BatchNorm]:
    """Normalise by the statistics of a batch, like torch in training, and update the running ones.

    The running variance uses the unbiased estimate; the batch is normalised by the biased one.
    Images that are not valid are ignored; a batch without valid images changes no statistics. For
    a batch that is sharded over devices, the statistics are those of the whole batch.

    Args:
        params: the batch norm.
        x: values of a batch; the statistics are over all axes but the last.
        valid: which images are not padding.
        epsilon: added to the variance.

    Returns:
        (y, updated): the normalised values in the type of `x`, and the batch norm with updated
        statistics, through which no gradient flows.
    """
    wide = at_least_float32(x)
    axes = tuple(range(x.ndim - 1))
    mask = valid.reshape(-1, *(1,) * (x.ndim - 1))
    count = valid.sum() * math.prod(x.shape[1:-1])

    def mean(values: Array) -> Array:
        return jnp.where(mask, values, 0).sum(axis=axes) / jnp.maximum(count, 1)

    centre = mean(wide)
    centred = wide - centre
    variance = mean(jnp.square(centred))
    y = centred * (params.weight * jax.lax.rsqrt(variance + epsilon)) + params.bias

    def moved(running: Array, batch: Array) -> Array:
        new = (1 - MOMENTUM) * running + MOMENTUM * jax.lax.stop_gradient(batch)
        return jnp.where(count > 0, new, running).astype(running.dtype)

    unbiased = variance * (count / jnp.maximum(count - 1, 1))
    updated = dataclasses.replace(
        params,
        running_mean=moved(params.running_mean, centre),
        running_var=moved(params.running_var, unbiased),
    )
    return y.astype(x.dtype), updated


def split_statistics(params: PyTree) -> tuple[PyTree, PyTree]:
    """Split parameters into the running statistics of their batch norms and everything else.

    Args:
        params: a pytree.

    Returns:
        (statistics, rest): two trees of the same structure; each has None for the other's leaves.

    Example:
        >>> statistics, rest = split_statistics(init_batch_norm(2))
        >>> statistics.weight is None, rest.running_mean is None
        (True, True)
    """

    def is_measured(path: Any, _: Any) -> bool:
        return jax.tree_util.keystr(path[-1:], simple=True) in STATISTICS

    measured = jax.tree_util.tree_map_with_path(is_measured, params)
    statistics = jax.tree.map(lambda leaf, take: leaf if take else None, params, measured)
    rest = jax.tree.map(lambda leaf, take: None if take else leaf, params, measured)
    return statistics, rest


def merge_statistics(statistics: PyTree, params: PyTree) -> PyTree:
    """Replace the running statistics in parameters with those from `split_statistics`."""

    def choose(new: Any, old: Any) -> Any:
        return old if new is None else new

    return jax.tree.map(choose, statistics, params, is_leaf=lambda leaf: leaf is None)


@jax.custom_jvp
def gelu(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Apply the exact GELU with erf: the erfc of `jax.nn.gelu` takes twice as long on a CPU.

    The derivative is a custom rule, because JAX's own would store three arrays, not one.
    """
    wide = at_least_float32(x)
    return (wide * _normal_cdf(wide)).astype(x.dtype)


def _normal_cdf(x: Array) -> Array:
    return 0.5 * (1 + jax.lax.erf(x * math.sqrt(0.5)))


@gelu.defjvp
def _gelu_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (change,) = primals, tangents
    wide = at_least_float32(x)
    below = _normal_cdf(wide)
    density = jnp.exp(-0.5 * jnp.square(wide)) / math.sqrt(2 * math.pi)
    slope = below + wide * density
    return (wide * below).astype(x.dtype), (slope * at_least_float32(change)).astype(x.dtype)


def dropout(x: Float[Array, "*shape"], rate: float, *, key: Keys) -> Float[Array, "*shape"]:
    """Zero a fraction `rate` of `x` and scale the rest up; return `x` for `key=None` (inference).

    With one key for each entry of the leading axis, an entry's draws do not depend on the others.
    """
    if key is None or rate == 0:
        return x
    keep_some = functools.partial(jax.random.bernoulli, p=1 - rate, shape=x.shape[key.ndim :])
    keep = jax.vmap(keep_some)(key) if key.ndim else keep_some(key)
    return jnp.where(keep, x / (1 - rate), 0)


def split_key(key: Keys, count: int) -> list[Keys]:
    """Split one key, or each of several, into `count` keys; for None, return a list of None."""
    if key is None:
        return [None] * count
    split = functools.partial(jax.random.split, num=count)
    return list(jnp.moveaxis(jax.vmap(split)(key), 1, 0) if key.ndim else split(key))


def l2_normalise(x: Float[Array, "*batch dim"]) -> Float[Array, "*batch dim"]:
    """Scale the last axis to length 1, like torch's `F.normalize`, which divides by at least 1e-12.

    The squared length is clamped above 0 before the root, so that a zero vector has gradient 0
    rather than NaN.
    """
    squared = jnp.sum(x * x, axis=-1, keepdims=True)
    return x * jax.lax.rsqrt(jnp.maximum(squared, 1e-24))


def init_two_layer(key: PRNGKeyArray, d_in: int, hidden: int, d_out: int) -> TwoLayer:
    """Draw a network with one hidden layer, each layer like torch's `nn.Linear`."""
    first, second = random_init.split(key)
    return TwoLayer(init_linear(first, d_in, hidden), init_linear(second, hidden, d_out))


def two_layer(
    params: TwoLayer, x: Float[Array, "*batch d_in"], rate: float, key: Keys
) -> Float[Array, "*batch d_out"]:
    """Apply the network, with dropout at this rate before the ReLU unless the key is None."""
    hidden = dropout(linear(params.fc1, x), rate, key=key)
    return linear(params.fc2, jax.nn.relu(hidden))


def powers(
    params: TwoLayer, x: Float[Array, "*batch n dim"], mean: Float[Array, "*batch 1 dim"]
) -> Float[Array, "*batch n dim"]:
    """Return sign(x) (|x| + 1e-6)^p, with an exponent from 0 to 1 for each entry of the batch.

    The network computes the exponent p from the mean (SAGE, ICLR 2026).
    """
    exponent = jax.nn.sigmoid(two_layer(params, at_least_float32(mean), 0.0, None))
    wide = at_least_float32(x)
    return (jnp.sign(wide) * (jnp.abs(wide) + 1e-6) ** exponent).astype(x.dtype)
