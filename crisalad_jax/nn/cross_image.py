"""The cross-image encoder (paper section 3.4): transformer layers across a batch's images.

Layers are torch's `nn.TransformerEncoderLayer` as CricaVPR uses it: post-norm, exact GELU.
"""

import jax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from crisalad_jax.config import CrossImageConfig
from crisalad_jax.nn.attention import Attention, attention, init_torch_attention
from crisalad_jax.nn.layers import (
    LayerNorm,
    Linear,
    dropout,
    gelu,
    init_layer_norm,
    init_linear,
    layer_norm,
    linear,
    split_key,
)
from crisalad_jax.pytree import params

NORM_EPSILON = 1e-5


@params
class EncoderLayer:
    """Attention and feed-forward network, a layer norm after each."""

    attn: Attention
    linear1: Linear
    linear2: Linear
    norm1: LayerNorm
    norm2: LayerNorm


@params
class CrossImageEncoder:
    """The layers, in order."""

    layers: tuple[EncoderLayer, ...]


def init_cross_image(key: PRNGKeyArray, dim: int, config: CrossImageConfig) -> CrossImageEncoder:
    """Start as torch does: Glorot-uniform attention with zero biases, default linears."""
    keys = jax.random.split(key, config.layers)
    return CrossImageEncoder(tuple(init_encoder_layer(k, dim, config.feedforward) for k in keys))


def init_encoder_layer(key: PRNGKeyArray, dim: int, feedforward: int) -> EncoderLayer:
    """Start as torch's `nn.TransformerEncoderLayer` does."""
    qkv_key, proj_key, first, second = jax.random.split(key, 4)
    return EncoderLayer(
        attn=init_torch_attention(qkv_key, proj_key, dim),
        linear1=init_linear(first, dim, feedforward),
        linear2=init_linear(second, feedforward, dim),
        norm1=init_layer_norm(dim),
        norm2=init_layer_norm(dim),
    )


def cross_image_encoder(
    params: CrossImageEncoder,
    tokens: Float[Array, "image token dim"],
    config: CrossImageConfig,
    *,
    mask: Bool[Array, "image image"] | None = None,
    key: PRNGKeyArray | None,
) -> Float[Array, "image token dim"]:
    """Each token looks at the same token of the other images.

    `mask[i, j]` says that image i may look at image j; None lets all look at all. `key` draws the
    dropout; None means inference.
    """
    for layer, layer_key in zip(params.layers, split_key(key, config.layers), strict=True):
        tokens = _encoder_layer(layer, tokens, config, mask=mask, key=layer_key)
    return tokens


def _encoder_layer(
    params: EncoderLayer,
    tokens: Float[Array, "image token dim"],
    config: CrossImageConfig,
    *,
    mask: Bool[Array, "image image"] | None,
    key: PRNGKeyArray | None,
) -> Float[Array, "image token dim"]:
    weights_key, attended_key, hidden_key, update_key = split_key(key, 4)
    rate = config.dropout
    across = tokens.swapaxes(0, 1)
    attended = attention(
        params.attn, across, config.heads, mask=mask, dropout_rate=rate, key=weights_key
    )
    tokens = tokens + dropout(attended.swapaxes(0, 1), rate, key=attended_key)
    tokens = layer_norm(params.norm1, tokens, epsilon=NORM_EPSILON)
    hidden = dropout(gelu(linear(params.linear1, tokens)), rate, key=hidden_key)
    update = dropout(linear(params.linear2, hidden), rate, key=update_key)
    return layer_norm(params.norm2, tokens + update, epsilon=NORM_EPSILON)
