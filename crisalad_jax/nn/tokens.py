"""The tokens that an aggregator makes from an image, and that become its descriptor."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from crisalad_jax.config.short_repr import brief


class TransportStatistics(NamedTuple):
    """Statistics of a transport plan, for logging."""

    marginal_error: Float[Array, "*batch"]
    """Largest relative error of the mass of a column: a cluster or the dustbin."""
    dustbin_share: Float[Array, "*batch"]
    """Share of the patches' mass that went to the dustbin."""
    patches_per_cluster: Float[Array, "*batch"]
    """Effective number of patches per cluster, exp(entropy of its mass), averaged over clusters."""


@brief
class Tokens(NamedTuple):
    """One global token per image, and local tokens: SALAD's clusters, or a pyramid's regions.

    Example:
        >>> import jax.numpy as jnp
        >>> Tokens.of_local(jnp.ones((4, 8))).global_token.shape
        (0,)
    """

    global_token: Float[Array, "*batch global_dim"]
    local: Float[Array, "*batch token dim"]
    transport: TransportStatistics | None = None
    """Statistics of the transport; None without a transport, or after the cross-image encoder."""
    dense: Float[Array, "*batch feature local"] | None = None
    """Local features of an image for a loss that compares them (SelaVPR); only in training."""

    @classmethod
    def of_global(cls, token: Float[Array, "*batch dim"]) -> "Tokens":
        """Return a global token, and an empty array of local tokens of its width."""
        return cls(token, token[..., None, :][..., :0, :])

    @classmethod
    def of_local(cls, tokens: Float[Array, "*batch token dim"]) -> "Tokens":
        """Return local tokens, and a global token of width 0."""
        return cls(tokens[..., 0, :0], tokens)


def as_sequence(tokens: Tokens, *, global_token: bool) -> Float[Array, "*batch token dim"]:
    """Join the global token (if `global_token`), cut to the local width, and the local tokens."""
    if not global_token:
        return tokens.local
    *batch, _, dim = tokens.local.shape
    pieces = tokens.global_token.reshape(*batch, tokens.global_token.shape[-1] // dim, dim)
    return jnp.concatenate([pieces, tokens.local], axis=-2)


def from_sequence(
    sequence: Float[Array, "*batch token dim"], before: Tokens, *, global_token: bool
) -> Tokens:
    """Undo `as_sequence`; a global token that is not in the sequence is taken from `before`."""
    if not global_token:
        return Tokens(before.global_token, sequence)
    pieces = sequence.shape[-2] - before.local.shape[-2]
    first, local = sequence[..., :pieces, :], sequence[..., pieces:, :]
    return Tokens(first.reshape(before.global_token.shape), local)
