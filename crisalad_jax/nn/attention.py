"""Multi-head attention: its projections, and products of matrices in the order of the platform.

On an accelerator self-attention is fused where a kernel takes it (`attention_fused`).
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from crisalad_jax.nn import attention_fused, random_init
from crisalad_jax.nn.layers import (
    Linear,
    LinearUpdate,
    adapted_linear,
    at_least_float32,
    columns,
    init_linear,
    linear,
    no_update,
)
from crisalad_jax.nn.products import product_precision, row_major, rule_precision
from crisalad_jax.utils.pytree import pytree_dataclass
from crisalad_jax.utils.target import target

Heads = Float[Array, "*batch token head dim"]
"""Queries, keys or values."""


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
    qkv = random_init.uniform(qkv_key, (dim, 3 * dim), minval=-bound, maxval=bound)
    proj = init_linear(proj_key, dim, dim).weight
    zeros = random_init.zeros
    return Attention(Linear(qkv, zeros(3 * dim)), Linear(proj, zeros(dim)))


def attention(
    params: Attention,
    x: Float[Array, "*batch token dim"],
    heads: int,
    *,
    length: int | None = None,
    rotation: Rotation | None = None,
    update: LinearUpdate = no_update,
) -> Float[Array, "*batch token dim"]:
    """Apply scaled dot-product self-attention (Vaswani et al. 2017) to a sequence or a batch.

    Args:
        params: the projections.
        x: tokens.
        heads: number of heads.
        length: number of first tokens that are not padding, to which alone tokens attend; None is
            all. See `attention_fused.padded_length`.
        rotation: turns queries and keys by their tokens' angles.
        update: what an adapter adds to the outputs of the projections.

    Returns:
        The tokens' updates. Scores and softmax are float32 for every type of `x`.
    """
    tokens = x.shape[-2]
    length = tokens if length is None else length
    projected = adapted_linear("qkv", params.qkv, x, update)
    qkv = split_heads(checkpoint_name(projected, "qkv"), 3 * heads)
    parts = jnp.split(qkv, 3, axis=-2)
    if rotation is not None:
        parts[:2] = (rotate(part, rotation, length=length) for part in parts[:2])
        qkv = jnp.concatenate(parts, axis=-2)
    mixed = attention_fused.attend(qkv, length)
    if mixed is None:
        padding = jnp.arange(tokens) < length
        mask = jnp.broadcast_to(padding, (tokens, tokens)) if length < tokens else None
        mixed = dot_product_attention(*parts, mask=mask)
    return adapted_linear("proj", params.proj, mixed.reshape(x.shape), update)


def split_heads(x: Float[Array, "*batch dim"], heads: int) -> Float[Array, "*batch head _"]:
    """Cut the numbers of each token into heads, side by side."""
    return x.reshape(*x.shape[:-1], heads, x.shape[-1] // heads)


def rotate(x: Heads, rotation: Rotation, *, length: int | None = None) -> Heads:
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


def cross_attention(
    params: Attention,
    queries: Float[Array, "*batch_or_none query dim"],
    x: Float[Array, "*batch token dim"],
    heads: int,
) -> Float[Array, "*batch query dim"]:
    """Attend from queries, of each sequence or shared by a whole batch, to the tokens of `x`.

    Scores, softmax and parameters are those of `attention`.
    """
    *batch, _, dim = x.shape
    asked = split_heads(linear(columns(params.qkv, 0, dim), queries), heads)
    asked = jnp.broadcast_to(asked, (*batch, *asked.shape[-3:]))
    offered = split_heads(linear(columns(params.qkv, dim, 3 * dim), x), 2 * heads)
    mixed = dot_product_attention(asked, *jnp.split(offered, 2, axis=-2))
    return linear(params.proj, mixed.reshape(*batch, queries.shape[-2], dim))


def first_token_attention(
    params: Attention,
    x: Float[Array, "*batch token dim"],
    heads: int,
    *,
    rotation: Rotation | None = None,
    update: LinearUpdate = no_update,
) -> Float[Array, "*batch head token"]:
    """Compute how much of each token the first token's `attention` takes, in float32 at least.

    A head's shares sum to 1. `rotation` turns keys; the first token has no angle.
    """
    dim = x.shape[-1]
    query = part_of_qkv(params, 0, x[..., :1, :], update)[..., 0, :] / math.sqrt(dim // heads)
    query = split_heads(query, heads)
    keys = split_heads(part_of_qkv(params, 1, x, update), heads)
    if rotation is not None:
        keys = rotate(keys, rotation)
    scores = _product("...hd,...jhd->...hj", query, keys, product_precision(x.dtype))
    return jax.nn.softmax(scores, axis=-1)


def attention_weights(
    params: Attention,
    x: Float[Array, "*batch token dim"],
    heads: int,
    *,
    mask: Bool[Array, "token token"] | None = None,
    rotation: Rotation | None = None,
    update: LinearUpdate = no_update,
) -> Float[Array, "*batch head token token"]:
    """Compute how much of each token every token's `attention` takes, in float32 at least.

    Rows sum to 1. `mask[i, j]` allows token i to attend to token j.
    """
    queries, keys = (split_heads(part_of_qkv(params, i, x, update), heads) for i in (0, 1))
    if rotation is not None:
        queries, keys = rotate(queries, rotation), rotate(keys, rotation)
    queries = queries / math.sqrt(queries.shape[-1])
    scores = _product("...ihd,...jhd->...hij", queries, keys, product_precision(x.dtype))
    return jax.nn.softmax(scores, axis=-1, where=mask)


def part_of_qkv(
    params: Attention,
    number: int,
    x: Float[Array, "*batch token dim"],
    update: LinearUpdate = no_update,
) -> Float[Array, "*batch token dim"]:
    """Compute queries (0), keys (1) or values (2) alone, with heads side by side."""
    here = slice(number * x.shape[-1], (number + 1) * x.shape[-1])
    y, extra = linear(columns(params.qkv, here.start, here.stop), x), update("qkv", x)
    return y if extra is None else y + extra[..., here]


class _Axes(NamedTuple):
    """The axes of queries i, keys j, heads h and a head's numbers d, as `jnp.einsum` names them."""

    queries: str
    keys: str
    weights: str


