"""Bag of queries: learnt queries that ask a transformer's layers (Ali-bey et al., CVPR 2024).

Layers and attentions are torch's: `nn.TransformerEncoderLayer` (post-norm, ReLU, feed-forward of
four times the width) and `nn.MultiheadAttention`.
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import require, require_positive
from crisalad_jax.nn import draw
from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, TokenShape
from crisalad_jax.nn.attention import (
    Attention,
    attention,
    cross_attention,
    init_torch_attention,
)
from crisalad_jax.nn.backbones.base import Backbone, FeatureRequest, Features
from crisalad_jax.nn.cross_image import NORM_EPSILON, EncoderLayer, init_encoder_layer
from crisalad_jax.nn.layers import (
    Conv,
    Keys,
    LayerNorm,
    Linear,
    at_least_float32,
    conv,
    init_conv,
    init_layer_norm,
    init_linear,
    layer_norm,
    linear,
)
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.pytree import pytree_dataclass


@pytree_dataclass
class BoqBlock:
    """An encoder layer over the patches, and queries that attend to each other, then to patches."""

    encoder: EncoderLayer
    queries: Float[Array, "query channel"]
    self_attn: Attention
    norm_q: LayerNorm
    cross_attn: Attention
    norm_out: LayerNorm


@pytree_dataclass
class Boq:
    """The channel reduction, the blocks in order, and the linear layer from answers to rows."""

    proj_c: Conv
    norm_input: LayerNorm
    boqs: tuple[BoqBlock, ...]
    fc: Linear


@AGGREGATORS.register("boq", tiny={"channels": 64, "queries": 16, "rows": 8})
@dataclasses.dataclass(frozen=True)
class BoqConfig(Aggregator):
    """Bag of queries (Ali-bey et al., CVPR 2024)."""

    dimension_first: ClassVar[bool] = True
    width_field: ClassVar[str] = "channels"
    channels: int = 384
    """Number of channels after the 3 x 3 convolution."""
    queries: int = 64
    """Number of learnt queries of a block."""
    layers: int = 2
    """Number of blocks, each an encoder layer and its queries."""
    rows: int = 32
    """Number of rows that a linear layer makes of all blocks' answers."""
    last_norm: bool = False
    """Whether patches go through the backbone's last layer norm. In the public code they do not."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "channels", "queries", "layers", "rows")
        require(
            self.channels % self.heads == 0,
            f"BoqConfig.channels: found {self.channels}, expected a multiple of its heads, "
            f"{self.heads}: one for every 64 channels",
        )

    @property
    def heads(self) -> int:
        """Number of heads of every attention, as the public code has them."""
        return max(1, self.channels // 64)

    def features(self, depth: int) -> FeatureRequest:
        """Request the last patches, by default as the last block leaves them."""
        return FeatureRequest(norm=self.last_norm)

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of one token for each row."""
        return TokenShape(0, self.rows, self.channels)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: tuple[int, int]) -> Boq:
        """Draw parameters as the public code: standard normal queries, the rest as torch's."""
        conv_key, blocks_key, rows_key = draw.split(key, 3)
        keys = draw.split(blocks_key, self.layers)
        return Boq(
            proj_c=init_conv(conv_key, 3, backbone.dim, self.channels),
            norm_input=init_layer_norm(self.channels),
            boqs=tuple(_init_block(block_key, self.channels, self.queries) for block_key in keys),
            fc=init_linear(rows_key, self.layers * self.queries, self.rows),
        )

    def apply(
        self, params: Boq, features: Features, grid: tuple[int, int], *, key: Keys | None
    ) -> Tokens:
        """Return a token of `channels` numbers for each row."""
        patches = features.patches
        maps = patches.reshape(-1, *grid, patches.shape[-1])
        maps = conv(params.proj_c, maps)
        x = maps.reshape(*patches.shape[:-1], maps.shape[-1])
        x = layer_norm(params.norm_input, x, epsilon=NORM_EPSILON)
        answers = []
        for block in params.boqs:
            x = encoder_layer(block.encoder, x, self.heads)
            answers.append(ask(block, x, self.heads))
        rows = linear(params.fc, jnp.concatenate(answers, axis=-2).swapaxes(-2, -1))
        return Tokens.of_local(at_least_float32(rows).swapaxes(-2, -1))


def _init_block(key: PRNGKeyArray, channels: int, queries: int) -> BoqBlock:
    layer_key, queries_key, *keys = draw.split(key, 6)
    return BoqBlock(
        encoder=init_encoder_layer(layer_key, channels, 4 * channels),
        queries=draw.normal(queries_key, (queries, channels)),
        self_attn=init_torch_attention(keys[0], keys[1], channels),
        norm_q=init_layer_norm(channels),
        cross_attn=init_torch_attention(keys[2], keys[3], channels),
        norm_out=init_layer_norm(channels),
    )


def encoder_layer(
    params: EncoderLayer, x: Float[Array, "*batch patch channel"], heads: int
) -> Float[Array, "*batch patch channel"]:
    """Apply self-attention of the patches and a ReLU network, with a layer norm after each."""
    attended = attention(params.attn, x, heads, key=None)
    x = layer_norm(params.norm1, x + attended, epsilon=NORM_EPSILON)
    update = linear(params.linear2, jax.nn.relu(linear(params.linear1, x)))
    return layer_norm(params.norm2, x + update, epsilon=NORM_EPSILON)


def ask(
    params: BoqBlock, x: Float[Array, "*batch patch channel"], heads: int
) -> Float[Array, "*batch query channel"]:
    """Attend from the queries to the patches, and normalise the answers.

    The queries' self-attention does not depend on the image: it runs once for a whole batch.
    """
    queries = params.queries.astype(x.dtype)
    queries = queries + attention(params.self_attn, queries, heads, key=None)
    queries = layer_norm(params.norm_q, queries, epsilon=NORM_EPSILON)
    answers = cross_attention(params.cross_attn, queries, x, heads)
    return layer_norm(params.norm_out, answers, epsilon=NORM_EPSILON)
