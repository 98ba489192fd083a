"""The cross-image encoder (paper section 3.4): transformer layers across a batch's images.

Layers are torch's `nn.TransformerEncoderLayer` as CricaVPR uses it: post-norm, exact GELU.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from crisalad_jax.config.checks import Fraction, NonNegativeInt, PositiveInt, check_types
from crisalad_jax.config.part import non_semantic_field
from crisalad_jax.config.short_repr import short_repr
from crisalad_jax.nn.attention import Attention, dot_product_attention
from crisalad_jax.nn.layers import at_least_float32, dropout, gelu, linear, split_key
from crisalad_jax.nn.torch_layers import EncoderLayer, encoder_layer, init_encoder_layer
from crisalad_jax.utils.devices import IMAGE, image_mesh
from crisalad_jax.utils.pytree import pytree_dataclass


@short_repr(switch=("layers", 0))
@dataclasses.dataclass(frozen=True)
class CrossImageConfig:
    """The transformer encoder that attends across the images of a batch (paper section 3.4).

    Example:
        >>> CrossImageConfig(layers=0).layers
        0
    """

    layers: NonNegativeInt = 2
    """Number of layers. 0 leaves the encoder out, so that descriptors depend on no other image."""
    heads: PositiveInt = 16
    feedforward: PositiveInt = 2048
    dropout: Fraction = non_semantic_field(0.1)
    global_token: bool = True
    """Whether the global token takes part too, cut into tokens of the clusters' width."""

    def __post_init__(self) -> None:
        """Check the fields."""
        check_types(self)


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
        weights_key, *keys = split_key(layer_key, 4)
        attended = _attend_across(layer.attn, tokens, config, mask=mask, key=weights_key)
        tokens = encoder_layer(layer, tokens, attended, gelu, rate=config.dropout, keys=keys)
    return tokens


def _attend_across(
    params: Attention,
    x: Float[Array, "image token dim"],
    config: CrossImageConfig,
    *,
    mask: Bool[Array, "image image"] | None,
    key: PRNGKeyArray | None,
) -> Float[Array, "image token dim"]:
    """Attend from each token to the same token of all images.

    Where images are sharded, a device attends from its own to those of all: keys and values are
    gathered once, and their gradient is scattered once. Left alone, XLA splits the keys and adds up
    scores, totals and results, with twelve collectives a layer. Dropout has the same bits as on one
    device.
    """
    images, tokens, dim = x.shape
    mesh, heads = image_mesh(), config.heads
    dropout_mask = None
    if key is not None and config.dropout > 0:
        every = jnp.ones((tokens, heads, images, images), at_least_float32(x[:0]).dtype)
        dropout_mask = dropout(every, config.dropout, key=key)

    def by_token(x: Array) -> Float[Array, "token image head _"]:
        return x.reshape(x.shape[0], tokens, heads, -1).swapaxes(0, 1)

    def attend(qkv: Array, mask: Array | None, dropout_mask: Array | None) -> Array:
        queries, others = jnp.split(qkv, [dim], axis=-1)
        keys, values = jnp.split(others if mesh is None else _gathered(others), 2, axis=-1)
        parts = map(by_token, (queries, keys, values))
        mixed = dot_product_attention(*parts, mask=mask, dropout_mask=dropout_mask)
        return mixed.swapaxes(0, 1).reshape(queries.shape)

    if mesh is not None:
        own, by_query = PartitionSpec(IMAGE), PartitionSpec(None, None, None, IMAGE)
        specs = (own, own, by_query)
        attend = jax.shard_map(attend, mesh=mesh, in_specs=specs, out_specs=own, check_vma=False)
    return linear(params.proj, attend(linear(params.qkv, x), mask, dropout_mask))


@jax.custom_vjp
def _gathered(own: Array) -> Array:
    """Gather a device's images with those of all; their gradients are summed in float32 at least.

    JAX's own rule sums them in the type of `own`, eight bits of a bfloat16.
    """
    return jax.lax.all_gather(own, IMAGE, tiled=True)


def _gathered_backward(_: None, change: Array) -> tuple[Array]:
    total = jax.lax.psum_scatter(at_least_float32(change), IMAGE, tiled=True)
    return (total.astype(change.dtype),)


_gathered.defvjp(lambda own: (_gathered(own), None), _gathered_backward)
