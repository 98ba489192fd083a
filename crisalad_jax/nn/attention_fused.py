"""Fused self-attention on accelerators, which never writes scores to memory.

It uses cuDNN on a GPU in bfloat16, and `attention_pallas` on a TPU.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from crisalad_jax.nn.products import rule_precision
from crisalad_jax.utils.target import target, traced_mesh

_EIGHT = 8
"""Tokens, and dimensions of a head, come in multiples of this for fused attention. cuDNN needs even
numbers of tokens for training, and multiples of 8 keep every row aligned. On a TPU such sequences
already are rows of one matrix; others are copied before and after each product."""
_CUDNN_HEAD = 128
"""Widest head that cuDNN's attention supports on every GPU that has it."""


def padded_length(tokens: int, dtype: Any, dim: int, heads: int) -> int:
    """Return the length to pad a sequence to for fused attention; `tokens` if it is not fused.

    Example:
        >>> from crisalad_jax.utils.target import CPU, lowering_for
        >>> with lowering_for(CPU):
        ...     padded_length(257, jnp.float32, 768, 12)
        257
    """
    whole = -(-tokens // _EIGHT) * _EIGHT
    fused = _takes_cudnn(dtype, dim // heads) or _takes_pallas(whole, dtype, dim, heads)
    return whole if fused else tokens


def attend(
    qkv: Float[Array, "*batch token three_heads dim"], length: int
) -> Float[Array, "*batch token head dim"] | None:
    """Average the values for each query, weighted by the softmax of its scores.

    Args:
        qkv: the heads of the queries, then those of the keys, then those of the values.
        length: number of leading tokens that are not padding; only these are attended to.

    Returns:
        The averages; None if this platform has no kernel for this type, width and token count.
    """
    *batch, tokens, three_heads, width = qkv.shape
    heads = three_heads // 3
    sequences = qkv.reshape(-1, tokens, three_heads, width)
    if _takes_cudnn(qkv.dtype, width):
        mixed = _cudnn(sequences, length)
    elif _takes_pallas(tokens, qkv.dtype, heads * width, heads):
        from crisalad_jax.nn import attention_pallas  # Pallas is slow to import

        mesh = traced_mesh()
        if mesh is None or sequences.shape[0] % mesh.size:
            return None
        flat = sequences.reshape(-1, tokens, three_heads * width)
        precision = rule_precision(qkv.dtype)
        mixed = attention_pallas.attend(flat, heads, length, precision, mesh)
    else:
        return None
    return mixed.reshape(*batch, tokens, heads, width)


def _takes_cudnn(dtype: Any, head: int) -> bool:
    fits = dtype == jnp.bfloat16 and head % _EIGHT == 0 and head <= _CUDNN_HEAD
    return target().cudnn and fits


def _takes_pallas(tokens: int, dtype: Any, dim: int, heads: int) -> bool:
    if target().platform != "tpu":
        return False
    from crisalad_jax.nn import attention_pallas

    return attention_pallas.fits(tokens, dim, heads, dtype)


def _cudnn(
    qkv: Float[Array, "sequence token three_heads dim"], length: int
) -> Float[Array, "sequence token head dim"]:
    count, tokens, *_ = qkv.shape
    more = -tokens % _EIGHT
    qkv = jnp.pad(qkv, ((0, 0), (0, more), (0, 0), (0, 0)))
    # Queries of padding attend like all others, which keeps their values finite.
    lengths = None if length == tokens + more else jnp.full(count, length, jnp.int32)
    mixed = jax.nn.dot_product_attention(
        *jnp.split(qkv, 3, axis=-2), key_value_seq_lengths=lengths, implementation="cudnn"
    )
    return mixed[:, :tokens]