# With the heads in front every product is a plain batched matmul. Queries and outputs are columns,
# and the softmax runs down columns, which is faster on a CPU.
_COLUMNS = _Axes("...di", "...jd", "...ji")
# As the linear layer leaves them: an accelerator's compiler has no use for the copies.
_ROWS = _Axes("...ihd", "...jhd", "...hji")


def dot_product_attention(
    queries: Float[Array, "*batch query head dim"],
    keys: Float[Array, "*batch key head dim"],
    values: Float[Array, "*batch key head dim"],
    *,
    mask: Bool[Array, "query key"] | None = None,
    dropout_mask: Float[Array, "*#batch head key query"] | None = None,
) -> Float[Array, "*batch query head dim"]:
    """Average the values for every query, weighted by its scores' softmax times the dropout mask.

    The gradient is a custom rule. JAX's own would recompute the result, and order the product for
    the queries' cotangent such that it takes twice as long on a CPU. There is no forward mode
    (`jax.jvp`).

    Args:
        queries: not yet divided by the root of their width.
        keys: of the tokens that queries attend to.
        values: of the same tokens.
        mask: `mask[i, j]` allows query i to attend to key j; a row must allow at least one.
        dropout_mask: factors of the weights, 0 or above 1.
    """
    queries = queries / math.sqrt(queries.shape[-1])
    if target().platform == "cpu" and queries.dtype == jnp.bfloat16:
        heads_first = (row_major(jnp.moveaxis(x, -3, -2)) for x in (queries, keys, values))
        return jnp.moveaxis(_mix_rows(*heads_first, mask, dropout_mask), -2, -3)
    mask = None if mask is None else mask.T
    precision = rule_precision(queries.dtype)
    if target().platform != "cpu":
        return _mix(queries, keys, values, mask, dropout_mask, _ROWS, precision)
    queries = jnp.moveaxis(queries, -3, -1)
    keys, values = jnp.moveaxis(keys, -3, -2), jnp.moveaxis(values, -3, -2)
    mixed = _mix(queries, keys, values, mask, dropout_mask, _COLUMNS, precision)
    return jnp.moveaxis(mixed, -1, -3)


def _product(formula: str, a: Array, b: Array, precision: Any = None) -> Array:
    wide = jnp.promote_types(a.dtype, jnp.float32)
    return jnp.einsum(formula, a, b, precision=precision, preferred_element_type=wide)


