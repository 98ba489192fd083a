"""The adapters beside a block's MLP: the paper's (section 3.2), and its Table 2's two others.

All narrow the tokens, act on them, and widen them again with a projection that starts at 0, so that
an untrained adapter changes nothing.
"""

import functools

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config import ViTConfig
from crisalad_jax.nn.layers import (
    BatchNorm,
    Conv,
    DepthwiseConv,
    Linear,
    batch_norm,
    conv,
    depthwise_conv,
    init_batch_norm,
    init_conv,
    init_depthwise_conv,
    init_linear,
    linear,
)
from crisalad_jax.pytree import params

BATCH_NORM_EPSILON = 1e-3


@params
class DepthwiseAdapter:
    """741,504 parameters at the paper's width, its Table 3: the two linears carry no bias."""

    down: Linear
    depthwise: DepthwiseConv
    pointwise: Linear
    up: Linear


@params
class ConvNorm:
    """A convolution and the batch norm after it."""

    conv: Conv
    norm: BatchNorm


@params
class MultiResolutionAdapter:
    """CricaVPR's: convolutions of 1 x 1, 3 x 3 and 5 x 5 side by side, the last two narrowed."""

    down: Linear
    branch1: ConvNorm
    branch2: tuple[ConvNorm, ConvNorm]
    branch3: tuple[ConvNorm, ConvNorm]
    up: Linear


@params
class MlpAdapter:
    """No look at the neighbours at all."""

    down: Linear
    up: Linear


Adapter = DepthwiseAdapter | MultiResolutionAdapter | MlpAdapter


def init_adapter(key: PRNGKeyArray, config: ViTConfig) -> Adapter | None:
    """Random parameters of `config.adapter.kind`, the up-projection at 0; None for "none"."""
    kind, width = config.adapter.kind, config.adapter_dim
    if kind == "none":
        return None
    down_key, first, second, up_key = jax.random.split(key, 4)
    bias = kind != "depthwise"
    down = init_linear(down_key, config.dim, width, bias=bias)
    up = jax.tree.map(jnp.zeros_like, init_linear(up_key, width, config.dim, bias=bias))
    if kind == "mlp":
        return MlpAdapter(down, up)
    if kind == "depthwise":
        return DepthwiseAdapter(
            down=down,
            depthwise=init_depthwise_conv(first, config.adapter.kernel_size, width),
            pointwise=init_linear(second, width, width),
            up=up,
        )
    keys = jax.random.split(first, 5)
    half, quarter, narrow = width // 2, width // 4, width // 16
    return MultiResolutionAdapter(
        down=down,
        branch1=_init_conv_norm(keys[0], 1, width, half),
        branch2=(
            _init_conv_norm(keys[1], 1, width, narrow),
            _init_conv_norm(keys[2], 3, narrow, quarter),
        ),
        branch3=(
            _init_conv_norm(keys[3], 1, width, narrow),
            _init_conv_norm(keys[4], 5, narrow, quarter),
        ),
        up=up,
    )


def _init_conv_norm(key: PRNGKeyArray, kernel_size: int, d_in: int, d_out: int) -> ConvNorm:
    return ConvNorm(init_conv(key, kernel_size, d_in, d_out), init_batch_norm(d_out))


def adapter(
    params: Adapter, tokens: Float[Array, "*batch token dim"], grid: tuple[int, int]
) -> Float[Array, "*batch token dim"]:
    """Down, ReLU, convolutions on the patch grid plus skip, up (Adapter of paper Eq. 2).

    The last `grid[0] * grid[1]` tokens are patches in row order. The class and register tokens
    before them take no part in the convolutions, which act on them as the identity, so with the
    skip they count twice, as in CricaVPR. The MLP adapter has neither convolutions nor skip.
    """
    hidden = jax.nn.relu(checkpoint_name(linear(params.down, tokens), "down"))
    if isinstance(params, MlpAdapter):
        return linear(params.up, hidden)
    *batch, count, width = hidden.shape
    special = count - grid[0] * grid[1]
    patches = hidden[..., special:, :].reshape(-1, *grid, width)
    if isinstance(params, DepthwiseAdapter):
        mixed = _separable(params, patches)
    else:
        mixed = jax.vmap(functools.partial(_multi_resolution, params))(patches)
    mixed = mixed.reshape(*batch, grid[0] * grid[1], width)
    branch = jnp.concatenate([hidden[..., :special, :], mixed], axis=-2)
    return linear(params.up, branch + hidden)


def _separable(
    params: DepthwiseAdapter, x: Float[Array, "image height width dim"]
) -> Float[Array, "image height width dim"]:
    # No activation between the two convolutions, as in Xception.
    filtered = jax.vmap(functools.partial(depthwise_conv, params.depthwise))(x)
    return jax.nn.relu(checkpoint_name(linear(params.pointwise, filtered), "mixed"))


def _multi_resolution(
    params: MultiResolutionAdapter, x: Float[Array, "height width dim"]
) -> Float[Array, "height width dim"]:
    branches = (params.branch1,), params.branch2, params.branch3
    outputs = []
    for branch in branches:
        y = x
        for one in branch:
            y = batch_norm(one.norm, conv(one.conv, y), epsilon=BATCH_NORM_EPSILON)
            y = jax.nn.relu(y)
        outputs.append(y)
    return jnp.concatenate(outputs, axis=-1)
