"""Multi-head attention: one function for patches of an image and for images of a batch.

On a GPU it uses cuDNN's fused attention in bfloat16, without mask and dropout.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from crisalad_jax.nn.layers import Linear, at_least_float32, dropout, init_linear, linear
from crisalad_jax.utils.pytree import pytree_dataclass
from crisalad_jax.utils.target import target


@pytree_dataclass
class Attention:
    """The joint projection to query, key and value, in this order, and the output projection."""

    qkv: Linear
    proj: Linear


class Rotation(NamedTuple):
    """The angles of a sequence's last tokens, one for each pair of numbers of a head."""

    cosines: Float[np.ndarray, "patch pair"]
    sines: Float[np.ndarray, "patch pair"]


def init_torch_attention(qkv_key: PRNGKeyArray, proj_key: PRNGKeyArray, dim: int) -> Attention:
    """Draw parameters as torch's `nn.MultiheadAttention`: Glorot-uniform inputs, zero biases."""
    bound = math.sqrt(6 / (dim + 3 * dim))
    qkv = jax.random.uniform(qkv_key, (dim, 3 * dim), minval=-bound, maxval=bound)
    proj = init_linear(proj_key, dim, dim).weight
    return Attention(Linear(qkv, jnp.zeros(3 * dim)), Linear(proj, jnp.zeros(dim)))