def _mix_values(
    queries: Float[Array, "..."],
    keys: Float[Array, "..."],
    values: Float[Array, "..."],
    mask: Bool[Array, "token query"] | None,
    dropout_mask: Float[Array, "*batch head token query"] | None,
    axes: _Axes,
    precision: str | None,
) -> Float[Array, "..."]:
    """Compute `dot_product_attention`; queries have `axes.queries`, keys and values `axes.keys`."""
    weights, totals = _softmax(queries, keys, mask, axes, precision)
    weights = weights if dropout_mask is None else weights * dropout_mask
    to_queries = f"{axes.keys},{axes.weights}->{axes.queries}"
    mixed = _product(to_queries, values, weights.astype(values.dtype), precision)
    # Do the softmax's division here, on the smaller array.
    return (mixed / _beside_queries(totals, axes)).astype(values.dtype)


_mix = jax.custom_vjp(_mix_values, nondiff_argnums=(5, 6))


def _softmax(
    queries: Array, keys: Array, mask: Array | None, axes: _Axes, precision: str | None
) -> tuple[Float[Array, "*batch head token query"], Float[Array, "*batch head 1 query"]]:
    """Compute the scores' exponentials, with keys down the columns, and each column's total."""
    formula = f"{axes.keys},{axes.queries}->{axes.weights}"
    return _exponentials(_product(formula, keys, queries, precision), mask, axis=-2)


def _exponentials(scores: Array, mask: Array | None, *, axis: int) -> tuple[Array, Array]:
    """Compute the exponentials of scores, 0 where masked, and their totals over the keys."""
    if mask is not None:
        scores = jnp.where(mask, scores, -jnp.inf)
    weights = jnp.exp(scores - scores.max(axis=axis, keepdims=True))
    return weights, weights.sum(axis=axis, keepdims=True)


def _beside_queries(totals: Float[Array, "*batch head 1 query"], axes: _Axes) -> Array:
    return totals if axes == _COLUMNS else jnp.moveaxis(totals, -1, -3)


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


_mix.defvjp(lambda *inputs: (_mix(*inputs), inputs[:5]), _mix_backward)


@jax.custom_vjp
def _mix_rows(
    queries: Float[Array, "*batch head query dim"],
    keys: Float[Array, "*batch head key dim"],
    values: Float[Array, "*batch head key dim"],
    mask: Bool[Array, "query key"] | None,
    dropout_mask: Float[Array, "*#batch head key query"] | None,
) -> Float[Array, "*batch head query dim"]:
    """Compute `dot_product_attention` by products that are all in bfloat16 (`row_major`)."""
    weights, totals = _softmax_of_rows(queries, keys, mask)
    used = _dropped(weights, dropout_mask).astype(values.dtype)
    mixed = _product("...ij,...jd->...id", used, values)
    return (mixed / totals).astype(values.dtype)


def _softmax_of_rows(queries: Array, keys: Array, mask: Array | None) -> tuple[Array, Array]:
    return _exponentials(_product("...id,...jd->...ij", queries, keys), mask, axis=-1)


def _dropped(weights: Array, dropout_mask: Array | None) -> Array:
    return weights if dropout_mask is None else weights * dropout_mask.swapaxes(-2, -1)


def _mix_rows_backward(inputs: tuple[Any, ...], change: Array) -> tuple[Any, ...]:
    queries, keys, values, mask, dropout_mask = inputs
    weights, totals = _softmax_of_rows(queries, keys, mask)
    change = row_major((change / totals).astype(values.dtype))
    to_weights = _dropped(_product("...id,...jd->...ij", change, values), dropout_mask)
    mean = (weights * to_weights).sum(axis=-1, keepdims=True) / totals
    to_scores = (weights * (to_weights - mean)).astype(keys.dtype)
    used = _dropped(weights, dropout_mask).astype(values.dtype)
    to_values = _product("...ji,...id->...jd", row_major(used.swapaxes(-2, -1)), change)
    to_queries = _product("...ij,...jd->...id", to_scores, keys)
    to_keys = _product("...ji,...id->...jd", row_major(to_scores.swapaxes(-2, -1)), queries)
    nothing = None if dropout_mask is None else jnp.zeros_like(dropout_mask)
    found = (part.astype(queries.dtype) for part in (to_queries, to_keys, to_values))
    return *found, None, nothing


_mix_rows.defvjp(lambda *inputs: (_mix_rows(*inputs), inputs), _mix_rows_backward)
