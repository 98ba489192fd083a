"""Multi-head attention: one function for patches of an image and for images of a batch.

Without mask and dropout it is fused on accelerators, so that scores never reach the memory: by
cuDNN on a GPU in bfloat16, and by `attention_pallas` on a TPU. All else is products of matrices, in
the order that suits the platform.
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from crisalad_jax.nn import draw
from crisalad_jax.nn.layers import (
    Linear,
    at_least_float32,
    dropout,
    init_linear,
    linear,
    product_precision,
)
from crisalad_jax.utils.pytree import pytree_dataclass
from crisalad_jax.utils.target import target, traced_mesh


@pytree_dataclass
class Attention:
    """The joint projection to query, key and value, in this order, and the output projection."""

    qkv: Linear
    proj: Linear


class Rotation(NamedTuple):
    """The angles of a sequence's last tokens, one for each pair of numbers of a head."""

    cosines: Float[np.ndarray, "patch pair"]
    sines: Float[np.ndarray, "patch pair"]


class _Axes(NamedTuple):
    """The axes of queries i, keys j, heads h and a head's numbers d, as `jnp.einsum` names them."""

    queries: str
    keys: str
    weights: str


# With the heads in front every product is a plain batched matmul. Queries and outputs are columns,
# and the softmax runs down columns, which is faster on a CPU.
COLUMNS = _Axes("...di", "...jd", "...ji")
# As the linear layer leaves them: an accelerator's compiler has no use for the copies.
_ROWS = _Axes("...ihd", "...jhd", "...hji")
_EIGHT = 8
"""Number that fused attention takes multiples of, of tokens and of a head's numbers. For training
cuDNN needs even numbers of tokens, and eights keep every row aligned. On a TPU sequences of eights
are rows of one matrix as they are; others are copied on the way to each product and back."""
_CUDNN_HEAD = 128
"""Widest head that cuDNN's attention takes on every GPU that has it."""


def init_torch_attention(qkv_key: PRNGKeyArray, proj_key: PRNGKeyArray, dim: int) -> Attention:
    """Draw parameters as torch's `nn.MultiheadAttention`: Glorot-uniform inputs, zero biases."""
    bound = math.sqrt(6 / (dim + 3 * dim))
    qkv = draw.uniform(qkv_key, (dim, 3 * dim), minval=-bound, maxval=bound)
    proj = init_linear(proj_key, dim, dim).weight
    return Attention(Linear(qkv, draw.zeros(3 * dim)), Linear(proj, draw.zeros(dim)))


