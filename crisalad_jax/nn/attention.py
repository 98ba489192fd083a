"""Multi-head attention: one function for patches of an image and for images of a batch.

The place where kernels may differ by platform.
"""

import math

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
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
    # With the heads in front every product is a plain batched matmul. Queries are columns: so is
    # what becomes of them, and the softmax runs down columns, which is faster on a CPU.
    qkv = checkpoint_name(linear(params.qkv, x), "qkv").reshape(tokens, 3, heads, dim // heads)
    queries = (qkv[:, 0] / math.sqrt(dim // heads)).transpose(1, 2, 0)
    keys, values = qkv[:, 1].transpose(1, 0, 2), qkv[:, 2].transpose(1, 0, 2)
    wide = jnp.promote_types(x.dtype, jnp.float32)
    scores = jnp.einsum("hjd,hdi->hji", keys, queries, preferred_element_type=wide)
    if mask is not None:
        scores = jnp.where(mask.T, scores, -jnp.inf)
    largest = jax.lax.stop_gradient(scores.max(axis=-2, keepdims=True))
    weights = jnp.exp(scores - largest)
    totals = weights.sum(axis=-2, keepdims=True)
    weights = dropout(weights, dropout_rate, key=key).astype(x.dtype)
    mixed = jnp.einsum("hjd,hji->hdi", values, weights, preferred_element_type=wide)
    # The softmax's division, where there is less to divide.
    mixed = (mixed / totals).astype(x.dtype)
    return linear(params.proj, mixed.transpose(2, 0, 1).reshape(tokens, dim))
