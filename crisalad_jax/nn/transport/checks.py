"""Measure a plan's marginal errors, and check the inputs and steps of a problem."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from crisalad_jax.config.checks import require
from crisalad_jax.nn.transport.config import SinkhornConfig, Solution
from crisalad_jax.nn.transport.problem import LOG_ZERO, Matrix, Potentials, Problem
from crisalad_jax.utils.pytree import expect_like


def marginal_error(
    log_plan: Matrix,
    log_mu: Float[Array, "*#batch rows"],
    log_nu: Float[Array, "*#batch columns"],
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Compute the largest relative error of the row masses and of the column masses of a plan.

    Args:
        log_plan: logarithms of the masses.
        log_mu: logarithms of the rows' marginals.
        log_nu: logarithms of the columns' marginals.

    Returns:
        The largest |mass / marginal - 1| of the rows, and of the columns. Where a marginal is 0,
        the error is 0 if the mass is, else infinite.

    Example:
        >>> import jax.numpy as jnp
        >>> log_plan, log_nu = jnp.log(jnp.eye(2)), jnp.log(jnp.full(2, 0.5))
        >>> rows, columns = marginal_error(log_plan, jnp.zeros(2), log_nu)
        >>> float(rows), float(columns)
        (0.0, 1.0)
    """
    rows = _relative_error(jax.nn.logsumexp(log_plan, axis=-1), log_mu)
    columns = _relative_error(jax.nn.logsumexp(log_plan, axis=-2), log_nu)
    return rows.max(axis=-1), columns.max(axis=-1)


def _relative_error(log_mass: Array, log_marginal: Array) -> Array:
    empty = log_marginal < LOG_ZERO
    error = jnp.abs(jnp.expm1(log_mass - jnp.where(empty, 0, log_marginal)))
    return jnp.where(empty, jnp.where(log_mass < LOG_ZERO, 0, jnp.inf), error)


def wide_dtype(scores: Array) -> jnp.dtype:
    """Return the type to compute in: float32, or the scores' type if it is wider."""
    return jnp.promote_types(scores.dtype, jnp.float32)


def check_inputs(
    scores: Array, log_mu: Array, log_nu: Array, epsilon: float | Array, *, equal_totals: bool
) -> None:
    """Check the shapes of a problem, and its values where they are known (outside of `jit`).

    Raises:
        InputError: naming the argument, what was found and what was expected.
    """
    shape = scores.shape
    for name, marginal, target, side in (
        ("log_mu", log_mu, shape[:-1], "rows"),
        ("log_nu", log_nu, (*shape[:-2], *shape[-1:]), "columns"),
    ):
        require(
            len(shape) >= 2 and 0 not in shape[-2:] and _spreads(marginal.shape, target),
            f"sinkhorn: found scores of shape {shape} and {name} of {marginal.shape}, expected "
            f"(..., rows, columns) and (..., {side})",
        )
    require(
        not jnp.ndim(epsilon),
        f"sinkhorn: epsilon found of shape {jnp.shape(epsilon)}, expected a single number",
    )
    for name, value in (("scores", scores), ("log_mu", log_mu), ("log_nu", log_nu)):
        require(
            not jnp.iscomplexobj(value),
            f"sinkhorn: {name} found of {value.dtype}, expected real numbers",
        )
    _check("scores found with NaN or infinity, expected finite numbers", jnp.isfinite, scores)
    for name, value in (("log_mu", log_mu), ("log_nu", log_nu)):
        words = "found with NaN or infinity, expected finite numbers, or -inf for a mass of 0"
        _check(f"{name} {words}", lambda x: x < jnp.inf, value)
        words = "found with no mass at all in a problem, expected some"
        _check(f"{name} {words}", lambda x: (x >= LOG_ZERO).any(axis=-1), value)
    least = float(jnp.finfo(wide_dtype(scores)).tiny)  # a processor may take less for 0
    _check(f"epsilon found {epsilon}, expected at least {least:.1e}", lambda x: x >= least, epsilon)
    _check(
        f"epsilon found {epsilon}, by which scores overflow, expected numbers that "
        f"{wide_dtype(scores)} can hold",
        lambda scores, epsilon: jnp.isfinite(scores.astype(wide_dtype(scores)) / epsilon),
        scores,
        epsilon,
    )
    if equal_totals and not isinstance(log_mu, Tracer) and not isinstance(log_nu, Tracer):
        totals = [np.exp(np.asarray(x, np.float64)).sum(axis=-1) for x in (log_mu, log_nu)]
        unlike = ~(np.abs(totals[0] - totals[1]) <= _rounding(log_mu, log_nu) * np.abs(totals[1]))
        worst = [np.broadcast_to(total, unlike.shape)[unlike] for total in totals]
        require(
            not unlike.any(),
            "sinkhorn: masses exp(log_mu) and exp(log_nu) found to sum to "
            f"{' and '.join(f'{total.flat[0]:.6g}' for total in worst if total.size)}, expected "
            "the same",
        )


