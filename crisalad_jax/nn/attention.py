"""Multi-head attention: one function for patches of an image and for images of a batch.

The place where kernels may differ by platform.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from crisalad_jax.nn.layers import Linear, dropout, linear
from crisalad_jax.pytree import params


@params
class Attention:
    """Query, key and value in one product, in this order, then the output projection."""

    qkv: Linear
    proj: Linear


def attention(
    params: Attention,
    x: Float[Array, "token dim"],
    heads: int,
    *,
    mask: Bool[Array, "token token"] | None = None,
    dropout_rate: float = 0.0,
    key: PRNGKeyArray | None,
) -> Float[Array, "token dim"]:
    """Scaled dot-product self-attention (Vaswani et al. 2017).

    `mask[i, j]` says that token i may look at token j; a row must allow at least one. Scores and
    softmax are float32 whatever the type of `x`. `dropout_rate` falls on the attention weights.
    """
    tokens, dim = x.shape
    # (3, head, token, head_dim): with the heads in front every product is a plain batched matmul.
    queries, keys, values = (
        linear(params.qkv, x).reshape(tokens, 3, heads, dim // heads).transpose(1, 2, 0, 3)
    )
    wide = jnp.promote_types(x.dtype, jnp.float32)
    scores = jnp.einsum(
        "hid,hjd->hij", queries / math.sqrt(dim // heads), keys, preferred_element_type=wide
    )
    if mask is not None:
        scores = jnp.where(mask, scores, -jnp.inf)
    weights = dropout(jax.nn.softmax(scores, axis=-1), dropout_rate, key=key)
    mixed = jnp.einsum("hij,hjd->hid", weights.astype(x.dtype), values)
    return linear(params.proj, mixed.transpose(1, 0, 2).reshape(tokens, dim))
