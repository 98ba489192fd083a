"""Bottleneck adapters: the paper's (section 3.2), two others from its Table 2, and more.

All of them project the tokens down, transform them, and project them up again. The up-projection
starts at 0, so an untrained adapter adds nothing.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import PositiveFloat, PositiveInt, require_field
from crisalad_jax.nn import random_init
from crisalad_jax.nn.adapters.base import ADAPTERS, Adapter, AnyTokens, BlockShape, TokenInfo
from crisalad_jax.nn.convolutions import ConvNorm, Map, conv_norm
from crisalad_jax.nn.layers import (
    Conv,
    DepthwiseConv,
    Linear,
    Valid,
    at_least_float32,
    depthwise_conv,
    gelu,
    init_batch_norm,
    init_depthwise_conv,
    init_linear,
    linear,
)
from crisalad_jax.nn.products import keep
from crisalad_jax.utils.pytree import pytree_dataclass

BATCH_NORM_EPSILON = 1e-3
CONV_INIT = 1e-5
"""Initial value of all weights and biases of CricaVPR's convolutions."""


@pytree_dataclass
class DepthwiseAdapter:
    """Parameters of the paper's adapter, without a bias of `down`: 741,504 in ViT-B (Table 3)."""

    down: Linear
    depthwise: DepthwiseConv
    pointwise: Linear
    up: Linear


@pytree_dataclass
class MultiResolutionAdapter:
    """CricaVPR's parallel convolutions: 1 x 1, and 3 x 3 and 5 x 5 after a 1 x 1 reduction."""

    down: Linear
    branch1: ConvNorm
    branch2: tuple[ConvNorm, ConvNorm]
    branch3: tuple[ConvNorm, ConvNorm]
    up: Linear


@pytree_dataclass
class MlpAdapter:
    """A plain MLP applied to each token independently; EDTformer's has GELU (Jin et al. 2025)."""

    down: Linear
    up: Linear


@pytree_dataclass
class SerialParallelAdapter:
    """SelaVPR's MLPs (Lu et al. 2024): after the attention (with a skip), parallel to the MLP."""

    serial: MlpAdapter
    parallel: MlpAdapter


@ADAPTERS.register("none")
class NoAdapter(Adapter):
    """No adapter: the backbone runs as it is."""

    def init(self, key: PRNGKeyArray, shape: BlockShape) -> None:
        """Return None: there are no parameters."""

    def merge(self, params: None, name: str, layer: Linear) -> Linear:
        """Return the layer unchanged."""
        return layer


@dataclasses.dataclass(frozen=True)
class BottleneckAdapter(Adapter):
    """Base class of bottleneck adapters."""

    width_factor: ClassVar[int] = 1
    """The width of the bottleneck must be a multiple of this number."""
    bottleneck: PositiveFloat = 0.5
    """Width of the bottleneck divided by the width of the backbone."""
    alpha: float = 0.2
    """Weight of the adapter's output (paper Eq. 2)."""

    def check(self, shape: BlockShape) -> None:
        """Require a width of at least 1 that divides evenly among the adapter's branches."""
        width, factor = self.width(shape.dim), self.width_factor
        words = (
            f"a width for dim {shape.dim}, {width}, that is at least 1 and a multiple of {factor}"
        )
        require_field(self, "bottleneck", width >= 1 and width % factor == 0, words)

    def width(self, dim: int) -> int:
        """Return the width of the bottleneck in a backbone of width `dim`."""
        return int(dim * self.bottleneck)


@ADAPTERS.register("depthwise")
class DepthwiseConfig(BottleneckAdapter):
    """The paper's depthwise-separable convolution, parallel to the MLP (section 3.2)."""

    kernel_size: PositiveInt = 3
    """Side of the depthwise filter in patches, an odd number."""
    bias: Literal["convolutions", "up"] = "convolutions"
    """Layers that have biases: the two convolutions, or the up-projection. The paper gives only the
    number of parameters (Table 3), which is 741,504 in either case."""

    def __post_init__(self) -> None:
        """Check the side of the filter."""
        require_field(self, "kernel_size", self.kernel_size % 2 == 1, "an odd number")

    def init(self, key: PRNGKeyArray, shape: BlockShape) -> DepthwiseAdapter:
        """Draw parameters as torch initialises them, and set the up-projection to 0."""
        width, convolutions = self.width(shape.dim), self.bias == "convolutions"
        down, first, second = random_init.split(key, 3)
        return DepthwiseAdapter(
            down=init_linear(down, shape.dim, width, bias=False),
            depthwise=init_depthwise_conv(first, self.kernel_size, width, bias=convolutions),
            pointwise=init_linear(second, width, width, bias=convolutions),
            up=_init_up(width, shape.dim, bias=not convolutions),
        )

    def mlp_update(
        self, params: DepthwiseAdapter, tokens: AnyTokens, info: TokenInfo
    ) -> tuple[AnyTokens, DepthwiseAdapter]:
        """Project down, ReLU, convolve patches, add the skip, project up, scale (paper Eq. 2)."""
        hidden = _project_down(params.down, tokens)
        mixed, _ = _on_patches(lambda x: (_separable(params, x), None), hidden, info)
        return self.alpha * linear(params.up, mixed + hidden), params


