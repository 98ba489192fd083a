"""Sinkhorn divergence between two sets of tokens, with the gradient of the envelope theorem."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from crisalad_jax.config.checks import require
from crisalad_jax.nn.transport.config import SinkhornConfig
from crisalad_jax.nn.transport.problem import LOG_ZERO, product
from crisalad_jax.nn.transport.solve import per_problem, solve

_SOLVER = SinkhornConfig(tolerance=1e-4, iterations=500, gradient="stop")


def sinkhorn_divergence(
    x: Float[Array, "*batch x_token dim"],
    y: Float[Array, "*batch y_token dim"],
    *,
    log_mu: Float[Array, "*#batch x_token"] | None = None,
    log_nu: Float[Array, "*#batch y_token"] | None = None,
    epsilon: float | Float[Array, "*#batch"] = 0.1,
    config: SinkhornConfig = _SOLVER,
) -> Float[Array, "*batch"]:
    """Compute the Sinkhorn divergence of two sets of tokens (Feydy et al., AISTATS 2019).

    It is OT(x, y) - (OT(x, x) + OT(y, y)) / 2, where OT is the minimum of <plan, cost> + epsilon *
    KL(plan | product of the masses) for squared Euclidean costs |x - y|^2. It is 0 for equal sets,
    never negative at convergence, and nears the squared Wasserstein distance as epsilon falls.

    The gradient is Danskin's: potentials are constants, because they maximise the dual. It is exact
    at convergence and stores no iterations; second derivatives are wrong.

    Args:
        x: tokens of one image of each pair.
        y: tokens of the other image, of the same width.
        log_mu: logarithms of the masses of `x`, -inf for a token to leave out; by default all are
            equal. They are normalised to sum to 1.
        log_nu: the same for `y`.
        epsilon: entropic regularisation, in units of the cost.
        config: the solver of the three problems, of which only the potentials are used.

    Returns:
        The divergence of each pair, in at least float32.

    Raises:
        InputError: the tokens differ in width or batch, or `solve` rejects an argument.

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
        (side.astype(wide), log_masses(side, masses).astype(wide))
        for side, masses in ((x, log_mu), (y, log_nu))
    ]

    options = {"epsilon": epsilon, "config": config}
    selves = [entropic_cost(side, side, **options) for side in sides]
    return entropic_cost(*sides, **options) - (selves[0] + selves[1]) / 2


def entropic_cost(
    first: tuple[Array, Array],
    second: tuple[Array, Array],
    *,
    epsilon: float | Float[Array, "*#batch"],
    config: SinkhornConfig = _SOLVER,
) -> Float[Array, "*batch"]:
    """Compute OT(x, y) of `sinkhorn_divergence`, with the same gradient.

    Args:
        first: tokens, and the logarithms of their masses, which sum to 1.
        second: the same for the other image.
        epsilon: see `sinkhorn_divergence`.
        config: see `sinkhorn_divergence`.
    """
    (tokens, log_mu), (others, log_nu) = first, second
    cost = squared_distances(tokens, others)
    fixed = jax.lax.stop_gradient((-cost, log_mu, log_nu))
    at = jax.lax.stop_gradient(epsilon)
    row, column = solve(*fixed, epsilon=at, config=config).potentials
    # The dual's potentials are relative to the masses.
    f = jax.lax.stop_gradient(_from_masses(row, log_mu))
    g = jax.lax.stop_gradient(_from_masses(column, log_nu))
    mu, nu = jnp.exp(log_mu), jnp.exp(log_nu)
    kernel = -cost / per_problem(jnp.asarray(epsilon, cost.dtype), 2)
    shares = jnp.exp(kernel + f[..., :, None] + g[..., None, :])
    total = product("...n,...nk,...k->...", mu, shares, nu)
    return epsilon * ((mu * f).sum(axis=-1) + (nu * g).sum(axis=-1) + 1 - total)


def squared_distances(
    x: Float[Array, "*batch x_token dim"], y: Float[Array, "*batch y_token dim"]
) -> Float[Array, "*batch x_token y_token"]:
    """Return |x_n - y_k|^2 for all pairs of tokens, clamped to at least 0."""
    squares = [(side**2).sum(axis=-1) for side in (x, y)]
    inner = product("...nd,...kd->...nk", x, y)
    return jnp.maximum(squares[0][..., :, None] + squares[1][..., None, :] - 2 * inner, 0)


def log_masses(tokens: Array, given: Array | None = None) -> Array:
    """Return logarithms of masses that sum to 1: `given`, normalised, or equal masses."""
    shape = tokens.shape[:-1]
    if given is None:
        return jnp.full(shape, -math.log(shape[-1]))
    return jnp.broadcast_to(jax.nn.log_softmax(jnp.asarray(given), axis=-1), shape)


def _from_masses(potential: Array, log_mass: Array) -> Array:
    empty = log_mass < LOG_ZERO
    return jnp.where(empty, 0, potential - jnp.where(empty, 0, log_mass))
