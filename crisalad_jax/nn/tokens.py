"""What an aggregator makes of an image: the tokens that become a descriptor."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class TransportStatistics(NamedTuple):
    """How SALAD's transport went, for a log."""

    column_error: Float[Array, "*batch"]
    """Largest relative error of a cluster's mass."""
    dustbin_share: Float[Array, "*batch"]
    """Share of all mass that went to the dustbin."""
    patches_per_cluster: Float[Array, "*batch"]
    """Effective number of patches in a cluster: the exponential of its mass's entropy, the mean."""


class Tokens(NamedTuple):
    """One global token an image, and local ones: SALAD's clusters', or a pyramid's regions'."""

    global_token: Float[Array, "*batch global_dim"]
    local: Float[Array, "*batch token dim"]
    transport: TransportStatistics | None = None
    """An image's; None where there is no transport, or other images have been looked at since."""


def global_alone(token: Float[Array, "*batch dim"]) -> Tokens:
    """A global token, and no local ones of its width."""
    return Tokens(token, token[..., None, :][..., :0, :])


def local_alone(tokens: Float[Array, "*batch token dim"]) -> Tokens:
    """Local tokens, and a global one of no numbers."""
    return Tokens(tokens[..., 0, :0], tokens)


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