@ADAPTERS.register("multi-resolution")
class MultiResolutionConfig(BottleneckAdapter):
    """CricaVPR's multi-resolution convolutions, parallel to the MLP (Lu et al., CVPR 2024)."""

    width_factor: ClassVar[int] = 16  # the branches take 1/2, 1/4 and 1/16 of the width

    def init(self, key: PRNGKeyArray, shape: BlockShape) -> MultiResolutionAdapter:
        """Draw parameters as CricaVPR's public code does: convolutions start at 1e-5."""
        return _init_multi_resolution(key, shape.dim, self.width(shape.dim))

    def mlp_update(
        self, params: MultiResolutionAdapter, tokens: AnyTokens, info: TokenInfo
    ) -> tuple[AnyTokens, MultiResolutionAdapter]:
        """Project down, ReLU, convolve the patches, add the skip, project up, scale by alpha."""
        update, updated = _multi_resolution(params, tokens, info)
        return self.alpha * update, updated


@ADAPTERS.register("mlp")
class MlpConfig(BottleneckAdapter):
    """A ReLU MLP, parallel to the block's MLP (AdaptFormer: Chen et al., NeurIPS 2022)."""

    def init(self, key: PRNGKeyArray, shape: BlockShape) -> MlpAdapter:
        """Draw the down-projection as torch does, and set the up-projection to 0."""
        return _init_mlp(key, shape.dim, self.width(shape.dim))

    def mlp_update(
        self, params: MlpAdapter, tokens: AnyTokens, info: TokenInfo
    ) -> tuple[AnyTokens, MlpAdapter]:
        """Return alpha times the output of the MLP, applied to each token independently."""
        return self.alpha * _mlp(params, tokens), params


@ADAPTERS.register("serial-parallel")
class SerialParallelConfig(BottleneckAdapter):
    """SelaVPR's MLPs (ICLR 2024): after the attention with weight 1, and parallel to the MLP."""

    def init(self, key: PRNGKeyArray, shape: BlockShape) -> SerialParallelAdapter:
        """Draw both MLPs as `MlpConfig` does."""
        dim, width = shape.dim, self.width(shape.dim)
        return SerialParallelAdapter(*(_init_mlp(k, dim, width) for k in random_init.split(key)))

    def attention_update(
        self, params: SerialParallelAdapter, attended: AnyTokens, info: TokenInfo
    ) -> AnyTokens:
        """Return the output of the serial MLP; the block adds the MLP's input (the skip)."""
        return _mlp(params.serial, attended)

    def mlp_update(
        self, params: SerialParallelAdapter, tokens: AnyTokens, info: TokenInfo
    ) -> tuple[AnyTokens, SerialParallelAdapter]:
        """Return alpha times the output of the parallel MLP."""
        return self.alpha * _mlp(params.parallel, tokens), params


@ADAPTERS.register("side")
class SideConfig(BottleneckAdapter):
    """EDTformer's MLPs with GELU, on a side path along all blocks (Jin et al. 2025).

    After each block the tokens of the path become s + alpha MLP(s), where s is the sum of these
    tokens and the block's output. No gradient passes through the blocks.
    """

    def init(self, key: PRNGKeyArray, shape: BlockShape) -> MlpAdapter:
        """Draw parameters as `MlpConfig` does."""
        return _init_mlp(key, shape.dim, self.width(shape.dim))

    def side_path(
        self, params: MlpAdapter, side: AnyTokens, tokens: AnyTokens, info: TokenInfo
    ) -> tuple[AnyTokens, MlpAdapter]:
        """Return s + alpha MLP(s) for s, the path's tokens plus the block's output."""
        total = tokens + side
        return _sum(total, self.alpha, _mlp(params, total, gelu)), params


