"""The adapters of a block: the paper's (section 3.2), two others of its Table 2, and more.

All project the tokens down, act on them, and project them up again. The up-projection starts at 0,
so that an untrained adapter adds nothing. All but EDTformer's are parallel to the block's MLP;
SelaVPR has a second one after the attention.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import PositiveFloat, PositiveInt, check_types, require_field
from crisalad_jax.config.short_repr import short_repr
from crisalad_jax.nn import random_init
from crisalad_jax.nn.convolutions import ConvNorm, Map, conv_norm
from crisalad_jax.nn.layers import (
    Conv,
    DepthwiseConv,
    Grid,
    Linear,
    Valid,
    depthwise_conv,
    init_batch_norm,
    init_depthwise_conv,
    init_linear,
    linear,
)
from crisalad_jax.utils.pytree import pytree_dataclass

BATCH_NORM_EPSILON = 1e-3
CONV_INIT = 1e-5
"""Initial value of all weights and biases of CricaVPR's convolutions."""


@short_repr(switch=("kind", "none"))
@dataclasses.dataclass(frozen=True)
class AdapterConfig:
    """The adapter of every block (paper section 3.2 and Table 2).

    Example:
        >>> AdapterConfig(kind="none").kind
        'none'
    """

    kind: Literal["depthwise", "multi-resolution", "mlp", "serial-parallel", "side", "none"] = (
        "depthwise"
    )
    """Kind of adapter: the paper's depthwise-separable convolution, CricaVPR's multi-resolution
    one, or a plain MLP; SelaVPR's plain MLPs, one after the attention and one parallel to the MLP;
    or EDTformer's, on a path of their own, parallel to all blocks (side); none leaves it out."""
    bottleneck: PositiveFloat = 0.5
    """Width of the adapter over the width of the backbone."""
    kernel_size: PositiveInt = 3
    """Side of the depthwise filter."""
    alpha: float = 0.2
    """Weight of the adapter's output (paper Eq. 2); a serial one has weight 1."""
    bias: Literal["convolutions", "up"] = "convolutions"
    """Layers of the depthwise adapter that have biases: its two convolutions, or the up-projection.
    The paper prints the count of parameters alone (Table 3), which is 741,504 in both readings."""

    def __post_init__(self) -> None:
        """Check the fields."""
        check_types(self)
        require_field(self, "kernel_size", self.kernel_size % 2 == 1, "an odd number")

    def width(self, dim: int) -> int:
        """Return the width of the bottleneck of an adapter in a backbone of width `dim`.

        Raises:
            InputError: it is 0, or does not divide into the branches of the adapter.
        """
        width = int(dim * self.bottleneck)
        # The branches of a multi-resolution adapter take 1/2, 1/4 and 1/16 of the width.
        factor = 16 if self.kind == "multi-resolution" else 1
        fits = self.kind == "none" or (width >= 1 and width % factor == 0)
        words = f"a width for dim {dim}, {width}, that is at least 1 and a multiple of {factor}"
        require_field(self, "bottleneck", fits, words)
        return width


@pytree_dataclass
class DepthwiseAdapter:
    """The paper's adapter, whose down-projection has no bias: 741,504 parameters (Table 3)."""

    down: Linear
    depthwise: DepthwiseConv
    pointwise: Linear
    up: Linear


@pytree_dataclass
class MultiResolutionAdapter:
    """CricaVPR's adapter: parallel 1 x 1, 3 x 3 and 5 x 5 convolutions, the last two reduced."""

    down: Linear
    branch1: ConvNorm
    branch2: tuple[ConvNorm, ConvNorm]
    branch3: tuple[ConvNorm, ConvNorm]
    up: Linear


@pytree_dataclass
class MlpAdapter:
    """A plain MLP, which acts on every token alone; EDTformer's has GELU (Jin et al. 2025)."""

    down: Linear
    up: Linear


@pytree_dataclass
class SerialParallelAdapter:
    """SelaVPR's adapters (Lu et al. 2024): after the attention with a skip, parallel to the MLP."""

    serial: MlpAdapter
    parallel: MlpAdapter


SingleAdapter = DepthwiseAdapter | MultiResolutionAdapter | MlpAdapter
Adapter = SingleAdapter | SerialParallelAdapter