def attention(
    params: Attention,
    x: Float[Array, "*batch token dim"],
    heads: int,
    *,
    length: int | None = None,
    mask: Bool[Array, "token token"] | None = None,
    rotation: Rotation | None = None,
    dropout_rate: float = 0.0,
    key: PRNGKeyArray | None,
) -> Float[Array, "*batch token dim"]:
    """Apply scaled dot-product self-attention (Vaswani et al. 2017) to a sequence or a batch.

    Args:
        params: the projections.
        x: tokens.
        heads: number of heads.
        length: number of first tokens that are no padding, to which alone tokens attend; None is
            all. See `padded_length`.
        mask: `mask[i, j]` allows token i to attend to token j; a row must allow at least one.
        rotation: turns queries and keys by their tokens' angles.
        dropout_rate: share of the attention weights that are dropped.
        key: draws the dropout; None means inference.

    Returns:
        The tokens' updates. Scores and softmax are float32 for every type of `x`.
    """
    *batch, tokens, dim = x.shape
    is_padded = length is not None and length < tokens
    length = tokens if length is None else length
    dropout_mask = None
    if key is not None and dropout_rate > 0:
        every = jnp.ones((*batch, heads, tokens, tokens), _wide(x))
        dropout_mask = dropout(every, dropout_rate, key=key)
    qkv = checkpoint_name(linear(params.qkv, x), "qkv")
    if mask is None and dropout_mask is None:
        if _takes_cudnn(x.dtype, dim // heads):
            return linear(params.proj, _cudnn(qkv, heads, length, rotation))
        if _takes_pallas(tokens, x.dtype, dim, heads) and _shards(math.prod(batch)):
            return linear(params.proj, _pallas(qkv, heads, length, rotation))
    if is_padded:
        real = jnp.broadcast_to(jnp.arange(tokens) < length, (tokens, tokens))
        mask = real if mask is None else mask & real
    queries, keys, values = _split_heads(qkv, heads, length, rotation)
    queries = queries / math.sqrt(dim // heads)
    seen = None if mask is None else mask.T
    precision = rule_precision(x.dtype)
    if target().platform != "cpu":
        mixed = mix(queries, keys, values, seen, dropout_mask, _ROWS, precision)
        return linear(params.proj, mixed.reshape(x.shape))
    mixed = mix(
        jnp.moveaxis(queries, -3, -1),
        jnp.moveaxis(keys, -3, -2),
        jnp.moveaxis(values, -3, -2),
        seen,
        dropout_mask,
        COLUMNS,
        precision,
    )
    return linear(params.proj, jnp.moveaxis(mixed, -1, -3).reshape(x.shape))


def padded_length(tokens: int, dtype: Any, dim: int, heads: int) -> int:
    """Return the number of tokens to pad a sequence to, so that no `attention` has to do it.

    Example:
        >>> from crisalad_jax.utils.target import CPU, lowering_for
        >>> with lowering_for(CPU):
        ...     padded_length(257, jnp.float32, 768, 12)
        257
    """
    whole = -(-tokens // _EIGHT) * _EIGHT
    fused = _takes_cudnn(dtype, dim // heads) or _takes_pallas(whole, dtype, dim, heads)
    return whole if fused else tokens


def _takes_cudnn(dtype: Any, head: int) -> bool:
    fits = dtype == jnp.bfloat16 and head % _EIGHT == 0 and head <= _CUDNN_HEAD
    return target().cudnn and fits


def _cudnn(
    qkv: Float[Array, "*batch token three_dims"], heads: int, length: int, rotation: Rotation | None
) -> Float[Array, "*batch token dim"]:
    *batch, tokens, width = qkv.shape
    more = -tokens % _EIGHT
    parts = _split_heads(qkv, heads, length, rotation)
    q, k, v = (
        jnp.pad(part.reshape(-1, *part.shape[-3:]), ((0, 0), (0, more), (0, 0), (0, 0)))
        for part in parts
    )
    # Queries of padding attend as others do, which keeps their numbers finite.
    lengths = None if length == tokens + more else jnp.full(len(q), length, jnp.int32)
    mixed = jax.nn.dot_product_attention(
        q, k, v, key_value_seq_lengths=lengths, implementation="cudnn"
    )
    return mixed[:, :tokens].reshape(*batch, tokens, width // 3)


def _takes_pallas(tokens: int, dtype: Any, dim: int, heads: int) -> bool:
    if target().platform != "tpu":
        return False
    from crisalad_jax.nn import attention_pallas  # Pallas takes long to import

    return attention_pallas.fits(tokens, dim, heads, dtype)


def _shards(batch: int) -> bool:
    from crisalad_jax.nn import attention_pallas

    return attention_pallas.shards(batch)


def _pallas(
    qkv: Float[Array, "*batch token three_dims"], heads: int, length: int, rotation: Rotation | None
) -> Float[Array, "*batch token dim"]:
    from crisalad_jax.nn import attention_pallas

    mesh = traced_mesh()
    assert mesh is not None  # without which `fits` is False
    *batch, tokens, width = qkv.shape
    if rotation is not None:
        parts = _split_heads(qkv, heads, length, rotation)
        flat = [part.reshape(*batch, tokens, width // 3) for part in parts]
        qkv = jnp.concatenate(flat, axis=-1)
    sequences = qkv.reshape(-1, tokens, width)
    mixed = attention_pallas.attend(sequences, heads, length, rule_precision(qkv.dtype), mesh)
    return mixed.reshape(*batch, tokens, width // 3)


def _split_heads(
    qkv: Float[Array, "*batch token three_dims"], heads: int, length: int, rotation: Rotation | None
) -> tuple[Array, Array, Array]:
    """Return queries, keys and values by head; turn the first two where there are angles."""
    *batch, tokens, width = qkv.shape
    qkv = qkv.reshape(*batch, tokens, 3 * heads, width // 3 // heads)
    queries, keys, values = jnp.split(qkv, 3, axis=-2)
    if rotation is not None:
        queries, keys = (rotate(part, rotation, length=length) for part in (queries, keys))
    return queries, keys, values


def rotate(
    x: Float[Array, "*batch token head dim"], rotation: Rotation, *, length: int | None = None
) -> Float[Array, "*batch token head dim"]:
    """Turn queries or keys by their tokens' angles (RoPE: Su et al. 2021), in float32.

    Numbers i and i + dim / 2 of a head are a pair. Tokens before those with angles stay as they
    are, to the bit, and so does padding after the first `length`.
    """
    wide = at_least_float32(x)
    length = x.shape[-3] if length is None else length
    around = ((length - len(rotation.cosines), x.shape[-3] - length), (0, 0))
    cosines, sines = (
        jnp.asarray(np.pad(part, around, constant_values=still)[:, None], wide.dtype)
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
    asked = asked.reshape(*asked.shape[:-1], heads, dim // heads)
    precision = rule_precision(x.dtype)
    if target().platform != "cpu":
        keys, values = jnp.split(offered, 2, axis=-2)
        asked = jnp.broadcast_to(asked, (*batch, *asked.shape[-3:]))
        mixed = mix(asked, keys, values, None, None, _ROWS, precision)
    else:
        keys, values = jnp.split(jnp.moveaxis(offered, -3, -2), 2, axis=-3)
        columns = jnp.moveaxis(asked, -3, -1)
        columns = jnp.broadcast_to(columns, (*batch, *columns.shape[-3:]))
        mixed = mix(columns, keys, values, None, None, COLUMNS, precision)
        mixed = jnp.moveaxis(mixed, -1, -3)
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
    scores = _product("...hd,...jhd->...hj", query, keys, product_precision(x.dtype))
    return jax.nn.softmax(scores, axis=-1)


def _wide(x: Array) -> Any:
    return jnp.promote_types(x.dtype, jnp.float32)


def rule_precision(dtype: Any) -> str | None:
    """Return the precision of products, for rules whose backward half is traced outside of it."""
    if product_precision(dtype) is not None:
        return "default"
    return None if target().platform == "cpu" else jax.config.jax_default_matmul_precision  # pyright: ignore


def _product(formula: str, a: Array, b: Array, precision: Any = None) -> Array:
    return jnp.einsum(formula, a, b, precision=precision, preferred_element_type=_wide(a))


def _mix_values(
    queries: Float[Array, "..."],
    keys: Float[Array, "..."],
    values: Float[Array, "..."],
    mask: Bool[Array, "token query"] | None,
    dropout_mask: Float[Array, "*batch head token query"] | None,
    axes: _Axes,
    precision: str | None,
) -> Float[Array, "..."]:
    """Average the values for every query, weighted by its scores' softmax times the dropout mask.

    Queries and the result have the axes `axes.queries`, keys and values `axes.keys`.

    The gradient is a custom rule. JAX's own would recompute the result, and order the product for
    the queries' cotangent such that it takes twice as long on a CPU. There is no forward mode
    (`jax.jvp`).
    """
    weights, totals = _softmax(queries, keys, mask, axes, precision)
    weights = weights if dropout_mask is None else weights * dropout_mask
    mixed = _product(
        f"{axes.keys},{axes.weights}->{axes.queries}",
        values,
        weights.astype(values.dtype),
        precision,
    )
    # Do the softmax's division here, on the smaller array.
    return (mixed / _beside_queries(totals, axes)).astype(values.dtype)


mix = jax.custom_vjp(_mix_values, nondiff_argnums=(5, 6))


def _softmax(
    queries: Array, keys: Array, mask: Array | None, axes: _Axes, precision: str | None
) -> tuple[Float[Array, "*batch head token query"], Float[Array, "*batch head 1 query"]]:
    """Compute the scores' exponentials, with keys down the columns, and each column's total."""
    formula = f"{axes.keys},{axes.queries}->{axes.weights}"
    scores = _product(formula, keys, queries, precision)
    if mask is not None:
        scores = jnp.where(mask, scores, -jnp.inf)
    weights = jnp.exp(scores - scores.max(axis=-2, keepdims=True))
    return weights, weights.sum(axis=-2, keepdims=True)


def _beside_queries(
    totals: Float[Array, "*batch head 1 query"], axes: _Axes
) -> Float[Array, "..."]:
    return totals if axes == COLUMNS else jnp.moveaxis(totals, -1, -3)


def _mix_forward(*inputs: Any) -> tuple[Array, tuple[Any, ...]]:
    return mix(*inputs), inputs[:5]


def _mix_backward(
    axes: _Axes, precision: str | None, inputs: tuple[Any, ...], change: Array
) -> tuple[Any, ...]:
    queries, keys, values, mask, dropout_mask = inputs
    product = functools.partial(_product, precision=precision)
    weights, totals = _softmax(queries, keys, mask, axes, precision)
    change = (change / _beside_queries(totals, axes)).astype(values.dtype)
    to_weights = product(f"{axes.keys},{axes.queries}->{axes.weights}", values, change)
    used = weights
    if dropout_mask is not None:
        to_weights, used = to_weights * dropout_mask, weights * dropout_mask
    over_queries = f"{axes.weights},{axes.queries}->{axes.keys}"
    to_values = product(over_queries, used.astype(values.dtype), change)
    mean = (weights * to_weights).sum(axis=-2, keepdims=True) / totals
    to_scores = (weights * (to_weights - mean)).astype(keys.dtype)
    to_queries = product(f"{axes.keys},{axes.weights}->{axes.queries}", keys, to_scores)
    to_keys = product(over_queries, to_scores, queries).astype(keys.dtype)
    nothing = None if dropout_mask is None else jnp.zeros_like(dropout_mask)
    to_queries, to_values = to_queries.astype(queries.dtype), to_values.astype(values.dtype)
    return to_queries, to_keys, to_values, None, nothing


mix.defvjp(_mix_forward, _mix_backward)
