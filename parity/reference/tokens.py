"""The output of an aggregator: tokens that become descriptors."""

from typing import NamedTuple

import torch
from torch import Tensor


class Tokens(NamedTuple):
    """One global token per image, and local ones: of clusters, or of regions of a pyramid."""

    global_token: Tensor
    """(batch, global_dim)."""
    local: Tensor
    """(batch, token, dim)."""

    @classmethod
    def of_global(cls, token: Tensor) -> "Tokens":
        """Make tokens from (batch, dim), with no local tokens of that width."""
        return cls(token, token.new_zeros(len(token), 0, token.shape[1]))

    @classmethod
    def of_local(cls, tokens: Tensor) -> "Tokens":
        """Make tokens from (batch, token, dim), with an empty global token."""
        return cls(tokens.new_zeros(len(tokens), 0), tokens)


def as_sequence(tokens: Tokens, *, global_token: bool) -> Tensor:
    """Prepend the global token, cut to the local width, to the local tokens if it takes part."""
    if not global_token:
        return tokens.local
    pieces = tokens.global_token.unflatten(1, (-1, tokens.local.shape[-1]))
    return torch.cat([pieces, tokens.local], dim=1)


def from_sequence(sequence: Tensor, before: Tokens, *, global_token: bool) -> Tokens:
    """Undo `as_sequence`; a global token that took no part is the one from `before`."""
    if not global_token:
        return Tokens(before.global_token, sequence)
    pieces = sequence.shape[1] - before.local.shape[1]
    return Tokens(sequence[:, :pieces].flatten(1), sequence[:, pieces:])