def init_adapter(key: PRNGKeyArray, dim: int, config: AdapterConfig) -> Adapter | None:
    """Draw random parameters for a backbone of width `dim`; None for "none".

    The up-projection starts at 0, the convolutions of the multi-resolution adapter at 1e-5, as in
    the public code of CricaVPR.
    """
    kind, width = config.kind, config.width(dim)
    if kind == "none":
        return None
    if kind == "serial-parallel":
        return SerialParallelAdapter(*(_init_mlp(k, dim, width) for k in random_init.split(key)))
    if kind in ("mlp", "side"):
        return _init_mlp(key, dim, width)
    down_key, first, second = random_init.split(key, 3)
    if kind == "depthwise":
        convolutions = config.bias == "convolutions"
        return DepthwiseAdapter(
            down=init_linear(down_key, dim, width, bias=False),
            depthwise=init_depthwise_conv(first, config.kernel_size, width, bias=convolutions),
            pointwise=init_linear(second, width, width, bias=convolutions),
            up=_init_up(width, dim, bias=not convolutions),
        )
    half, quarter, narrow = width // 2, width // 4, width // 16
    return MultiResolutionAdapter(
        down=init_linear(down_key, dim, width),
        branch1=_init_conv_norm(1, width, half),
        branch2=(_init_conv_norm(1, width, narrow), _init_conv_norm(3, narrow, quarter)),
        branch3=(_init_conv_norm(1, width, narrow), _init_conv_norm(5, narrow, quarter)),
        up=_init_up(width, dim),
    )


def _init_mlp(key: PRNGKeyArray, dim: int, width: int) -> MlpAdapter:
    return MlpAdapter(init_linear(random_init.split(key)[0], dim, width), _init_up(width, dim))


def _init_up(width: int, dim: int, *, bias: bool = True) -> Linear:
    return Linear(random_init.zeros(width, dim), random_init.zeros(dim) if bias else None)


def _init_conv_norm(kernel_size: int, d_in: int, d_out: int) -> ConvNorm:
    weight = random_init.full((kernel_size, kernel_size, d_in, d_out), CONV_INIT)
    return ConvNorm(Conv(weight, random_init.full((d_out,), CONV_INIT)), init_batch_norm(d_out))


def adapter(
    params: SingleAdapter,
    tokens: Float[Array, "*batch token dim"],
    grid: Grid,
    *,
    length: int | None = None,
    valid: Valid = None,
    activation: Callable[[Array], Array] = jax.nn.relu,
) -> tuple[Float[Array, "*batch token dim"], SingleAdapter]:
    """Apply an adapter: down, ReLU, convolutions on the patch grid plus skip, up (paper Eq. 2).

    The last `grid[0] * grid[1]` of the first `length` tokens are patches in row order. The
    convolutions are the identity on the class and register tokens before them. With the skip these
    tokens therefore count twice, as in CricaVPR. A plain MLP has neither convolutions nor skip.

    Args:
        params: the adapter.
        tokens: of an image or a batch.
        grid: rows and columns of patches.
        length: number of first tokens that are not padding; None is all.
        valid: images of a training batch whose statistics batch norms normalise by; None takes the
            stored ones, which stay.
        activation: after the projection down.

    Returns:
        (tokens, updated): the adapter's output, and the adapter with updated running statistics.
    """
    hidden = activation(checkpoint_name(linear(params.down, tokens), "down"))
    if isinstance(params, MlpAdapter):
        return linear(params.up, hidden), params
    *batch, count, width = hidden.shape
    last = count if length is None else length
    special = last - grid[0] * grid[1]
    patches = hidden[..., special:last, :].reshape(-1, *grid, width)
    if isinstance(params, DepthwiseAdapter):
        mixed = _separable(params, patches)
    else:
        mixed, params = _multi_resolution(params, patches, valid)
    mixed = mixed.reshape(*batch, grid[0] * grid[1], width)
    parts = [hidden[..., :special, :], mixed]
    if last < count:
        parts.append(hidden[..., last:, :])
    branch = jnp.concatenate(parts, axis=-2)
    return linear(params.up, branch + hidden), params


def _separable(params: DepthwiseAdapter, x: Map) -> Map:
    # No activation between the two convolutions, as in Xception.
    filtered = jax.vmap(functools.partial(depthwise_conv, params.depthwise))(x)
    return jax.nn.relu(checkpoint_name(linear(params.pointwise, filtered), "mixed"))


def _multi_resolution(
    params: MultiResolutionAdapter, x: Map, valid: Valid
) -> tuple[Map, MultiResolutionAdapter]:
    outputs, updated = [], []
    for branch in ((params.branch1,), params.branch2, params.branch3):
        y, layers = x, []
        for layer in branch:
            y, layer = conv_norm(layer, y, valid, epsilon=BATCH_NORM_EPSILON)
            y = jax.nn.relu(y)
            layers.append(layer)
        outputs.append(y)
        updated.append(tuple(layers))
    (first,), second, third = updated
    params = dataclasses.replace(params, branch1=first, branch2=second, branch3=third)
    return jnp.concatenate(outputs, axis=-1), params
