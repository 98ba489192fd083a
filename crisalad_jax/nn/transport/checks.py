"""Check the inputs of a transport problem, and the outputs of custom steps and starts."""

import contextlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from crisalad_jax.config.checks import require
from crisalad_jax.nn.transport.config import SinkhornConfig
from crisalad_jax.nn.transport.problem import LOG_ZERO, Potentials, Problem
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import expect_like


def wide_dtype(scores: Array) -> jnp.dtype:
    """Return the type to compute in: float32, or the scores' type if it is wider."""
    return jnp.promote_types(scores.dtype, jnp.float32)


def check_inputs(
    scores: Array,
    log_mu: Array,
    log_nu: Array,
    numbers: tuple[float | Array, float | Array | None, float | Array | None],
    init: Potentials | None,
    *,
    equal_totals: bool,
) -> None:
    """Check the shapes of a problem, and its values where they are known (outside of `jit`).

    Args:
        scores: see `solve`.
        log_mu: see `solve`.
        log_nu: see `solve`.
        numbers: epsilon, row_tau and column_tau, for all problems or one per problem; None is 1.
        init: see `solve`.
        equal_totals: whether the masses of both sides must have the same total.

    Raises:
        InputError: a check fails; the message names the argument.
    """
    shape = scores.shape
    rows, columns = shape[:-1], (*shape[:-2], *shape[-1:])
    require(
        len(shape) >= 2 and 0 not in shape[-2:],
        f"sinkhorn: found scores of shape {shape}, expected (..., rows, columns)",
    )
    require(not jnp.iscomplexobj(scores), "sinkhorn: found complex scores, expected real ones")
    starts = {"init.row": (init[0], rows), "init.column": (init[1], columns)} if init else {}
    named = dict(zip(("epsilon", "row_tau", "column_tau"), numbers, strict=True))
    vectors = {"log_mu": (log_mu, rows), "log_nu": (log_nu, columns)}
    vectors |= {name: (x, shape[:-2]) for name, x in named.items() if x is not None and jnp.ndim(x)}
    for name, (vector, target) in {**vectors, **starts}.items():
        require(
            _spreads(jnp.shape(vector), target),
            f"sinkhorn: {name} found of shape {jnp.shape(vector)}, expected {target} for scores of "
            f"{shape}",
        )
    wide = wide_dtype(scores)
    _check("scores found with NaN or infinity, expected finite numbers", jnp.isfinite, scores)
    for name, (vector, _) in starts.items():
        _check(f"{name} found with NaN, expected numbers", lambda x: ~jnp.isnan(x), vector)
    for name, masses in (("log_mu", log_mu), ("log_nu", log_nu)):
        words = "found with NaN, infinity or no mass at all, expected finite numbers, or -inf for a"
        _check(f"{name} {words} mass of 0", _are_masses, masses)
    least = float(jnp.finfo(wide).tiny)  # a processor may flush less to 0
    epsilon, *taus = numbers
    shown = " ".join(str(epsilon).split())
    _check(f"epsilon found {shown}, expected at least {least:.1e}", lambda x: x >= least, epsilon)
    _check(
        f"epsilon found {shown}, which makes scores overflow, expected quotients in {wide}'s range",
        lambda scores, epsilon: jnp.isfinite(
            scores.astype(wide) / per_problem(jnp.asarray(epsilon), 2)
        ),
        *(scores, epsilon),
    )
    for name, tau in zip(("row_tau", "column_tau"), taus, strict=True):
        if tau is not None:
            shown = " ".join(str(tau).split())
            words = f"{name} found {shown}, expected more than 0 and at most 1"
            _check(words, lambda x: (x > 0) & (x <= 1), tau)
    if equal_totals and not isinstance(log_mu, Tracer) and not isinstance(log_nu, Tracer):
        mu, nu = (np.exp(np.asarray(x, np.float64)).sum(axis=-1) for x in (log_mu, log_nu))
        mu, nu = np.broadcast_arrays(mu, nu)
        unlike = ~(np.abs(mu - nu) <= _rounding(log_mu, log_nu) * np.abs(nu))
        if unlike.any():
            sums = " and ".join(f"{total[unlike].flat[0]:.6g}" for total in (mu, nu))
            raise InputError(
                f"sinkhorn: masses exp(log_mu) and exp(log_nu) found to sum to {sums}, expected "
                "the same"
            )


