"""Learnt queries that attend to features in transformer layers: BoQ and EDTformer.

Attention is torch's `nn.MultiheadAttention`. Encoder layers are `nn.TransformerEncoderLayer` with
ReLU, post-norm and a feed-forward network of four times the width.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import PositiveInt, require_field
from crisalad_jax.nn import random_init
from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, FlattenOrder, TokenShape
from crisalad_jax.nn.attention import Attention, attention, cross_attention, init_torch_attention
from crisalad_jax.nn.backbones.base import Backbone, Features, FeatureSpec, Grid
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
from crisalad_jax.nn.torch_layers import (
    EncoderLayer,
    encoder_layer,
    init_encoder_layer,
)
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
    """Parameters of BoQ: channel reduction, blocks in order, and the linear layer over queries."""

    proj_c: Conv
    norm_input: LayerNorm
    boqs: tuple[BoqBlock, ...]
    fc: Linear


@AGGREGATORS.register("boq", tiny={"channels": 64, "queries": 16, "rows": 8})
class BoqConfig(Aggregator):
    """Bag of queries (BoQ; Ali-bey et al., CVPR 2024)."""

    flatten_order: ClassVar[FlattenOrder] = "dimension-first"
    channels: PositiveInt = 384
    """Number of channels after the 3 x 3 convolution."""
    queries: PositiveInt = 64
    """Number of learnt queries per block."""
    layers: PositiveInt = 2
    """Number of blocks, each an encoder layer and its queries."""
    rows: PositiveInt = 32
    """Number of local tokens (rows) that a linear layer computes from all query outputs."""
    last_norm: bool = False
    """Whether the backbone's last layer norm is applied. In the public code it is not."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        words = f"a multiple of its {self.heads} heads, one for every 64 channels"
        require_field(self, "channels", self.channels % self.heads == 0, words)

    @property
    def heads(self) -> int:
        """Number of heads per attention layer, one for every 64 channels, as in the public code."""
        return max(1, self.channels // 64)

    def features(self, depth: int) -> FeatureSpec:
        """Request the patches of the last block, by default without the last layer norm."""
        return FeatureSpec(norm=self.last_norm)

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of `rows` local tokens of width `channels`, without a global token."""
        return TokenShape(0, self.rows, self.channels)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> Boq:
        """Draw parameters as the public code does: standard normal queries, the rest like torch."""
        conv_key, blocks_key, rows_key = random_init.split(key, 3)
        keys = random_init.split(blocks_key, self.layers)
        return Boq(
            proj_c=init_conv(conv_key, 3, backbone.dim, self.channels),
            norm_input=init_layer_norm(self.channels),
            boqs=tuple(_init_block(block_key, self.channels, self.queries) for block_key in keys),
            fc=init_linear(rows_key, self.layers * self.queries, self.rows),
        )

    def apply(self, params: Boq, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Return `rows` local tokens of width `channels`, in at least float32."""
        patches = features.patches
        maps = patches.reshape(-1, *grid, patches.shape[-1])
        maps = conv(params.proj_c, maps)
        x = maps.reshape(*patches.shape[:-1], maps.shape[-1])
        x = layer_norm(params.norm_input, x)
        answers = []
        for block in params.boqs:
            attended = attention(block.encoder.attn, x, self.heads)
            x = encoder_layer(block.encoder, x, attended, jax.nn.relu)
            # The queries' self-attention does not depend on the images: it runs once per batch.
            queries = block.queries.astype(x.dtype)
            queries = queries + attention(block.self_attn, queries, self.heads)
            queries = layer_norm(block.norm_q, queries)
            answer = cross_attention(block.cross_attn, queries, x, self.heads)
            answers.append(layer_norm(block.norm_out, answer))
        rows = linear(params.fc, jnp.concatenate(answers, axis=-2).swapaxes(-2, -1))
        return Tokens.of_local(at_least_float32(rows).swapaxes(-2, -1))


def _init_block(key: PRNGKeyArray, channels: int, queries: int) -> BoqBlock:
    layer_key, queries_key, *keys = random_init.split(key, 6)
    return BoqBlock(
        encoder=init_encoder_layer(layer_key, channels, 4 * channels),
        queries=random_init.normal(queries_key, (queries, channels)),
        self_attn=init_torch_attention(keys[0], keys[1], channels),
        norm_q=init_layer_norm(channels),
        cross_attn=init_torch_attention(keys[2], keys[3], channels),
        norm_out=init_layer_norm(channels),
    )


@pytree_dataclass
class DecoderLayer:
    """Self-attention of the queries, then cross-attention to the backbone's tokens."""

    self_attn: Attention
    multihead_attn: Attention
    norm1: LayerNorm
    norm2: LayerNorm


@pytree_dataclass
class EdtFormer:
    """Parameters: queries, linear layer over the backbone's tokens, decoder, two projections."""

    queries: Float[Array, "query width"]
    fc: Linear
    layers: tuple[DecoderLayer, ...]
    channel_proj: Linear
    row_proj: Linear


@AGGREGATORS.register("edtformer", tiny={"width": 64, "heads": 4, "queries": 16, "channels": 64})
class EdtFormerConfig(Aggregator):
    """EDTformer's decoder (Jin et al., 2025).

    Example:
        >>> from crisalad_jax import ModelConfig
        >>> ModelConfig(aggregator="edtformer", cross_image="none").descriptor_dim
        4096
    """

    class_token: ClassVar[bool] = True
    flatten_order: ClassVar[FlattenOrder] = "dimension-first"
    width: PositiveInt = 768
    """Width of the decoder."""
    heads: PositiveInt = 16
    """Number of attention heads."""
    layers: PositiveInt = 2
    queries: PositiveInt = 64
    """Number of learnt queries."""
    channels: PositiveInt = 256
    """Number of channels of a query output after a linear projection."""
    rows: PositiveInt = 16
    """Number of local tokens (rows) that a linear layer computes from all query outputs."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        fits = self.width % self.heads == 0
        require_field(self, "width", fits, f"a multiple of the {self.heads} heads")

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of `rows` local tokens of width `channels`, without a global token."""
        return TokenShape(0, self.rows, self.channels)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> EdtFormer:
        """Draw queries with standard deviation 1e-6, as published, and the rest as torch does.

        All layers start identical: torch's `nn.TransformerDecoder` copies the layer it is given.
        """
        queries, fc, layer_key, channels, rows = random_init.split(key, 5)
        keys = random_init.split(layer_key, 4)
        layer = DecoderLayer(
            self_attn=init_torch_attention(keys[0], keys[1], self.width),
            multihead_attn=init_torch_attention(keys[2], keys[3], self.width),
            norm1=init_layer_norm(self.width),
            norm2=init_layer_norm(self.width),
        )
        return EdtFormer(
            queries=random_init.normal(queries, (self.queries, self.width), scale=1e-6),
            fc=init_linear(fc, backbone.dim, self.width),
            # Copies: a training step that donates its buffers must not receive one twice.
            layers=tuple(jax.tree.map(jnp.copy, layer) for _ in range(self.layers)),
            channel_proj=init_linear(channels, self.width, self.channels),
            row_proj=init_linear(rows, self.queries, self.rows),
        )

    def apply(self, params: EdtFormer, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Return `rows` local tokens of width `channels`, in at least float32."""
        answers = decode(params, features, self.heads)
        channels = linear(params.channel_proj, answers).swapaxes(-2, -1)
        return Tokens.of_local(at_least_float32(linear(params.row_proj, channels)).swapaxes(-2, -1))


def decode(params: EdtFormer, features: Features, heads: int) -> Float[Array, "*batch query width"]:
    """Compute the query outputs of the decoder, which attends to the class token and all patches.

    The first layer's self-attention does not depend on the images: it runs once per batch.
    """
    whole = jnp.concatenate([features.class_token[..., None, :], features.patches], axis=-2)
    memory = linear(params.fc, whole)
    queries = params.queries.astype(memory.dtype)
    for layer in params.layers:
        queries = queries + attention(layer.self_attn, queries, heads)
        queries = layer_norm(layer.norm1, queries)
        queries = queries + cross_attention(layer.multihead_attn, queries, memory, heads)
        queries = layer_norm(layer.norm2, queries)
    return queries
