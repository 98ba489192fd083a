"""EDTformer: learnt queries that a decoder without feed-forward networks asks (Jin et al. 2025).

Attentions are torch's `nn.MultiheadAttention`, with a layer norm after each.
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
from crisalad_jax.nn.cross_image import NORM_EPSILON
from crisalad_jax.nn.layers import (
    Keys,
    LayerNorm,
    Linear,
    at_least_float32,
    init_layer_norm,
    init_linear,
    layer_norm,
    linear,
)
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.pytree import pytree_dataclass


@pytree_dataclass
class DecoderLayer:
    """Attention of the queries to each other, then to the backbone's tokens."""

    self_attn: Attention
    multihead_attn: Attention
    norm1: LayerNorm
    norm2: LayerNorm


@pytree_dataclass
class EdtFormer:
    """Queries, the layer that the backbone's tokens go through, the decoder, two projections."""

    queries: Float[Array, "query width"]
    fc: Linear
    layers: tuple[DecoderLayer, ...]
    channel_proj: Linear
    row_proj: Linear


@AGGREGATORS.register("edtformer", tiny={"width": 64, "heads": 4, "queries": 16, "channels": 64})
@dataclasses.dataclass(frozen=True)
class EdtFormerConfig(Aggregator):
    """EDTformer's decoder (Jin et al., 2025).

    Example:
        >>> from crisalad_jax import CrossImageConfig, ModelConfig
        >>> alone = CrossImageConfig(layers=0)
        >>> ModelConfig(aggregator="edtformer", cross_image=alone).descriptor_dim
        4096
    """

    dimension_first: ClassVar[bool] = True
    width_field: ClassVar[str] = "channels"
    width: int = 768
    """Width of the decoder."""
    heads: int = 16
    """Number of heads of every attention."""
    layers: int = 2
    queries: int = 64
    """Number of learnt queries."""
    channels: int = 256
    """Number of channels of an answer after its projection."""
    rows: int = 16
    """Number of rows that a linear layer makes of all answers."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "width", "heads", "layers", "queries", "channels", "rows")
        require(
            self.width % self.heads == 0,
            f"EdtFormerConfig.width: found {self.width}, expected a multiple of the {self.heads} "
            "heads",
        )

    def features(self, depth: int) -> FeatureRequest:
        """Request the last patches and the class token."""
        return FeatureRequest(class_token=True)

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of one token for each row."""
        return TokenShape(0, self.rows, self.channels)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: tuple[int, int]) -> EdtFormer:
        """Draw queries of deviation 1e-6, as published, and the rest as torch's.

        All layers start equal: torch's `nn.TransformerDecoder` copies the layer that it is given.
        """
        queries, fc, layer_key, channels, rows = draw.split(key, 5)
        layer = _init_layer(layer_key, self.width)
        return EdtFormer(
            queries=draw.normal(queries, (self.queries, self.width), scale=1e-6),
            fc=init_linear(fc, backbone.dim, self.width),
            # Copies: a training step that donates its buffers must not find one twice.
            layers=tuple(jax.tree.map(jnp.copy, layer) for _ in range(self.layers)),
            channel_proj=init_linear(channels, self.width, self.channels),
            row_proj=init_linear(rows, self.queries, self.rows),
        )

    def apply(
        self, params: EdtFormer, features: Features, grid: tuple[int, int], *, key: Keys | None
    ) -> Tokens:
        """Return a token of `channels` numbers for each row."""
        answers = decode(params, features, self.heads)
        channels = linear(params.channel_proj, answers).swapaxes(-2, -1)
        return Tokens.of_local(at_least_float32(linear(params.row_proj, channels)).swapaxes(-2, -1))


def _init_layer(key: PRNGKeyArray, width: int) -> DecoderLayer:
    keys = draw.split(key, 4)
    return DecoderLayer(
        self_attn=init_torch_attention(keys[0], keys[1], width),
        multihead_attn=init_torch_attention(keys[2], keys[3], width),
        norm1=init_layer_norm(width),
        norm2=init_layer_norm(width),
    )


def decode(params: EdtFormer, features: Features, heads: int) -> Float[Array, "*batch query width"]:
    """Ask the class token and all patches.

    The first layer's self-attention does not depend on the image: it runs once for a whole batch.
    """
    whole = jnp.concatenate([features.class_token[..., None, :], features.patches], axis=-2)
    memory = linear(params.fc, whole)
    queries = params.queries.astype(memory.dtype)
    for layer in params.layers:
        queries = queries + attention(layer.self_attn, queries, heads, key=None)
        queries = layer_norm(layer.norm1, queries, epsilon=NORM_EPSILON)
        queries = queries + cross_attention(layer.multihead_attn, queries, memory, heads)
        queries = layer_norm(layer.norm2, queries, epsilon=NORM_EPSILON)
    return queries