@ADAPTERS.register("side-multi-resolution")
class SideMultiResolutionConfig(BottleneckAdapter):
    """SelaVPR++'s adapters: CricaVPR's convolutions on side paths (Lu et al. 2025).

    After each block the tokens s of a path become s + alpha A(s + x), where x is the output of the
    block and A the unscaled `multi-resolution` adapter. No gradient passes through the blocks.
    """

    width_factor: ClassVar[int] = MultiResolutionConfig.width_factor
    alpha: float = 1.0
    """Weight of the adapter's output."""
    last: PositiveInt | None = None
    """Number of final blocks that have the adapter; None means all. SelaVPR++'s ViT-L has 16."""
    paths: PositiveInt = 1
    """Number of side paths: 2 if the second is for binary descriptors."""

    def init(self, key: PRNGKeyArray, shape: BlockShape) -> Any:
        """Draw parameters as `MultiResolutionConfig` does, the same for each path."""
        one = _init_multi_resolution(key, shape.dim, self.width(shape.dim))
        return one if self.paths == 1 else (one,) * self.paths

    def side_path(
        self, params: MultiResolutionAdapter, side: AnyTokens, tokens: AnyTokens, info: TokenInfo
    ) -> tuple[AnyTokens, MultiResolutionAdapter]:
        """Return s + alpha A(s + x) for the path's tokens s and the block's output x."""
        update, updated = _multi_resolution(params, tokens + side, info)
        return _sum(side, self.alpha, update), updated


def _sum(tokens: AnyTokens, alpha: float, update: AnyTokens) -> AnyTokens:
    total = at_least_float32(tokens) + alpha * at_least_float32(update)
    return total.astype(tokens.dtype)


def _init_multi_resolution(key: PRNGKeyArray, dim: int, width: int) -> MultiResolutionAdapter:
    half, quarter, narrow = width // 2, width // 4, width // 16
    return MultiResolutionAdapter(
        down=init_linear(random_init.split(key, 3)[0], dim, width),
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


def _project_down(
    params: Linear, tokens: AnyTokens, activation: Callable[[Array], Array] = jax.nn.relu
) -> Float[Array, "*batch token width"]:
    return activation(keep(linear(params, tokens), "down"))


def _mlp(
    params: MlpAdapter, tokens: AnyTokens, activation: Callable[[Array], Array] = jax.nn.relu
) -> AnyTokens:
    return linear(params.up, _project_down(params.down, tokens, activation))


def _on_patches(
    mix: Callable[[Map], tuple[Map, Any]], hidden: AnyTokens, info: TokenInfo
) -> tuple[AnyTokens, Any]:
    """Apply a convolution to the patches; return the tokens and its other result.

    The class and register tokens before the patches, and padding, pass through unchanged. With the
    skip that follows, these tokens therefore count twice, as in CricaVPR.
    """
    *batch, count, width = hidden.shape
    last = count if info.length is None else info.length
    special = last - math.prod(info.grid)
    patches = hidden[..., special:last, :].reshape(-1, *info.grid, width)
    mixed, more = mix(patches)
    mixed = mixed.reshape(*batch, last - special, width)
    parts = [hidden[..., :special, :], mixed]
    if last < count:
        parts.append(hidden[..., last:, :])
    return jnp.concatenate(parts, axis=-2), more


def _separable(params: DepthwiseAdapter, x: Map) -> Map:
    # No activation between the two convolutions, as in Xception.
    filtered = jax.vmap(functools.partial(depthwise_conv, params.depthwise))(x)
    return jax.nn.relu(keep(linear(params.pointwise, filtered), "mixed"))


def _multi_resolution(
    params: MultiResolutionAdapter, tokens: AnyTokens, info: TokenInfo
) -> tuple[AnyTokens, MultiResolutionAdapter]:
    """Project down, ReLU, convolve the patches, add the skip, project up."""
    hidden = _project_down(params.down, tokens)
    mix = functools.partial(_branches, params, valid=info.valid)
    mixed, updated = _on_patches(mix, hidden, info)
    return linear(params.up, mixed + hidden), updated


def _branches(
    params: MultiResolutionAdapter, x: Map, *, valid: Valid
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
