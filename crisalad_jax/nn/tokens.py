"""What an aggregator makes of an image: the tokens that become a descriptor."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Tokens(NamedTuple):
    """One global token an image, and local ones: SALAD's clusters', or a pyramid's regions'."""

    global_token: Float[Array, "*batch global_dim"]
    local: Float[Array, "*batch token dim"]


def as_sequence(tokens: Tokens, *, global_token: bool) -> Float[Array, "token dim"]:
    """The local tokens, behind the global one cut to their width if it takes part."""
    if not global_token:
        return tokens.local
    pieces = tokens.global_token.reshape(-1, tokens.local.shape[1])
    return jnp.concatenate([pieces, tokens.local])


def from_sequence(
    sequence: Float[Array, "token dim"], before: Tokens, *, global_token: bool
) -> Tokens:
    """Undo `as_sequence`; a global token that took no part is the one from `before`."""
    if not global_token:
        return Tokens(before.global_token, sequence)
    pieces = len(sequence) - len(before.local)
    return Tokens(sequence[:pieces].ravel(), sequence[pieces:])
