"""Self-attention that is fused on accelerators, so that scores never reach the memory.

It is cuDNN's on a GPU in bfloat16, and that of `attention_pallas` on a TPU.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from crisalad_jax.nn.products import rule_precision
from crisalad_jax.utils.target import target, traced_mesh

_EIGHT = 8
"""Number that fused attention takes multiples of, of tokens and of a head's numbers. For training
cuDNN needs even numbers of tokens, and eights keep every row aligned. On a TPU sequences of eights
are rows of one matrix as they are; others are copied on the way to each product and back."""
_CUDNN_HEAD = 128
"""Widest head that cuDNN's attention takes on every GPU that has it."""


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


def attend(
    qkv: Float[Array, "*batch token three_heads dim"], length: int
) -> Float[Array, "*batch token head dim"] | None:
    """Average the values for every query, weighted by its scores' softmax.

    Args:
        qkv: the heads of queries, of keys and of values.
        length: number of first tokens that are not padding, to which alone tokens attend.

    Returns:
        The averages; None where no kernel takes such tokens.
    """
    *batch, tokens, three_heads, width = qkv.shape
    heads = three_heads // 3
    sequences = qkv.reshape(-1, tokens, three_heads, width)
    if _takes_cudnn(qkv.dtype, width):
        mixed = _cudnn(sequences, length)
    elif _takes_pallas(tokens, qkv.dtype, heads * width, heads):
        from crisalad_jax.nn import attention_pallas  # Pallas takes long to import

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
    # Queries of padding attend as others do, which keeps their numbers finite.
    lengths = None if length == tokens + more else jnp.full(count, length, jnp.int32)
    mixed = jax.nn.dot_product_attention(
        *jnp.split(qkv, 3, axis=-2), key_value_seq_lengths=lengths, implementation="cudnn"
    )
    return mixed[:, :tokens]
