"""The depthwise-separable convolution adapter (paper section 3.2), after Xception and CricaVPR."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config import ViTConfig
from crisalad_jax.nn.layers import (
    DepthwiseConv,
    Linear,
    depthwise_conv,
    init_depthwise_conv,
    init_linear,
    linear,
)
from crisalad_jax.pytree import params


@params
class Adapter:
    """741,504 parameters at the paper's width, its Table 3: the two linears carry no bias."""

    down: Linear
    depthwise: DepthwiseConv
    pointwise: Linear
    up: Linear


def init_adapter(key: PRNGKeyArray, config: ViTConfig) -> Adapter:
    """Start with the up-projection at 0, so that an untrained adapter changes nothing."""
    width = config.adapter_dim
    down, depthwise, pointwise, up = jax.random.split(key, 4)
    up_projection = init_linear(up, width, config.dim, bias=False)
    return Adapter(
        down=init_linear(down, config.dim, width, bias=False),
        depthwise=init_depthwise_conv(depthwise, config.adapter.kernel_size, width),
        pointwise=init_linear(pointwise, width, width),
        up=jax.tree.map(jnp.zeros_like, up_projection),
    )


def adapter(
    params: Adapter, tokens: Float[Array, "token dim"], grid: tuple[int, int]
) -> Float[Array, "token dim"]:
    """Down, ReLU, separable convolution on the patch grid plus skip, up (Adapter of paper Eq. 2).

    The last `grid[0] * grid[1]` tokens are patches in row order. The class and register tokens
    before them take no part in the convolution: it acts on them as the identity, so with the skip
    they count twice, as in CricaVPR.
    """
    hidden = jax.nn.relu(linear(params.down, tokens))
    special = tokens.shape[0] - grid[0] * grid[1]
    patches = hidden[special:].reshape(*grid, -1)
    # No activation between the two convolutions, as in Xception.
    mixed = linear(params.pointwise, depthwise_conv(params.depthwise, patches))
    mixed = jax.nn.relu(mixed).reshape(grid[0] * grid[1], -1)
    branch = jnp.concatenate([hidden[:special], mixed])
    return linear(params.up, branch + hidden)
