"""Entropic optimal transport for aggregation: Sinkhorn in the log domain, with a dustbin.

The iteration is that of Cuturi (NeurIPS 2013), in the form that SALAD (Izquierdo and Civera, CVPR
2024) took from SuperGlue (Sarlin et al., CVPR 2020). Arrays are laid out (..., N, K): N rows
(patches), K columns (clusters, and the dustbin last), which runs faster than the published (K, N).
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from crisalad_jax.config import SinkhornConfig
from crisalad_jax.errors import InputError


class SinkhornResult(NamedTuple):
    """A transport plan and how well it meets its marginals."""

    log_plan: Float[Array, "*batch rows columns"]
    row_error: Float[Array, "*batch"]
    """Largest difference between a row's mass and its marginal, relative to the marginal."""
    column_error: Float[Array, "*batch"]
    """The same for columns. Rows are updated last, so this is the error that iterations lower."""


def append_dustbin(
    scores: Float[Array, "*batch rows clusters"], dustbin: Float[Array, ""]
) -> Float[Array, "*batch rows clusters+1"]:
    """Append a column that holds the dustbin's score (paper Eq. 4)."""
    column = jnp.broadcast_to(dustbin.astype(scores.dtype), (*scores.shape[:-1], 1))
    return jnp.concatenate([scores, column], axis=-1)


def log_marginals(
    rows: int, clusters: int, dtype: jnp.dtype | type = jnp.float32
) -> tuple[Float[Array, " {rows}"], Float[Array, " {clusters}+1"]]:
    """SALAD's marginals, as logarithms: each row has mass 1, each cluster 1, the dustbin the rest.

    Raises:
        InputError: the dustbin's mass, `rows - clusters`, is not positive.
    """
    if rows <= clusters:
        raise InputError(
            f"transport: found {rows} patches for {clusters} clusters, expected more patches than "
            "clusters: the dustbin's mass is their difference"
        )
    log_mu = jnp.zeros(rows, dtype)
    log_nu = jnp.zeros(clusters + 1, dtype).at[-1].set(math.log(rows - clusters))
    return log_mu, log_nu


def marginal_error(
    log_plan: Float[Array, "*batch rows columns"],
    log_mu: Float[Array, "*#batch rows"],
    log_nu: Float[Array, "*#batch columns"],
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Largest relative error of the row masses and of the column masses of a plan."""
    rows = jnp.expm1(jax.nn.logsumexp(log_plan, axis=-1) - log_mu)
    columns = jnp.expm1(jax.nn.logsumexp(log_plan, axis=-2) - log_nu)
    return jnp.abs(rows).max(axis=-1), jnp.abs(columns).max(axis=-1)


def sinkhorn(
    scores: Float[Array, "*batch rows columns"],
    log_mu: Float[Array, "*#batch rows"],
    log_nu: Float[Array, "*#batch columns"],
    *,
    epsilon: float | Float[Array, ""] = 1.0,
    config: SinkhornConfig = SinkhornConfig(),
) -> SinkhornResult:
    """Transport plan of largest <plan, scores> + epsilon * entropy for the given marginals (Eq. 5).

    Alternates the two projections `config.iterations` times, columns first and rows last, from zero
    potentials: the published algorithm, so that few iterations give the published plan. `epsilon`
    is an argument of its own, not read from `config`, so that it may be traced or learnt.
    """
    kernel = scores / epsilon
    row_potential = jnp.zeros_like(kernel[..., :, 0])
    column_potential = jnp.zeros_like(kernel[..., 0, :])
    for _ in range(config.iterations):
        column_potential = log_nu - jax.nn.logsumexp(kernel + row_potential[..., None], axis=-2)
        row_potential = log_mu - jax.nn.logsumexp(kernel + column_potential[..., None, :], axis=-1)
    log_plan = kernel + row_potential[..., None] + column_potential[..., None, :]
    return SinkhornResult(log_plan, *marginal_error(log_plan, log_mu, log_nu))


def assign(
    scores: Float[Array, "*batch patches clusters"],
    dustbin: Float[Array, ""],
    config: SinkhornConfig = SinkhornConfig(),
) -> SinkhornResult:
    """SALAD's assignment of patches to clusters, the dustbin in the last column.

    Raises:
        InputError: no more patches than clusters.
    """
    log_mu, log_nu = log_marginals(*scores.shape[-2:], dtype=scores.dtype)
    full = append_dustbin(scores, dustbin)
    return sinkhorn(full, log_mu, log_nu, epsilon=config.epsilon, config=config)
