"""Sinkhorn divergence between two sets of tokens, with the gradient of the envelope theorem."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from crisalad_jax.config.checks import require
from crisalad_jax.nn.transport.config import SinkhornConfig
from crisalad_jax.nn.transport.problem import LOG_ZERO, product
from crisalad_jax.nn.transport.solve import per_problem, solve


def sinkhorn_divergence(
    x: Float[Array, "*batch x_token dim"],
    y: Float[Array, "*batch y_token dim"],
    *,
    log_mu: Float[Array, "*#batch x_token"] | None = None,
    log_nu: Float[Array, "*#batch y_token"] | None = None,
    epsilon: float | Float[Array, "*#batch"] = 0.1,
    config: SinkhornConfig = SinkhornConfig(tolerance=1e-4, iterations=500, gradient="stop"),
) -> Float[Array, "*batch"]:
    """Compute the Sinkhorn divergence of two sets of tokens (Feydy et al., AISTATS 2019).

    It is OT(x, y) - (OT(x, x) + OT(y, y)) / 2, where OT is the least <plan, cost> + epsilon *
    KL(plan | product of the masses) for squared Euclidean costs |x - y|^2. It is 0 for equal sets,
    never negative at convergence, and nears the squared Wasserstein distance as epsilon falls.

    The gradient is Danskin's: potentials are constants, as they maximise the dual. It is exact at
    convergence, needs no iteration's memory, and cannot be differentiated again.

    Args:
        x: tokens of one image of each pair.
        y: tokens of the other, of the same width.
        log_mu: logarithms of the masses of `x`, -inf for a token that does not count; by default
            all are equal. They are normalised to sum to 1.
        log_nu: the same of `y`.
        epsilon: entropic regularisation, in units of the cost.
        config: the solver, of which the potentials alone are used.

    Returns:
        The divergence of each pair, in float32 at least.

    Raises:
        InputError: tokens of other widths or batches, or what `solve` raises.

    Example:
        >>> x = jnp.eye(3)
        >>> float(sinkhorn_divergence(x, x)), round(float(sinkhorn_divergence(x, x + 1)), 3)
        (0.0, 3.0)
    """
    x, y = (jnp.asarray(side) for side in (x, y))
    fits = x.ndim == y.ndim >= 2 and x.shape[-1:] == y.shape[-1:] and x.shape[:-2] == y.shape[:-2]
    require(
        fits,
        f"sinkhorn_divergence: found tokens of shapes {x.shape} and {y.shape}, expected "
        "(..., tokens, dim) with the same batch and dim",
    )
    wide = jnp.promote_types(jnp.promote_types(x.dtype, y.dtype), jnp.float32)
    sides = [
        (side.astype(wide), _normalised(side, masses).astype(wide))
        for side, masses in ((x, log_mu), (y, log_nu))
    ]

    def transport(first: tuple[Array, Array], second: tuple[Array, Array]) -> Array:
        (tokens, log_mu), (others, log_nu) = first, second
        cost = squared_distances(tokens, others)
        fixed = jax.lax.stop_gradient((-cost, log_mu, log_nu))
        at = jax.lax.stop_gradient(epsilon)
        row, column = solve(*fixed, epsilon=at, config=config).potentials
        # The dual's potentials count from the masses.
        f = jax.lax.stop_gradient(_from_masses(row, log_mu))
        g = jax.lax.stop_gradient(_from_masses(column, log_nu))
        mu, nu = jnp.exp(log_mu), jnp.exp(log_nu)
        kernel = -cost / per_problem(jnp.asarray(epsilon, wide), 2)
        shares = jnp.exp(kernel + f[..., :, None] + g[..., None, :])
        total = product("...n,...nk,...k->...", mu, shares, nu)
        return epsilon * ((mu * f).sum(axis=-1) + (nu * g).sum(axis=-1) + 1 - total)

    selves = [transport(side, side) for side in sides]
    return transport(*sides) - (selves[0] + selves[1]) / 2


def squared_distances(
    x: Float[Array, "*batch x_token dim"], y: Float[Array, "*batch y_token dim"]
) -> Float[Array, "*batch x_token y_token"]:
    """Return |x_n - y_k|^2 for all pairs of tokens, at least 0."""
    squares = [(side**2).sum(axis=-1) for side in (x, y)]
    inner = product("...nd,...kd->...nk", x, y)
    return jnp.maximum(squares[0][..., :, None] + squares[1][..., None, :] - 2 * inner, 0)


def _normalised(tokens: Array, log_masses: Array | None) -> Array:
    shape = tokens.shape[:-1]
    if log_masses is None:
        return jnp.full(shape, -math.log(shape[-1]))
    return jnp.broadcast_to(jax.nn.log_softmax(jnp.asarray(log_masses), axis=-1), shape)


def _from_masses(potential: Array, log_mass: Array) -> Array:
    empty = log_mass < LOG_ZERO
    return jnp.where(empty, 0, potential - jnp.where(empty, 0, log_mass))
