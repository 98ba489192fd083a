"""Multi-head attention, with DINOv2's parameter names and with torch's."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from parity.reference.layers import Linear, at_least_float32


def attend(qkv: Tensor, heads: int, *, mask: Tensor | None, dropout_rate: float) -> Tensor:
    """Compute scaled dot-product attention (Vaswani et al. 2017).

    Args:
        qkv: (batch, token, 3 dim): queries, keys and values, in this order.
        heads: number of heads.
        mask: (token, token) of bool: `mask[i, j]` is whether token i may attend to token j.
        dropout_rate: of the attention weights.

    Returns:
        (batch, token, dim), in the type of `qkv`. Scores and softmax are at least float32.
    """
    # Each (batch, head, token, head_dim).
    queries, keys, values = qkv.unflatten(-1, (3, heads, -1)).permute(2, 0, 3, 1, 4).unbind()
    scores = at_least_float32(queries / math.sqrt(queries.shape[-1])) @ at_least_float32(keys).mT
    if mask is not None:
        scores = scores.masked_fill(~mask, -torch.inf)
    weights = F.dropout(scores.softmax(dim=-1), dropout_rate)
    mixed = weights.to(qkv.dtype) @ values
    return mixed.transpose(1, 2).flatten(2)


class Attention(nn.Module):
    """DINOv2's attention: `qkv`, then `proj`."""

    def __init__(self, dim: int, heads: int) -> None:
        """Make attention of width `dim`, a multiple of `heads`."""
        super().__init__()
        self.heads = heads
        self.qkv = Linear(dim, 3 * dim)
        self.proj = Linear(dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        """Map (batch, token, dim) to the same shape; all tokens attend to all."""
        return self.proj(attend(self.qkv(x), self.heads, mask=None, dropout_rate=0.0))


class MultiheadAttention(nn.Module):
    """`torch.nn.MultiheadAttention`: `in_proj_weight` and `in_proj_bias`, then `out_proj`."""

    def __init__(self, dim: int, heads: int, dropout: float) -> None:
        """Initialise like torch: Glorot-uniform input projections, zero biases."""
        super().__init__()
        self.heads = heads
        self.dropout = dropout
        self.in_proj_weight = nn.Parameter(nn.init.xavier_uniform_(torch.empty(3 * dim, dim)))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * dim))
        self.out_proj = Linear(dim, dim)
        nn.init.zeros_(self.out_proj.bias)

    def forward(self, x: Tensor, mask: Tensor | None) -> Tensor:
        """Map (batch, token, dim) to the same shape, with `mask` (token, token)."""
        qkv = F.linear(x, self.in_proj_weight.to(x.dtype)) + self.in_proj_bias.to(x.dtype)
        rate = self.dropout if self.training else 0.0
        return self.out_proj(attend(qkv, self.heads, mask=mask, dropout_rate=rate))
