"""Torch's `nn.TransformerEncoderLayer`, post-norm, for attention that the caller computes."""

from collections.abc import Callable, Sequence
from typing import Any

from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.nn import random_init
from crisalad_jax.nn.attention import Attention, init_torch_attention
from crisalad_jax.nn.layers import (
    LayerNorm,
    Linear,
    dropout,
    init_layer_norm,
    init_linear,
    layer_norm,
    linear,
)
from crisalad_jax.utils.pytree import pytree_dataclass


@pytree_dataclass
class EncoderLayer:
    """Parameters of attention and feed-forward network, with a layer norm after each."""

    attn: Attention
    linear1: Linear
    linear2: Linear
    norm1: LayerNorm
    norm2: LayerNorm


def init_encoder_layer(key: PRNGKeyArray, dim: int, feedforward: int) -> EncoderLayer:
    """Draw parameters as torch's `nn.TransformerEncoderLayer` does."""
    qkv_key, proj_key, first, second = random_init.split(key, 4)
    return EncoderLayer(
        attn=init_torch_attention(qkv_key, proj_key, dim),
        linear1=init_linear(first, dim, feedforward),
        linear2=init_linear(second, feedforward, dim),
        norm1=init_layer_norm(dim),
        norm2=init_layer_norm(dim),
    )


def encoder_layer(
    params: EncoderLayer,
    x: Float[Array, "*batch token dim"],
    attended: Float[Array, "*batch token dim"],
    activation: Callable[[Array], Array],
    *,
    rate: float = 0.0,
    keys: Sequence[Any] = (None, None, None),
) -> Float[Array, "*batch token dim"]:
    """Add the attention's output and then the feed-forward network's, with a layer norm after each.

    Args:
        params: the layer, whose attention has already been applied.
        x: the tokens that went into the attention.
        attended: the attention's output.
        activation: activation of the feed-forward network's hidden layer.
        rate: dropout rate of the attention's output, the hidden layer and the network's output.
        keys: random keys for these three dropouts; None means inference.
    """
    x = x + dropout(attended, rate, key=keys[0])
    x = layer_norm(params.norm1, x)
    hidden = dropout(activation(linear(params.linear1, x)), rate, key=keys[1])
    update = dropout(linear(params.linear2, hidden), rate, key=keys[2])
    return layer_norm(params.norm2, x + update)
