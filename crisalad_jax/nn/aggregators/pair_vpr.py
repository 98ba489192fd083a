"""Pair-VPR (Hausler and Moghadam, RA-L 2025): a projected class token, and a decoder for pairs.

Written from the papers: the decoder is that of CroCo (Weinzaepfel et al., NeurIPS 2022).
"""

import functools
import math
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import PositiveInt, require_field
from crisalad_jax.nn import random_init
from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, TokenShape
from crisalad_jax.nn.attention import Attention, attention, cross_attention, init_torch_attention
from crisalad_jax.nn.backbones.base import Backbone, Features, Grid, Patches
from crisalad_jax.nn.backbones.vit import NORM_EPSILON, bicubic_weights, resize_grid
from crisalad_jax.nn.layers import (
    Keys,
    LayerNorm,
    Linear,
    TwoLayer,
    at_least_float32,
    gelu,
    init_layer_norm,
    init_linear,
    init_two_layer,
    layer_norm,
    linear,
    two_layer,
)
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.pytree import pytree_dataclass

_norm = functools.partial(layer_norm, epsilon=NORM_EPSILON)


@pytree_dataclass
class PairLayer:
    """Self-attention in the first image, cross-attention to the second image, and an MLP."""

    norm1: LayerNorm
    attn: Attention
    cross_attn: Attention
    norm2: LayerNorm
    norm3: LayerNorm
    mlp: TwoLayer
    norm_other: LayerNorm
    """Layer norm of the second image's tokens; the decoder does not update these tokens."""


@pytree_dataclass
class PairVpr:
    """Parameters of the descriptor's layer (`reduction`) and of the decoder, which scores pairs."""

    cls_token: Float[Array, " width"]
    """Class token of the decoder; its output gives the logit of a pair."""
    positions: Float[Array, "position width"]
    """Position embeddings of a square grid of patches, in row order; the class token has none."""
    embed: Linear
    layers: tuple[PairLayer, ...]
    norm: LayerNorm
    score: TwoLayer
    reduction: Linear


@AGGREGATORS.register(
    "pair-vpr", tiny={"dim": 64, "width": 64, "layers": 2, "hidden": 32, "positions": 49}
)
class PairVprConfig(Aggregator):
    """Pair-VPR's descriptor, and the decoder that re-ranks (Hausler and Moghadam, RA-L 2025).

    Example:
        >>> from crisalad_jax import ModelConfig
        >>> ModelConfig(aggregator=PairVprConfig(), cross_image="none").descriptor_dim
        512
    """

    class_token: ClassVar[bool] = True
    dim: PositiveInt = 512
    """Width of the descriptor."""
    width: PositiveInt = 768
    """Width of a token in the decoder."""
    layers: PositiveInt = 12
    """Number of decoder layers."""
    hidden: PositiveInt = 512
    """Hidden width of the network that computes the logit of a pair."""
    positions: PositiveInt = 529
    """Number of position embeddings, a square: 529 is 23 x 23, for images of 322 x 322 pixels."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        words = f"a multiple of its {self.heads} heads, one for every 64 dimensions"
        require_field(self, "width", self.width % self.heads == 0, words)
        square = math.isqrt(self.positions) ** 2 == self.positions
        require_field(self, "positions", square, "a square number")

    @property
    def heads(self) -> int:
        """Number of attention heads in every decoder layer: one for every 64 dimensions."""
        return max(1, self.width // 64)

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of a global token of width `self.dim`, without local tokens."""
        return TokenShape(self.dim, 0, self.dim)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> PairVpr:
        """Draw layers like torch, and class token and positions with standard deviation 0.02."""
        keys = random_init.split(key, 6)
        normal = functools.partial(random_init.normal, scale=0.02)
        return PairVpr(
            cls_token=normal(keys[0], (self.width,)),
            positions=normal(keys[1], (self.positions, self.width)),
            embed=init_linear(keys[2], backbone.dim, self.width),
            layers=tuple(map(self._init_layer, random_init.split(keys[3], self.layers))),
            norm=init_layer_norm(self.width),
            score=init_two_layer(keys[4], self.width, self.hidden, 1),
            reduction=init_linear(keys[5], backbone.dim, self.dim),
        )

    def _init_layer(self, key: PRNGKeyArray) -> PairLayer:
        width, keys = self.width, random_init.split(key, 5)
        return PairLayer(
            norm1=init_layer_norm(width),
            attn=init_torch_attention(keys[0], keys[1], width),
            cross_attn=init_torch_attention(keys[2], keys[3], width),
            norm2=init_layer_norm(width),
            norm3=init_layer_norm(width),
            mlp=init_two_layer(keys[4], width, 4 * width, width),
            norm_other=init_layer_norm(width),
        )

    def apply(self, params: PairVpr, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Return the projected class token, not normalised, without local tokens."""
        return Tokens.of_global(at_least_float32(linear(params.reduction, features.class_token)))

    def logits(
        self, params: PairVpr, first: Patches, second: Patches, grid: Grid
    ) -> Float[Array, "*batch"]:
        """Compute a logit for each ordered pair of images: how likely both show the same place.

        Args:
            params: from `init`.
            first: patches of the first image of each pair, from the backbone's last layer norm.
            second: the same for the second images, to which the first images attend.
            grid: rows and columns of patches, the same for all images.
        """
        x, other = (self.with_positions(params, each, grid) for each in (first, second))
        x = self.with_class_token(params, x)
        for layer in params.layers:
            x = self.decode(layer, x, other)
        logit = two_layer(params.score, _norm(params.norm, x[..., 0, :]), 0.0, None)
        return at_least_float32(logit)[..., 0]

    def with_positions(
        self, params: PairVpr, patches: Patches, grid: Grid
    ) -> Float[Array, "*batch patch width"]:
        """Embed patches for the decoder, and add positions resized by torch's bicubic filter."""
        side = math.isqrt(self.positions)
        positions = params.positions.reshape(side, side, self.width)
        weights = functools.partial(bicubic_weights, more=0.0)
        placed = resize_grid(positions, grid, weights).reshape(-1, self.width)
        embedded = linear(params.embed, patches)
        return (at_least_float32(embedded) + placed).astype(embedded.dtype)

    def with_class_token(
        self, params: PairVpr, x: Float[Array, "*batch patch width"]
    ) -> Float[Array, "*batch token width"]:
        """Prepend the decoder's class token to the embedded patches."""
        token = jnp.broadcast_to(params.cls_token, (*x.shape[:-2], 1, self.width))
        return jnp.concatenate([token.astype(x.dtype), x], axis=-2)

    def decode(
        self,
        layer: PairLayer,
        x: Float[Array, "*batch token width"],
        other: Float[Array, "*batch patch width"],
    ) -> Float[Array, "*batch token width"]:
        """Apply one layer to the first images' tokens `x`; `other` are tokens of the second."""
        x = x + attention(layer.attn, _norm(layer.norm1, x), self.heads)
        memory = _norm(layer.norm_other, other)
        x = x + cross_attention(layer.cross_attn, _norm(layer.norm2, x), memory, self.heads)
        hidden = gelu(linear(layer.mlp.fc1, _norm(layer.norm3, x)))
        return x + linear(layer.mlp.fc2, hidden)
