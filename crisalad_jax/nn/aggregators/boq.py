"""Bag of queries: learnt queries that ask a transformer's layers (Ali-bey et al., CVPR 2024).

Layers and attentions are torch's: `nn.TransformerEncoderLayer` (post-norm, ReLU, feed-forward of
four times the width) and `nn.MultiheadAttention`.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config import ModelConfig
from crisalad_jax.nn.attention import (
    Attention,
    attention,
    cross_attention,
    init_torch_attention,
)
from crisalad_jax.nn.cross_image import NORM_EPSILON, EncoderLayer, init_encoder_layer
from crisalad_jax.nn.layers import (
    Conv,
    Keys,
    LayerNorm,
    Linear,
    conv,
    init_conv,
    init_layer_norm,
    init_linear,
    layer_norm,
    linear,
    widen,
)
from crisalad_jax.nn.tokens import Tokens, local_alone
from crisalad_jax.nn.vit import Features
from crisalad_jax.pytree import params


@params
class BoqBlock:
    """An encoder layer over the patches, and queries that look at each other, then at them."""

    encoder: EncoderLayer
    queries: Float[Array, "query channel"]
    self_attn: Attention
    norm_q: LayerNorm
    cross_attn: Attention
    norm_out: LayerNorm


@params
class Boq:
    """Fewer channels, the blocks in order, then what makes rows of all their answers."""

    proj_c: Conv
    norm_input: LayerNorm
    boqs: tuple[BoqBlock, ...]
    fc: Linear


def init(key: PRNGKeyArray, config: ModelConfig) -> Boq:
    """Start as the public implementation: queries normal of deviation 1, the rest as torch's."""
    boq, (conv_key, blocks_key, rows_key) = config.boq, jax.random.split(key, 3)
    keys = jax.random.split(blocks_key, boq.layers)
    return Boq(
        proj_c=init_conv(conv_key, 3, config.backbone.dim, boq.channels),
        norm_input=init_layer_norm(boq.channels),
        boqs=tuple(_init_block(one, boq.channels, boq.queries) for one in keys),
        fc=init_linear(rows_key, boq.layers * boq.queries, boq.rows),
    )


def _init_block(key: PRNGKeyArray, channels: int, queries: int) -> BoqBlock:
    layer_key, queries_key, *keys = jax.random.split(key, 6)
    return BoqBlock(
        encoder=init_encoder_layer(layer_key, channels, 4 * channels),
        queries=jax.random.normal(queries_key, (queries, channels)),
        self_attn=init_torch_attention(keys[0], keys[1], channels),
        norm_q=init_layer_norm(channels),
        cross_attn=init_torch_attention(keys[2], keys[3], channels),
        norm_out=init_layer_norm(channels),
    )


def apply(
    params: Boq,
    features: Features,
    grid: tuple[int, int],
    config: ModelConfig,
    *,
    key: Keys | None,
) -> Tokens:
    """A token of `channels` numbers for each row."""
    patches = features.patches
    maps = patches.reshape(-1, *grid, patches.shape[-1])
    maps = jax.vmap(lambda one: conv(params.proj_c, one))(maps)
    x = maps.reshape(*patches.shape[:-1], maps.shape[-1])
    x = layer_norm(params.norm_input, x, epsilon=NORM_EPSILON)
    answers = []
    for block in params.boqs:
        x = encoder_layer(block.encoder, x, config.boq.heads)
        answers.append(ask(block, x, config.boq.heads))
    rows = linear(params.fc, jnp.concatenate(answers, axis=-2).swapaxes(-2, -1))
    return local_alone(widen(rows).swapaxes(-2, -1))


def encoder_layer(
    params: EncoderLayer, x: Float[Array, "*batch patch channel"], heads: int
) -> Float[Array, "*batch patch channel"]:
    """Patches look at each other; a feed-forward network with ReLU; a layer norm after each."""
    attended = attention(params.attn, x, heads, key=None)
    x = layer_norm(params.norm1, x + attended, epsilon=NORM_EPSILON)
    update = linear(params.linear2, jax.nn.relu(linear(params.linear1, x)))
    return layer_norm(params.norm2, x + update, epsilon=NORM_EPSILON)


def ask(
    params: BoqBlock, x: Float[Array, "*batch patch channel"], heads: int
) -> Float[Array, "*batch query channel"]:
    """What the queries find in the patches, normalised.

    Their look at each other owes nothing to the image: it is made once for a whole batch.
    """
    queries = params.queries.astype(x.dtype)
    queries = queries + attention(params.self_attn, queries, heads, key=None)
    queries = layer_norm(params.norm_q, queries, epsilon=NORM_EPSILON)
    found = cross_attention(params.cross_attn, queries, x, heads)
    return layer_norm(params.norm_out, found, epsilon=NORM_EPSILON)
