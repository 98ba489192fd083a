"""Measure a plan's marginal errors, and check the inputs and steps of a problem."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from crisalad_jax.transport.config import SinkhornConfig, Solution
from crisalad_jax.transport.problem import NO_MASS, Potentials, Problem
from crisalad_jax.utils.errors import InputError


def marginal_error(
    log_plan: Float[Array, "*batch rows columns"],
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
    empty = log_marginal < NO_MASS
    error = jnp.abs(jnp.expm1(log_mass - jnp.where(empty, 0, log_marginal)))
    return jnp.where(empty, jnp.where(log_mass < NO_MASS, 0, jnp.inf), error)


def wide_dtype(scores: Array) -> jnp.dtype:
    """Return the type to compute in: float32, or the scores' type if it is wider."""
    return jnp.promote_types(scores.dtype, jnp.float32)


def check_inputs(
    scores: Array,
    log_mu: Array,
    log_nu: Array,
    epsilon: float | Array,
    *,
    equal_totals: bool,
) -> None:
    """Check the shapes of a problem, and its values where they are known (outside of `jit`).

    Raises:
        InputError: naming the argument, what was found and what was expected.
    """
    for name, marginal, axis, side in (
        ("log_mu", log_mu, -2, "rows"),
        ("log_nu", log_nu, -1, "columns"),
    ):
        target = (*scores.shape[:-2], *scores.shape[axis:][:1])
        if scores.ndim < 2 or 0 in scores.shape[-2:] or not _spreads(marginal.shape, target):
            raise InputError(
                f"sinkhorn: found scores of shape {scores.shape} and {name} of {marginal.shape}, "
                f"expected (..., rows, columns) and (..., {side})"
            )
    if jnp.ndim(epsilon):
        raise InputError(
            f"sinkhorn: epsilon found of shape {jnp.shape(epsilon)}, expected a single number"
        )
    for name, value in (("scores", scores), ("log_mu", log_mu), ("log_nu", log_nu)):
        if jnp.iscomplexobj(value):
            raise InputError(f"sinkhorn: {name} found of {value.dtype}, expected real numbers")
    if not isinstance(scores, Tracer) and not _all(jnp.isfinite, scores):
        raise InputError("sinkhorn: scores found with NaN or infinity, expected finite numbers")
    for name, value in (("log_mu", log_mu), ("log_nu", log_nu)):
        if isinstance(value, Tracer):
            continue
        if not _all(lambda x: x < jnp.inf, value):
            raise InputError(
                f"sinkhorn: {name} found with NaN or infinity, expected finite numbers, or -inf "
                "for a mass of 0"
            )
        if not _all(lambda x: (x >= NO_MASS).any(axis=-1), value):
            raise InputError(
                f"sinkhorn: {name} found with no mass at all in a problem, expected some"
            )
    if not isinstance(epsilon, Tracer):
        _check_epsilon(scores, float(epsilon))
    if equal_totals and not isinstance(log_mu, Tracer) and not isinstance(log_nu, Tracer):
        _check_totals(log_mu, log_nu)


def check_init(init: Any, scores: Array, log_mu: Array, log_nu: Array) -> Potentials:
    """Return the potentials to start from, if they fit the scores.

    Raises:
        InputError: they do not, or where they are known (outside of `jit`) are not finite. They
            may be -inf where the mass is 0.
    """
    expected = scores.shape[:-1], (*scores.shape[:-2], scores.shape[-1])
    is_pair = isinstance(init, tuple) and len(init) == 2
    shapes = tuple(map(jnp.shape, init)) if is_pair else ()
    if not is_pair or not all(map(_spreads, shapes, expected)):
        raise InputError(
            f"sinkhorn: init found of {shapes or type(init).__name__}, expected Potentials of "
            f"shapes {expected[0]} and {expected[1]}"
        )
    start = Potentials(*map(jnp.asarray, init))
    for potential, log_mass in zip(start, (log_mu, log_nu), strict=True):
        traced = isinstance(log_mass, Tracer)

        def fits(x: Array, mass: Array | None = None if traced else log_mass) -> Array:
            empty = True if mass is None else mass < NO_MASS
            return jnp.isfinite(x) | (jnp.isneginf(x) & empty)

        if not isinstance(potential, Tracer) and not _all(fits, potential):
            raise InputError(
                "sinkhorn: init found with NaN or infinity, expected finite potentials"
            )
    return start


