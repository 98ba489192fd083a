"""Multi-head attention: its projections, and matrix products laid out to suit the platform.

On an accelerator, self-attention is fused if a kernel supports it (`attention_fused`).
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
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
from crisalad_jax.nn.products import (
    keep,
    map_first_axis,
    product_precision,
    row_major,
    rule_precision,
)
from crisalad_jax.utils.devices import image_mesh
from crisalad_jax.utils.pytree import pytree_dataclass
from crisalad_jax.utils.target import target

Heads = Float[Array, "*batch token head dim"]
"""Queries, keys or values, split into heads."""


@pytree_dataclass
class Attention:
    """The joint projection to query, key and value, in this order, and the output projection."""

    qkv: Linear
    proj: Linear


class Rotation(NamedTuple):
    """Rotary (RoPE) angles of a sequence's last tokens, one per pair of a head's dimensions."""

    cosines: Float[np.ndarray, "patch pair"]
    sines: Float[np.ndarray, "patch pair"]


def init_torch_attention(qkv_key: PRNGKeyArray, proj_key: PRNGKeyArray, dim: int) -> Attention:
    """Draw parameters like torch's `nn.MultiheadAttention`: Glorot-uniform qkv, zero biases."""
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
        x: tokens of a sequence or a batch.
        heads: number of heads, a divisor of `dim`.
        length: number of leading tokens that are not padding; only these are attended to. None
            means all. See `attention_fused.padded_length`.
        rotation: angles by which queries and keys are rotated; None rotates none.
        update: function that returns what an adapter adds to a projection's output, if anything.

    Returns:
        The attention's output. Scores and softmax are in at least float32, for every type of `x`.
    """
    tokens = x.shape[-2]
    length = tokens if length is None else length
    projected = adapted_linear("qkv", params.qkv, x, update)
    qkv = split_heads(keep(projected, "qkv"), 3 * heads)
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
    """Split the last axis into `heads` consecutive parts, along a new axis before it."""
    return x.reshape(*x.shape[:-1], heads, x.shape[-1] // heads)


def rotate(x: Heads, rotation: Rotation, *, length: int | None = None) -> Heads:
    """Rotate queries or keys by the angles of their tokens (RoPE: Su et al. 2021), in float32.

    Dimensions i and i + dim / 2 of a head are a pair. The first `length` tokens are not padding
    (None: all); the last of these have angles. All other tokens are returned unchanged.
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
    """Attend from queries, one set per sequence or one for the batch, to the tokens of `x`.

    Scores, softmax and parameters are as in `attention`.
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
    """Compute the first token's weights in `attention`, over all tokens, in at least float32.

    The weights of a head sum to 1. `rotation` rotates only keys: the first token has no angle.
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
    """Compute the weights in `attention` of all pairs of tokens, in at least float32.

    Each row sums to 1. `mask[i, j]` allows token i to attend to token j; None allows all.
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
    """Compute only the queries (`number` 0), keys (1) or values (2), heads concatenated."""
    here = slice(number * x.shape[-1], (number + 1) * x.shape[-1])
    y, extra = linear(columns(params.qkv, here.start, here.stop), x), update("qkv", x)
    return y if extra is None else y + extra[..., here]


class _Axes(NamedTuple):
    """Axes for `jnp.einsum`: i for queries, j for keys, h for heads, d for dimensions of a head."""

    queries: str
    keys: str
    scores: str


# Every product is a plain batched one in memory order, which the CPU's libraries support.
_HEADS_FIRST = _Axes("h...id", "h...jd", "h...ij")
# As the linear layer leaves them: an accelerator's compiler gains nothing from copies.
_HEADS_LAST = _Axes("...ihd", "...jhd", "...hij")


_SCORES = 2**20
"""Attention scores that a CPU computes at once: more don't stay in its cache. With this
limit, images of 518 x 518 are 1.5 to 2.2 times as fast, batches of 224 x 224 0.94 to 1.22 times
(docs/performance-studies.md, Growth)."""


def dot_product_attention(
    queries: Float[Array, "*batch query head dim"],
    keys: Float[Array, "*batch key head dim"],
    values: Float[Array, "*batch key head dim"],
    *,
    mask: Bool[Array, "query key"] | None = None,
    dropout_mask: Float[Array, "*#batch head key query"] | None = None,
) -> Float[Array, "*batch query head dim"]:
    """Average the values for each query, weighted by softmax(scores) times the dropout mask.

    The gradient is a custom rule. JAX's own would recompute the result, and order the products so
    that they take twice as long on a CPU. Forward mode (`jax.jvp`) is not supported.

    Args:
        queries: queries, which this function divides by the square root of their width.
        keys: keys of the tokens that queries attend to.
        values: values of the same tokens.
        mask: `mask[i, j]` allows query i to attend to key j; a row must allow at least one.
        dropout_mask: factors of the weights, each 0 (dropped) or above 1; None drops nothing.
    """
    queries = queries / math.sqrt(queries.shape[-1])
    dropped = None if dropout_mask is None else dropout_mask.swapaxes(-2, -1)
    precision = rule_precision(queries.dtype)
    if target().platform != "cpu":
        return _mix(queries, keys, values, mask, dropped, _HEADS_LAST, precision)
    heads_first = (row_major(jnp.moveaxis(x, -2, 0)) for x in (queries, keys, values))
    if dropped is not None:
        dropped = jnp.moveaxis(jnp.expand_dims(dropped, range(queries.ndim - dropped.ndim)), -3, 0)
    return jnp.moveaxis(_mix(*heads_first, mask, dropped, _HEADS_FIRST, precision), 0, -2)


def _product(formula: str, a: Array, b: Array, precision: Any = None) -> Array:
    wide = jnp.promote_types(a.dtype, jnp.float32)
    return jnp.einsum(formula, a, b, precision=precision, preferred_element_type=wide)


def _mix_values(
    queries: Float[Array, "..."],
    keys: Float[Array, "..."],
    values: Float[Array, "..."],
    mask: Bool[Array, "query key"] | None,
    dropout_mask: Float[Array, "..."] | None,
    axes: _Axes,
    precision: str | None,
) -> Float[Array, "..."]:
    """Compute `dot_product_attention` of arrays with `axes`; on a CPU, some scores at a time."""

    def mix(queries: Array, keys: Array, values: Array, dropped: Array | None) -> Array:
        weights, totals = _softmax(queries, keys, mask, axes, precision)
        used = weights if dropped is None else weights * dropped
        formula = f"{axes.scores},{axes.keys}->{axes.queries}"
        mixed = _product(formula, used.astype(values.dtype), values, precision)
        # Do the softmax's division here, on the smaller array.
        return (mixed / _beside_queries(totals, axes)).astype(values.dtype)

    mesh = image_mesh()
    of_device = math.prod(queries.shape[:-1]) * keys.shape[-2] // (mesh.size if mesh else 1)
    if axes == _HEADS_LAST or of_device <= _SCORES:
        return mix(queries, keys, values, dropout_mask)

    def mix_head(*parts: Array | None) -> Array:
        return mix(*jax.tree.map(lambda part: part[None], parts))[0]

    # A batch may be sharded over devices, so the queries of a head are split instead.
    cut = min(queries.shape[-2], -(-of_device // (len(queries) * _SCORES)))
    if cut == 1 or mask is not None or dropout_mask is not None:
        parts = queries, keys, values, dropout_mask
        return map_first_axis(lambda parts: mix_head(*parts), parts)
    *outer, rows, dim = queries.shape
    around = [(0, 0)] * len(outer) + [(0, -rows % cut), (0, 0)]
    tiles = jnp.moveaxis(jnp.pad(queries, around).reshape(*outer, cut, -1, dim), -3, 1)

    def mix_tiles(head: tuple[Array, Array, Array]) -> Array:
        tiles, keys, values = head
        return map_first_axis(lambda tile: mix_head(tile, keys, values, None), tiles)

    mixed = jnp.moveaxis(map_first_axis(mix_tiles, (tiles, keys, values)), 1, -3)
    return mixed.reshape(*outer, -1, dim)[..., :rows, :]


_mix = jax.custom_vjp(_mix_values, nondiff_argnums=(5, 6))


def _softmax(
    queries: Array, keys: Array, mask: Array | None, axes: _Axes, precision: str | None
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Compute the scores' exponentials, 0 where masked, and their totals over the keys."""
    scores = _product(f"{axes.queries},{axes.keys}->{axes.scores}", queries, keys, precision)
    if mask is not None:
        scores = jnp.where(mask, scores, -jnp.inf)
    weights = jnp.exp(scores - scores.max(axis=-1, keepdims=True))
    return weights, weights.sum(axis=-1, keepdims=True)