def attention(
    params: Attention,
    x: Float[Array, "*batch token dim"],
    heads: int,
    *,
    mask: Bool[Array, "token token"] | None = None,
    rotation: Rotation | None = None,
    dropout_rate: float = 0.0,
    key: PRNGKeyArray | None,
) -> Float[Array, "*batch token dim"]:
    """Apply scaled dot-product self-attention (Vaswani et al. 2017) to a sequence or a batch.

    `mask[i, j]` allows token i to attend to token j; a row must allow at least one. Scores and
    softmax are float32 for every type of `x`. `rotation` turns queries and keys by their tokens'
    angles. `dropout_rate` applies to the attention weights.
    """
    *batch, tokens, dim = x.shape
    dropout_mask = None
    if key is not None and dropout_rate > 0:
        every = jnp.ones((*batch, heads, tokens, tokens), _wide(x))
        dropout_mask = dropout(every, dropout_rate, key=key)
    qkv = checkpoint_name(linear(params.qkv, x), "qkv")
    qkv = qkv.reshape(*batch, tokens, 3 * heads, dim // heads)
    queries, keys, values = jnp.split(qkv, 3, axis=-2)
    if rotation is not None:
        queries, keys = rotate(queries, rotation), rotate(keys, rotation)
    fits = (
        x.dtype == jnp.bfloat16 and dim // heads % 8 == 0 and mask is None and dropout_mask is None
    )
    if fits and target().cudnn:
        queries, keys, values = (
            part.reshape(-1, tokens, heads, dim // heads) for part in (queries, keys, values)
        )
        mixed = jax.nn.dot_product_attention(queries, keys, values, implementation="cudnn")
        return linear(params.proj, mixed.reshape(x.shape))
    # With the heads in front every product is a plain batched matmul. Queries and outputs are
    # columns, and the softmax runs down columns, which is faster on a CPU.
    mixed = _mix(
        jnp.moveaxis(queries / math.sqrt(dim // heads), -3, -1),
        jnp.moveaxis(keys, -3, -2),
        jnp.moveaxis(values, -3, -2),
        None if mask is None else mask.T,
        dropout_mask,
    )
    return linear(params.proj, jnp.moveaxis(mixed, -1, -3).reshape(x.shape))


def rotate(
    x: Float[Array, "*batch token head dim"], rotation: Rotation
) -> Float[Array, "*batch token head dim"]:
    """Turn queries or keys by their tokens' angles (RoPE: Su et al. 2021), in float32.

    Numbers i and i + dim / 2 of a head are a pair. Tokens before those with angles stay as they
    are, to the bit.
    """
    wide = at_least_float32(x)
    front = ((x.shape[-3] - len(rotation.cosines), 0), (0, 0))
    cosines, sines = (
        jnp.asarray(np.pad(part, front, constant_values=still)[:, None], wide.dtype)
        for part, still in zip(rotation, (1, 0), strict=True)
    )
    first, second = jnp.split(wide, 2, axis=-1)
    turned = first * cosines - second * sines, second * cosines + first * sines
    return jnp.concatenate(turned, axis=-1).astype(x.dtype)


def without_key_bias(params: Attention) -> Attention:
    """Return the parameters with the keys' bias 0, which then has no gradient."""
    bias = params.qkv.bias
    assert bias is not None
    queries, keys, values = jnp.split(bias, 3, axis=-1)
    bias = jnp.concatenate([queries, jnp.zeros_like(keys), values], axis=-1)
    return dataclasses.replace(params, qkv=dataclasses.replace(params.qkv, bias=bias))


def cross_attention(
    params: Attention,
    queries: Float[Array, "*batch_or_none query dim"],
    x: Float[Array, "*batch token dim"],
    heads: int,
) -> Float[Array, "*batch query dim"]:
    """Attend from queries, of each sequence or shared by a whole batch, to the tokens of `x`.

    Scores, softmax and parameters are those of `attention`.
    """
    *batch, tokens, dim = x.shape
    weight, bias = params.qkv.weight, params.qkv.bias
    assert bias is not None
    asked = linear(Linear(weight[:, :dim], bias[:dim]), queries) / math.sqrt(dim // heads)
    offered = linear(Linear(weight[:, dim:], bias[dim:]), x)
    offered = offered.reshape(*batch, tokens, 2 * heads, dim // heads)
    keys, values = jnp.split(jnp.moveaxis(offered, -3, -2), 2, axis=-3)
    columns = jnp.moveaxis(asked.reshape(*asked.shape[:-1], heads, dim // heads), -3, -1)
    columns = jnp.broadcast_to(columns, (*batch, *columns.shape[-3:]))
    mixed = jnp.moveaxis(_mix(columns, keys, values, None, None), -1, -3)
    return linear(params.proj, mixed.reshape(*batch, queries.shape[-2], dim))


def first_token_attention(
    params: Attention,
    x: Float[Array, "*batch token dim"],
    heads: int,
    *,
    rotation: Rotation | None = None,
) -> Float[Array, "*batch head token"]:
    """Compute how much of each token the first token's `attention` takes, in float32 at least.

    A head's shares sum to 1. `rotation` turns keys; the first token has no angle.
    """
    *batch, tokens, dim = x.shape
    weight, bias = params.qkv.weight[:, : 2 * dim], params.qkv.bias
    assert bias is not None
    query = linear(Linear(weight[:, :dim], bias[:dim]), x[..., 0, :]) / math.sqrt(dim // heads)
    keys = linear(Linear(weight[:, dim:], bias[dim : 2 * dim]), x)
    keys = keys.reshape(*batch, tokens, heads, dim // heads)
    if rotation is not None:
        keys = rotate(keys, rotation)
    query = query.reshape(*batch, heads, dim // heads)
    scores = _product("...hd,...jhd->...hj", query, keys)
    return jax.nn.softmax(scores, axis=-1)


def _wide(x: Array) -> Any:
    return jnp.promote_types(x.dtype, jnp.float32)


def _product(formula: str, a: Array, b: Array) -> Array:
    return jnp.einsum(formula, a, b, preferred_element_type=_wide(a))


@jax.custom_vjp
def _mix(
    queries: Float[Array, "*batch head dim query"],
    keys: Float[Array, "*batch head token dim"],
    values: Float[Array, "*batch head token dim"],
    mask: Bool[Array, "token query"] | None,
    dropout_mask: Float[Array, "*batch head token query"] | None,
) -> Float[Array, "*batch head dim query"]:
    """Average the values for every query, weighted by its scores' softmax times the dropout mask.

    The gradient is a custom rule. JAX's own would recompute the result, and order the product for
    the queries' cotangent such that it takes twice as long on a CPU. There is no forward mode
    (`jax.jvp`).
    """
    weights, totals = _softmax(queries, keys, mask)
    weights = weights if dropout_mask is None else weights * dropout_mask
    mixed = _product("...jd,...ji->...di", values, weights.astype(values.dtype))
    # Do the softmax's division here, on the smaller array.
    return (mixed / totals).astype(values.dtype)


def _softmax(
    queries: Array, keys: Array, mask: Array | None
) -> tuple[Float[Array, "*batch head token query"], Float[Array, "*batch head 1 query"]]:
    """Compute the scores' exponentials, with keys down the columns, and each column's total."""
    scores = _product("...jd,...di->...ji", keys, queries)
    if mask is not None:
        scores = jnp.where(mask, scores, -jnp.inf)
    weights = jnp.exp(scores - scores.max(axis=-2, keepdims=True))
    return weights, weights.sum(axis=-2, keepdims=True)


def _mix_forward(*inputs: Any) -> tuple[Array, tuple[Any, ...]]:
    return _mix(*inputs), inputs


def _mix_backward(inputs: tuple[Any, ...], change: Array) -> tuple[Any, ...]:
    queries, keys, values, mask, dropout_mask = inputs
    weights, totals = _softmax(queries, keys, mask)
    change = (change / totals).astype(values.dtype)
    to_weights = _product("...jd,...di->...ji", values, change)
    used = weights
    if dropout_mask is not None:
        to_weights, used = to_weights * dropout_mask, weights * dropout_mask
    to_values = _product("...ji,...di->...jd", used.astype(values.dtype), change)
    mean = (weights * to_weights).sum(axis=-2, keepdims=True) / totals
    to_scores = (weights * (to_weights - mean)).astype(keys.dtype)
    to_queries = _product("...jd,...ji->...di", keys, to_scores).astype(queries.dtype)
    to_keys = _product("...ji,...di->...jd", to_scores, queries).astype(keys.dtype)
    nothing = None if dropout_mask is None else jnp.zeros_like(dropout_mask)
    return to_queries, to_keys, to_values.astype(values.dtype), None, nothing


_mix.defvjp(_mix_forward, _mix_backward)