def _all(test: Callable[[Array], Array], value: Array) -> bool:
    # Concrete values stay concrete under tracing. Only a flag is copied to the host.
    with jax.ensure_compile_time_eval():
        return bool(test(value).all())


def _largest(value: Array) -> float:
    with jax.ensure_compile_time_eval():
        return float(jnp.abs(value).max())


def _check_epsilon(scores: Array, epsilon: float) -> None:
    if not epsilon > 0:
        raise InputError(f"sinkhorn: epsilon found {epsilon}, expected more than 0")
    known = scores.size and not isinstance(scores, Tracer)
    largest = _largest(scores) / epsilon if known else 0.0
    if largest > float(jnp.finfo(wide_dtype(scores)).max):
        raise InputError(
            f"sinkhorn: epsilon found {epsilon}, with which scores over it are up to "
            f"{largest:.1e}, expected numbers that {wide_dtype(scores)} can hold"
        )
    least = float(jnp.finfo(wide_dtype(scores)).tiny)
    if epsilon < least:  # a processor may take it for 0
        raise InputError(f"sinkhorn: epsilon found {epsilon}, expected at least {least:.1e}")


def _check_totals(log_mu: Array, log_nu: Array) -> None:
    totals = [np.exp(np.asarray(x, np.float64)).sum(axis=-1) for x in (log_mu, log_nu)]
    with jax.ensure_compile_time_eval():
        allowed = np.asarray(_rounding(log_mu) + _rounding(log_nu))
    # At least what sums of float32 logarithms are off by.
    allowed = np.maximum(allowed, 1e-4)
    unlike = ~(np.abs(totals[0] - totals[1]) <= allowed * np.abs(totals[1]))
    if unlike.any():
        worst = [np.broadcast_to(total, unlike.shape)[unlike][0] for total in totals]
        sums = " and ".join(f"{total:.6g}" for total in worst)
        raise InputError(
            f"sinkhorn: masses exp(log_mu) and exp(log_nu) found to sum to {sums}, expected the "
            "same"
        )


def equal_totals(log_mu: Array, log_nu: Array, wide: jnp.dtype) -> tuple[Array, Array]:
    """Give marginals of a narrower type than `wide` equal totals there.

    The coarser marginal takes the other's total, and of two of one type the columns take the rows'.
    Totals that differ by more than rounding explains stay as they are.
    """
    units = [_unit(x) for x in (log_mu, log_nu)]
    if max(units) <= float(jnp.finfo(wide).eps):
        return log_mu, log_nu
    allowed = (_rounding(log_mu) + _rounding(log_nu))[..., None].astype(wide)
    log_mu, log_nu = log_mu.astype(wide), log_nu.astype(wide)
    totals = [jax.nn.logsumexp(x, axis=-1, keepdims=True) for x in (log_mu, log_nu)]
    # A constant: a plan whose rows are met does not depend on the columns' total.
    more = jax.lax.stop_gradient(totals[0] - totals[1])
    more = jnp.where(jnp.abs(more) <= allowed, more, 0)
    return (log_mu - more, log_nu) if units[0] > units[1] else (log_mu, log_nu + more)


def _unit(value: Array) -> float:
    """Return the relative rounding of numbers of a type; whole numbers have none."""
    floats = jnp.issubdtype(value.dtype, jnp.floating)
    return float(jnp.finfo(value.dtype).eps) if floats else 0.0


def _rounding(log_masses: Array) -> Array:
    """Bound the relative error of a total whose masses, then their logarithms, were rounded."""
    exact = log_masses.astype(wide_dtype(log_masses))
    exact = jax.lax.stop_gradient(jnp.where(exact < NO_MASS, -jnp.inf, exact))
    size = 1 + jnp.where(jnp.isfinite(exact), jnp.abs(exact), 0)
    shares = jax.nn.softmax(exact, axis=-1)
    return _unit(log_masses) * (shares * size).sum(axis=-1)


