"""Self-attention on a TPU: one kernel forward and one backward, in Pallas.

The kernels read queries, keys and values where the linear layer left them, side by side, and write
the heads side by side. XLA's own attention would copy all of these, with the heads in front, and
pad an odd number of tokens by half. Scores never leave the chip: the backward kernel recomputes
them from its inputs, and nothing else is stored. Written from Vaswani et al. 2017 and the idea of
Dao et al. 2022, without their online softmax: all keys of an image fit on the chip.
"""

import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import tpu as pltpu
from jax.sharding import AbstractMesh, Mesh, PartitionSpec
from jaxtyping import Array, Float

_LANES = 128
"""Values in a row of a vector register: heads are read that many values at a time."""
_WIDTH = 512
"""Maximum number of values per token and step, all heads together: wide steps wait less."""
_PIECES = 12
"""Maximum number of score products that a step is unrolled into: more take minutes to compile. A
step has at least one unit of lanes."""
_ROWS = 384
"""Maximum number of queries whose scores are computed at a time."""
_TOKENS = {jnp.dtype(jnp.bfloat16): 2048, jnp.dtype(jnp.float32): 640}
"""Maximum number of tokens by type: their scores for `_ROWS` queries are 3 MiB. In float32, more
tokens take minutes to compile."""
_MEMORY = 2**26
"""Bytes of a chip's vector memory that a kernel may use: half of the smallest chip's since v5e."""

Kernel = Callable[..., None]


def fits(tokens: int, dim: int, heads: int, dtype: Any) -> bool:
    """Return whether the kernels support sequences of this length, width, head count and type."""
    head = dim // heads
    whole = (_LANES % head == 0 or head % _LANES == 0) and dim % max(_LANES, head) == 0
    return head >= 32 and whole and tokens <= _TOKENS.get(jnp.dtype(dtype), 0)


