"""The cross-image encoder (paper section 3.4): transformer layers across a batch's images.

Layers are torch's `nn.TransformerEncoderLayer` as CricaVPR uses it: post-norm, exact GELU.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from crisalad_jax.config.checks import check_types, require, require_fraction, require_positive
from crisalad_jax.config.part import non_semantic_field
from crisalad_jax.config.short_repr import short_repr
from crisalad_jax.nn import draw
from crisalad_jax.nn.attention import (
    COLUMNS,
    Attention,
    attention,
    init_torch_attention,
    mix,
    rule_precision,
)
from crisalad_jax.nn.layers import (
    LayerNorm,
    Linear,
    at_least_float32,
    dropout,
    gelu,
    init_layer_norm,
    init_linear,
    layer_norm,
    linear,
    split_key,
)
from crisalad_jax.utils.devices import IMAGE, image_mesh
from crisalad_jax.utils.pytree import pytree_dataclass

NORM_EPSILON = 1e-5


@short_repr(switch=("layers", 0))
@dataclasses.dataclass(frozen=True)
class CrossImageConfig:
    """The transformer encoder that attends across the images of a batch (paper section 3.4).

    Example:
        >>> CrossImageConfig(layers=0).layers
        0
    """

    layers: int = 2
    """Number of layers. 0 leaves the encoder out, so that descriptors depend on no other image."""
    heads: int = 16
    feedforward: int = 2048
    dropout: float = non_semantic_field(0.1)
    global_token: bool = True
    """Whether the global token takes part too, cut into tokens of the clusters' width."""

    def __post_init__(self) -> None:
        """Check the ranges of the fields in use."""
        check_types(self)
        require(
            self.layers >= 0, f"CrossImageConfig.layers: found {self.layers}, expected at least 0"
        )
        if self.layers:
            require_positive(self, "heads", "feedforward")
            require_fraction(self, "dropout")


@pytree_dataclass
class EncoderLayer:
    """Attention and feed-forward network, a layer norm after each."""

    attn: Attention
    linear1: Linear
    linear2: Linear
    norm1: LayerNorm
    norm2: LayerNorm


@pytree_dataclass
class CrossImageEncoder:
    """The layers, in order."""

    layers: tuple[EncoderLayer, ...]


def init_cross_image(key: PRNGKeyArray, dim: int, config: CrossImageConfig) -> CrossImageEncoder:
    """Draw parameters as torch does: Glorot-uniform attention, zero biases, default linears.

    All layers start equal, for torch's `nn.TransformerEncoder` copies the one that it is given.
    """
    # Drawn anew: a training step that donates its buffers must not find one twice.
    layers = (init_encoder_layer(key, dim, config.feedforward) for _ in range(config.layers))
    return CrossImageEncoder(tuple(layers))


def init_encoder_layer(key: PRNGKeyArray, dim: int, feedforward: int) -> EncoderLayer:
    """Draw parameters as torch's `nn.TransformerEncoderLayer` does."""
    qkv_key, proj_key, first, second = draw.split(key, 4)
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
    """Let each token attend to the same token of the other images.

    `mask[i, j]` allows image i to attend to image j; None allows all. `key` draws the dropout; None
    means inference.
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
    options = {"mask": mask, "dropout_rate": rate, "key": weights_key}
    if image_mesh() is None:
        across = attention(params.attn, tokens.swapaxes(0, 1), config.heads, **options)
        attended = across.swapaxes(0, 1)
    else:
        attended = _attention_over_devices(params.attn, tokens, config.heads, **options)
    tokens = tokens + dropout(attended, rate, key=attended_key)
    tokens = layer_norm(params.norm1, tokens, epsilon=NORM_EPSILON)
    hidden = dropout(gelu(linear(params.linear1, tokens)), rate, key=hidden_key)
    update = dropout(linear(params.linear2, hidden), rate, key=update_key)
    return layer_norm(params.norm2, tokens + update, epsilon=NORM_EPSILON)


def _attention_over_devices(
    params: Attention,
    x: Float[Array, "image token dim"],
    heads: int,
    *,
    mask: Bool[Array, "image image"] | None,
    dropout_rate: float,
    key: PRNGKeyArray | None,
) -> Float[Array, "image token dim"]:
    """Compute `attention` across images that are sharded over devices.

    A device attends from its own images to those of all: keys and values are gathered once, and
    their gradient is scattered once. Left alone, XLA splits the keys and adds up scores, totals and
    results, with twelve collectives a layer. Dropout is drawn where it is used, with the same bits
    as on one device.
    """
    mesh = image_mesh()
    assert mesh is not None
    images, tokens, dim = x.shape
    dropout_mask = None
    if key is not None and dropout_rate > 0:
        every = jnp.ones((tokens, heads, images, images), at_least_float32(x[:0]).dtype)
        dropout_mask = dropout(every, dropout_rate, key=key)

    def attend(qkv: Array, mask: Array | None, dropout_mask: Array | None) -> Array:
        queries, others = jnp.split(qkv, [dim], axis=-1)
        keys, values = jnp.split(_gathered(others), 2, axis=-1)
        queries, keys, values = (
            part.reshape(len(part), tokens, heads, dim // heads)
            for part in (queries / math.sqrt(dim // heads), keys, values)
        )
        mixed = mix(
            jnp.transpose(queries, (1, 2, 3, 0)),
            jnp.transpose(keys, (1, 2, 0, 3)),
            jnp.transpose(values, (1, 2, 0, 3)),
            mask,
            dropout_mask,
            COLUMNS,
            rule_precision(qkv.dtype),
        )
        return jnp.transpose(mixed, (3, 0, 1, 2)).reshape(-1, tokens, dim)

    own, by_query = PartitionSpec(IMAGE), PartitionSpec(None, IMAGE)
    by_query_of_all = PartitionSpec(None, None, None, IMAGE)
    attend = jax.shard_map(
        attend,
        mesh=mesh,
        in_specs=(own, by_query, by_query_of_all),
        out_specs=own,
        check_vma=False,
    )
    mixed = attend(linear(params.qkv, x), None if mask is None else mask.T, dropout_mask)
    return linear(params.proj, mixed)


@jax.custom_vjp
def _gathered(own: Array) -> Array:
    """Gather a device's images with those of all; their gradients are summed in float32 at least.

    JAX's own rule sums them in the type of `own`, eight bits of a bfloat16.
    """
    return jax.lax.all_gather(own, IMAGE, tiled=True)


def _gathered_forward(own: Array) -> tuple[Array, None]:
    return _gathered(own), None


def _gathered_backward(_: None, change: Array) -> tuple[Array]:
    total = jax.lax.psum_scatter(at_least_float32(change), IMAGE, tiled=True)
    return (total.astype(change.dtype),)


_gathered.defvjp(_gathered_forward, _gathered_backward)