def check_init(init: Any, scores: Array, log_mu: Array, log_nu: Array) -> Potentials:
    """Return the potentials to start from, if they fit the scores.

    Raises:
        InputError: they do not, or where they are known (outside of `jit`) are not finite. They
            may be -inf where the mass is 0.
    """
    expected = scores.shape[:-1], (*scores.shape[:-2], scores.shape[-1])
    is_pair = isinstance(init, tuple) and len(init) == 2
    shapes = tuple(map(jnp.shape, init)) if is_pair else ()
    require(
        is_pair and all(map(_spreads, shapes, expected)),
        f"sinkhorn: init found of {shapes or type(init).__name__}, expected Potentials of shapes "
        f"{expected[0]} and {expected[1]}",
    )
    start = Potentials(*map(jnp.asarray, init))
    for potential, log_mass in zip(start, (log_mu, log_nu), strict=True):
        mass = jnp.full((), -jnp.inf) if isinstance(log_mass, Tracer) else log_mass
        _check(
            "init found with NaN or infinity, expected finite potentials",
            lambda x, mass: jnp.isfinite(x) | (jnp.isneginf(x) & (mass < LOG_ZERO)),
            potential,
            mass,
        )
    return start


def _check(words: str, test: Callable[..., Array], *values: Any) -> None:
    """Raise InputError where a test of values fails somewhere; traced ones are not known."""
    if not any(isinstance(value, Tracer) for value in values):
        # Concrete values stay concrete under tracing. Only a flag is copied to the host.
        with jax.ensure_compile_time_eval():
            require(bool(jnp.all(test(*values))), f"sinkhorn: {words}")


def _rounding(*log_masses: Array) -> float:
    """Bound the relative difference of totals whose masses' logarithms were rounded."""
    floats = [x.dtype for x in log_masses if jnp.issubdtype(x.dtype, jnp.floating)]
    # At least what sums of float32 logarithms are off by.
    return max([1e-4, *(16 * float(jnp.finfo(dtype).eps) for dtype in floats)])


def equal_totals(log_mu: Array, log_nu: Array, wide: jnp.dtype) -> tuple[Array, Array]:
    """Widen marginals; if they were narrower than `wide`, give the columns the rows' total.

    Totals that differ by more than rounding explains stay as they are.
    """
    allowed, types = _rounding(log_mu, log_nu), (log_mu.dtype, log_nu.dtype)
    log_mu, log_nu = log_mu.astype(wide), log_nu.astype(wide)
    if all(jnp.promote_types(dtype, wide) == dtype for dtype in types):
        return log_mu, log_nu
    totals = [jax.nn.logsumexp(x, axis=-1, keepdims=True) for x in (log_mu, log_nu)]
    # A constant: a plan whose rows are met does not depend on the columns' total.
    more = jax.lax.stop_gradient(totals[0] - totals[1])
    return log_mu, log_nu + jnp.where(jnp.abs(more) <= allowed, more, 0)


def check_step(config: SinkhornConfig, problem: Problem, params: Any) -> None:
    """Check that a step returns potentials of the problem's shapes and keeps its state's shapes.

    Raises:
        InputError: it does not, or its parameters are missing; the message names the step.
    """
    step, name = config.step, f"step {config.step.part_name}"
    learns = jax.eval_shape(step.init_params, jax.random.key(0))
    require(
        params is not None or learns is None,
        f"{name}: found no step_params, expected those of its init_params",
    )
    prepared = jax.eval_shape(step.prepare, problem, params)
    expect_like(f"{name}, prepare", prepared, problem)

    def once(problem: Problem, params: Any) -> tuple[Any, Any]:
        state = step.init(problem, params)
        start = problem.zeros()
        return (start, state), step.step(problem, start, state, jnp.zeros((), jnp.int32))

    def plan(problem: Problem, potentials: Potentials) -> Any:
        return step.log_plan(problem, step.finish(problem, potentials))

    before, after = jax.eval_shape(once, prepared, params)
    expect_like(name, after, before)
    log_plan = jax.eval_shape(plan, problem, before[0])
    expect_like(f"{name}, log_plan", log_plan, problem.kernel)


def check_solution(solution: Any, config: SinkhornConfig, problem: Problem) -> None:
    """Check that a gradient returns a solution of the problem's shapes.

    Raises:
        InputError: it does not; the message names the gradient.
    """
    zeros = problem.zeros()
    count = jnp.zeros(zeros.row.shape[:-1], jnp.int32)
    wanted = Solution(zeros, count, count.astype(bool))
    expect_like(f"gradient {config.gradient.part_name}", solution, wanted)


def _spreads(shape: tuple[int, ...], target: tuple[int, ...]) -> bool:
    """Return whether `shape` broadcasts to `target` with an equal last axis."""
    leading = zip(reversed(shape[:-1]), reversed(target[:-1]), strict=False)
    return (
        shape[-1:] == target[-1:]
        and len(shape) <= len(target)
        and all(size in (1, wanted) for size, wanted in leading)
    )