def attend(
    qkv: Float[Array, "batch token three_dims"],
    heads: int,
    length: int,
    precision: str | None,
    mesh: Mesh | AbstractMesh,
) -> Float[Array, "batch token dim"]:
    """Average the values of each sequence for each query, weighted by the softmax of its scores.

    Args:
        qkv: queries, keys and values side by side, each with the heads side by side.
        heads: number of heads; see `fits`.
        length: number of leading tokens that are not padding; only these are attended to.
        precision: precision of float32 products. None means "default", one bfloat16 pass. The
            kernel compiler does not support "high", so "highest" replaces it.
        mesh: devices that the batch is sharded over, from `traced_mesh`.

    Returns:
        The averages, with the heads side by side.
    """

    run = functools.partial(_call, heads=heads, length=length, precision=precision)

    def forward(qkv: Array) -> Array:
        batch, tokens, width = qkv.shape
        shape = jax.ShapeDtypeStruct((batch, tokens, width // 3), qkv.dtype)
        return run(_forward_kernel, shape, qkv, products=2)

    def backward(qkv: Array, change: Array) -> Array:
        three = [jax.ShapeDtypeStruct(change.shape, qkv.dtype)] * 3
        return jnp.concatenate(run(_backward_kernel, three, qkv, change, products=5), axis=-1)

    average = jax.custom_vjp(_over_batches(forward, mesh))
    average.defvjp(
        lambda qkv: (average(qkv), qkv),
        lambda qkv, change: (_over_batches(backward, mesh)(qkv, change),),
    )
    return average(qkv)


def _over_batches(call: Callable[..., Array], mesh: Mesh | AbstractMesh) -> Callable[..., Array]:
    """Compute each sequence on the device that holds it."""
    if mesh.size == 1:
        return call
    over = PartitionSpec(mesh.axis_names)
    # Kernels don't declare over which devices their results vary, which the check would need.
    return jax.shard_map(call, mesh=mesh, in_specs=over, out_specs=over, check_vma=False)


def _call(
    kernel: Kernel,
    shapes: Any,
    qkv: Array,
    *others: Array,
    heads: int,
    length: int,
    precision: str | None,
    products: int,
) -> Any:
    """Run a kernel for each sequence, and for as many heads at a time as `_WIDTH` holds."""
    batch, tokens, three = qkv.shape
    dim = three // 3
    head = dim // heads
    unit = max(_LANES, head)
    pieces = unit // head * -(-tokens // _ROWS)
    # A float32 product is six bfloat16 products.
    most = min(_WIDTH // unit, _PIECES // pieces) if qkv.dtype == jnp.bfloat16 else 1
    width = unit * max(n for n in range(1, max(1, most) + 1) if dim // unit % n == 0)
    steps = dim // width

    def part(number: int) -> pl.BlockSpec:
        """Take queries (0), keys (1) or values (2); or anything as wide as one of these (0)."""
        return pl.BlockSpec((1, tokens, width), lambda b, step: (b, 0, number * steps + step))

    single = qkv.dtype == jnp.bfloat16 or precision in (None, "default")
    passes = jax.lax.Precision.DEFAULT if single else jax.lax.Precision.HIGHEST
    out = part(0)
    return pl.pallas_call(
        functools.partial(kernel, head=head, length=length, precision=passes),
        grid=(batch, steps),
        in_specs=[part(0), part(1), part(2), *(part(0) for _ in others)],
        out_specs=[out] * len(shapes) if isinstance(shapes, list) else out,
        out_shape=shapes,
        compiler_params=pltpu.CompilerParams(
            dimension_semantics=("parallel", "parallel"), vmem_limit_bytes=_MEMORY
        ),
        cost_estimate=pl.CostEstimate(
            flops=2 * products * batch * tokens**2 * dim,
            bytes_accessed=2 * qkv.size * qkv.dtype.itemsize,
            transcendentals=batch * heads * tokens**2,
        ),
    )(qkv, qkv, qkv, *others)


def _forward_kernel(
    queries: Any, keys: Any, values: Any, out: Any, *, head: int, length: int, precision: Any
) -> None:
    dot = functools.partial(_dot, precision=precision)
    for lanes in _heads(queries, head):
        k, v = keys[0, :length, lanes], values[0, :length, lanes]
        for rows in _chunks(queries):
            weights, totals = _softmax(dot(queries[0, rows, lanes], k, (1, 1)), head)
            mixed = dot(weights.astype(v.dtype), v, (1, 0))
            # Do the softmax's division here, on the smaller array.
            out[0, rows, lanes] = (mixed / totals).astype(out.dtype)


def _backward_kernel(
    queries: Any,
    keys: Any,
    values: Any,
    change: Any,
    to_queries: Any,
    to_keys: Any,
    to_values: Any,
    *,
    head: int,
    length: int,
    precision: Any,
) -> None:
    dot = functools.partial(_dot, precision=precision)
    for lanes in _heads(queries, head):
        k, v = keys[0, :length, lanes], values[0, :length, lanes]
        k_sum = v_sum = jnp.zeros(k.shape, jnp.float32)
        for rows in _chunks(queries):
            q, g = queries[0, rows, lanes], change[0, rows, lanes]
            weights, totals = _softmax(dot(q, k, (1, 1)), head)
            weights = weights / totals
            to_weights = dot(g, v, (1, 1))
            mean = (weights * to_weights).sum(axis=-1, keepdims=True)
            to_scores = weights * (to_weights - mean) / math.sqrt(head)
            to_scores = to_scores.astype(q.dtype)
            to_queries[0, rows, lanes] = dot(to_scores, k, (1, 0)).astype(to_queries.dtype)
            k_sum += dot(to_scores, q, (0, 0))
            v_sum += dot(weights.astype(g.dtype), g, (0, 0))
        for out, slope in ((to_keys, k_sum), (to_values, v_sum)):
            out[0, :length, lanes] = slope.astype(out.dtype)
            if length < out.shape[1]:
                padding = out.shape[1] - length, head
                out[0, length:, lanes] = jnp.zeros(padding, out.dtype)


def _softmax(products: Array, head: int) -> tuple[Array, Array]:
    """Return each row's exponentials, and their total."""
    scores = products / math.sqrt(head)
    weights = jnp.exp(scores - scores.max(axis=-1, keepdims=True))
    return weights, weights.sum(axis=-1, keepdims=True)


def _dot(a: Array, b: Array, axes: tuple[int, int], *, precision: Any) -> Array:
    """Multiply matrices over one axis of each, in float32."""
    over = ((axes[0],), (axes[1],)), ((), ())
    return jax.lax.dot_general(a, b, over, precision=precision, preferred_element_type=jnp.float32)


def _heads(block: Any, head: int) -> Iterator[slice]:
    return (slice(start, start + head) for start in range(0, block.shape[-1], head))


def _chunks(block: Any) -> Iterator[slice]:
    """Split tokens into equal parts of at most `_ROWS`, at multiples of a register's 16 rows."""
    tokens = block.shape[1]
    size = -(-tokens // (16 * -(-tokens // _ROWS))) * 16
    return (slice(start, min(start + size, tokens)) for start in range(0, tokens, size))