def check_step(config: SinkhornConfig, problem: Problem, params: Any) -> None:
    """Check that a step returns potentials of the problem's shapes and keeps its state's shapes.

    Raises:
        InputError: it does not, or its parameters are missing; the message names the step.
    """
    step, name = config.step, config.step.part_name
    learns = jax.eval_shape(step.init_params, jax.random.key(0))
    if params is None and learns is not None:
        raise InputError(
            f"step {name}: found no step_params, expected those of its init_params, "
            f"{_words(learns)}"
        )
    prepared = jax.eval_shape(step.prepare, problem, params)
    if not isinstance(prepared, Problem) or _kinds(prepared) != _kinds(problem):
        raise InputError(
            f"step {name}: found to prepare {_words(prepared)}, expected a Problem of the same "
            "shapes"
        )

    def once(problem: Problem, params: Any) -> tuple[Any, Any, Any]:
        problem = step.prepare(problem, params)
        state = step.init(problem, params)
        return (
            problem.zeros(),
            state,
            step.step(problem, problem.zeros(), state, jnp.zeros((), jnp.int32)),
        )

    potentials, state, out = jax.eval_shape(once, problem, params)
    if not (isinstance(out, tuple) and len(out) == 2) or isinstance(out, Potentials):
        raise InputError(
            f"step {name}: found to return {_words(out)}, expected (Potentials, state)"
        )
    for what, output, expected in (("", out[0], potentials), ("a state of ", out[1], state)):
        if _kinds(output) != _kinds(expected):
            raise InputError(
                f"step {name}: found to return {what}{_words(output)}, expected {_words(expected)}"
            )
    if not isinstance(out[0], Potentials):
        raise InputError(f"step {name}: found to return {_words(out[0])}, expected Potentials")

    def plan(problem: Problem, potentials: Potentials) -> Any:
        return step.log_plan(problem, step.finish(problem, potentials))

    log_plan = jax.eval_shape(plan, problem, potentials)
    if _kinds(log_plan) != _kinds(problem.kernel):
        raise InputError(
            f"step {name}: found a log_plan of {_words(log_plan)}, expected one of shape "
            f"{problem.kernel.shape} and {problem.kernel.dtype}"
        )


def check_solution(solution: Any, config: SinkhornConfig, problem: Problem) -> None:
    """Check that a gradient returns a solution of the problem's shapes.

    Raises:
        InputError: it does not; the message names the gradient.
    """
    zeros = problem.zeros()
    batch = zeros.row.shape[:-1]
    fits = (
        isinstance(solution, Solution)
        and isinstance(solution.potentials, Potentials)
        and _kinds(solution.potentials) == _kinds(zeros)
        and jnp.shape(solution.iterations) == jnp.shape(solution.met) == batch
    )
    if not fits:
        raise InputError(
            f"gradient {config.gradient.part_name}: found to return {_named(solution)}, expected a "
            f"Solution of {_words(zeros)}, and of iterations and met of shape {batch}"
        )


def _named(value: Any) -> str:
    arrays = all(hasattr(leaf, "shape") for leaf in jax.tree.leaves(value))
    return _words(value) if arrays else type(value).__name__


def _kinds(tree: Any) -> tuple[Any, ...]:
    """Return a tree's structure, and its leaves' shapes and types."""
    leaves = [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)]
    return jax.tree.structure(tree), leaves


def _words(tree: Any) -> str:
    """Describe a tree by the types and shapes of its leaves, such as float32[2,3]."""

    def word(leaf: Any) -> _Word:
        return _Word(f"{leaf.dtype}[{','.join(map(str, leaf.shape))}]")

    return str(jax.tree.map(word, tree))


class _Word(str):
    """Text that stands without quotes in the text of a tree."""

    __slots__ = ()
    __repr__ = str.__str__


def _spreads(shape: tuple[int, ...], target: tuple[int, ...]) -> bool:
    """Return whether `shape` broadcasts to `target` with an equal last axis."""
    leading = zip(reversed(shape[:-1]), reversed(target[:-1]), strict=False)
    return (
        shape[-1:] == target[-1:]
        and len(shape) <= len(target)
        and all(size in (1, wanted) for size, wanted in leading)
    )