def per_problem(numbers: Array, axes: int) -> Array:
    """Append `axes` axes of size 1 to an array of one value per problem; scalars do not change."""
    return jnp.expand_dims(numbers, tuple(range(-axes, 0))) if numbers.ndim else numbers


def _check(words: str, test: Callable[..., Array], *values: Any) -> None:
    """Raise InputError if a test of the values fails anywhere; traced values pass."""
    if not any(isinstance(value, Tracer) for value in values):
        # Concrete values stay concrete under tracing. Only a flag is copied to the host.
        with jax.ensure_compile_time_eval():
            require(bool(jnp.all(test(*values))), f"sinkhorn: {words}")


def _are_masses(logarithms: Array) -> Array:
    some = (logarithms >= LOG_ZERO).any(axis=-1, keepdims=True)
    return (logarithms < jnp.inf) & some


def _rounding(*log_masses: Array) -> float:
    """Bound the relative difference of totals that comes from rounding their log masses."""
    floats = [x.dtype for x in log_masses if jnp.issubdtype(x.dtype, jnp.floating)]
    # At least the error of sums of float32 logarithms.
    return max([1e-4, *(16 * float(jnp.finfo(dtype).eps) for dtype in floats)])


def equal_totals(log_mu: Array, log_nu: Array, wide: jnp.dtype) -> tuple[Array, Array]:
    """Widen marginals to `wide`; if any was narrower, scale the columns' to the rows' total.

    Totals that differ by more than rounding can explain are not changed.
    """
    allowed, types = _rounding(log_mu, log_nu), (log_mu.dtype, log_nu.dtype)
    log_mu, log_nu = log_mu.astype(wide), log_nu.astype(wide)
    if all(jnp.promote_types(dtype, wide) == dtype for dtype in types):
        return log_mu, log_nu
    totals = [jax.nn.logsumexp(x, axis=-1, keepdims=True) for x in (log_mu, log_nu)]
    # A constant: a plan whose rows are met does not depend on the columns' total.
    more = jax.lax.stop_gradient(totals[0] - totals[1])
    return log_mu, log_nu + jnp.where(jnp.abs(more) <= allowed, more, 0)


def check_start(config: SinkhornConfig, problem: Problem, params: Any) -> None:
    """Check that a start returns potentials of the problem's shapes.

    Raises:
        InputError: the shapes differ, or parameters are missing; the message names the start.
    """
    start, name = config.start, f"start {config.start.part_name}"
    _check_params(name, start, params, "start_params")
    found = jax.eval_shape(start.potentials, problem, params)
    expect_like(name, found, jax.eval_shape(problem.zeros))


def _check_params(name: str, part: Any, params: Any, argument: str) -> None:
    if params is None:
        learnt = jax.eval_shape(part.init_params, jax.random.key(0))
        require(learnt is None, f"{name}: found no {argument}, expected those of its init_params")


def check_step(config: SinkhornConfig, problem: Problem, params: Any) -> None:
    """Check that a step returns potentials and a state of the shapes that it was given.

    Raises:
        InputError: the shapes differ, or parameters are missing; the message names the step.
    """
    step, name = config.step, f"step {config.step.part_name}"
    _check_params(name, step, params, "step_params")

    def run_once(problem: Problem, params: Any) -> tuple[Any, Any]:
        prepared = step.prepare(problem, params)
        start, state = prepared.zeros(), step.init(prepared, params)
        after = step.step(prepared, start, state, jnp.zeros((), jnp.int32))
        log_plan = step.log_plan(prepared, step.finish(prepared, start))
        return (prepared, after, log_plan), (problem, (start, state), problem.kernel)

    found, wanted = jax.eval_shape(run_once, problem, params)
    for method, *pair in zip(("prepare", "step", "log_plan"), found, wanted, strict=True):
        expect_like(f"{name}, {method}", *pair)


def _spreads(shape: tuple[int, ...], target: tuple[int, ...]) -> bool:
    """Return whether `shape` broadcasts to `target` with an equal last axis."""
    with contextlib.suppress(ValueError):
        return shape[-1:] == target[-1:] and jnp.broadcast_shapes(shape, target) == target
    return False