def _beside_queries(totals: Float[Array, "*batch head query 1"], axes: _Axes) -> Array:
    return totals if axes == _HEADS_FIRST else jnp.moveaxis(totals, -3, -2)


def _mix_backward(
    axes: _Axes, precision: str | None, inputs: tuple[Any, ...], change: Array
) -> tuple[Any, ...]:
    queries, keys, values, mask, dropout_mask = inputs
    product = functools.partial(_product, precision=precision)
    order = row_major if axes == _HEADS_FIRST else lambda x: x
    weights, totals = _softmax(queries, keys, mask, axes, precision)
    change = order((change / _beside_queries(totals, axes)).astype(values.dtype))
    to_weights = product(f"{axes.queries},{axes.keys}->{axes.scores}", change, values)
    used = weights
    if dropout_mask is not None:
        to_weights, used = to_weights * dropout_mask, weights * dropout_mask
    mean = (weights * to_weights).sum(axis=-1, keepdims=True) / totals
    to_scores = (weights * (to_weights - mean)).astype(keys.dtype)

    def over_queries(by_query: Array, x: Array) -> Array:
        by_key = order(by_query.swapaxes(-2, -1))
        turned = f"{axes.scores[:-2]}ji"
        return product(f"{turned},{axes.queries}->{axes.keys}", by_key, x)

    to_values = over_queries(used.astype(values.dtype), change)
    to_queries = product(f"{axes.scores},{axes.keys}->{axes.queries}", to_scores, keys)
    to_keys = over_queries(to_scores, queries)
    nothing = None if dropout_mask is None else jnp.zeros_like(dropout_mask)
    found = (part.astype(queries.dtype) for part in (to_queries, to_keys, to_values))
    return *found, None, nothing


_mix.defvjp(lambda *inputs: (_mix(*inputs), inputs[:5]), _mix_backward)
