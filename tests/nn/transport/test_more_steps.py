"""Accelerated and annealed steps, capacities and sparse plans against POT, scipy and numpy."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import ot
import pytest
import scipy.optimize
import scipy.special

from crisalad_jax.nn.transport.sparse import simplex_offset
from crisalad_jax.sinkhorn import (
    AnnealingStep,
    CapacityStep,
    SinkhornConfig,
    SinkhornResult,
    TopKStep,
    assign_with_dustbin,
    solve,
)
from crisalad_jax.utils.errors import InputError
from tests.nn.conftest import slow_unless
from tests.nn.transport.problems import assert_three_ways, implicit, pot_plan

ROWS, COLUMNS = 12, 5
float64 = pytest.mark.usefixtures("float64")


class Inputs(NamedTuple):
    scores: Any
    log_mu: Any
    log_nu: Any


def inputs(std: float = 2.0, more: float = 1.0) -> Inputs:
    """Uneven masses of equal totals; the last two columns hold `more` times that."""
    generator = np.random.default_rng(0)
    scores = std * generator.standard_normal((ROWS, COLUMNS))
    mu, nu = generator.uniform(0.5, 2, ROWS), generator.uniform(0.5, 3, COLUMNS)
    nu *= mu.sum() / nu.sum()
    nu[-2:] *= more
    return Inputs(*map(jnp.asarray, (scores, np.log(mu), np.log(nu))))


def log_sums(x: np.ndarray) -> np.ndarray:
    return np.asarray(scipy.special.logsumexp(x, axis=1))


def plan_of(result: SinkhornResult) -> np.ndarray:
    return np.exp(np.asarray(result.log_plan, np.float64))


def at_rest(step: Any, at: Inputs, epsilon: float = 0.7, **fields: Any) -> SinkhornResult:
    fields = {"tolerance": 1e-12, "iterations": 5000, "gradient": "stop"} | fields
    result = solve(*at, epsilon=epsilon, config=SinkhornConfig(step=step, **fields))
    assert result.converged
    return result


# Entropic plans


@float64
@pytest.mark.parametrize("domain", ["scaling", "log"])
@pytest.mark.parametrize("step", ["nesterov", "annealing"])
def test_entropic_plans_are_pots(step: str, domain: Any) -> None:
    result = at_rest(step, inputs(), domain=domain)
    # Relative: what POT stops at is relative to its largest scaling.
    np.testing.assert_allclose(plan_of(result), pot_plan(*inputs(), 0.7, 1, 1), rtol=1e-9)


@float64
def test_nesterov_by_hand() -> None:
    """Twenty iterations in numpy, in which the momentum starts again."""
    scores, log_mu, log_nu = map(np.asarray, inputs(4.0))
    nu = np.exp(log_nu)
    row, before, ahead, count, restarts = np.zeros(ROWS), np.zeros(COLUMNS), np.zeros(COLUMNS), 0, 0
    for _ in range(20):
        column = log_nu - np.log(np.exp(scores + row[:, None]).sum(axis=0))
        if nu @ ((column - ahead) * (column - before)) < 0:
            count, restarts = 0, restarts + 1
        ahead = column + count / (count + 3) * (column - before)
        before, count = column, count + 1
        row = log_mu - np.log(np.exp(scores + ahead).sum(axis=1))
    assert restarts > 0
    result = solve(*inputs(4.0), config=SinkhornConfig(step="nesterov", iterations=20))
    # The same sums in another order.
    np.testing.assert_allclose(result.log_plan, scores + row[:, None] + ahead, atol=1e-11)


def test_nesterov_takes_fewer_iterations_of_sharp_scores() -> None:
    """A fourth, as one seed has a tenth; relaxed marginals are met as Sinkhorn meets them."""
    scores = 6 * jax.random.normal(jax.random.key(1), (4, 40, 6))
    plain, fast = (
        assign_with_dustbin(
            scores, 0.0, config=implicit(step=step, tolerance=1e-3, iterations=2000)
        )
        for step in ("sinkhorn", "nesterov")
    )
    assert plain.converged.all()
    assert fast.converged.all()
    assert fast.iterations.sum() < 0.5 * plain.iterations.sum()
    # The tolerance, for a plain iteration a good part of the distance that is left.
    np.testing.assert_allclose(plan_of(fast), plan_of(plain), atol=3e-2)
    taus: dict[str, Any] = {"row_tau": 0.9, "column_tau": 0.7}
    plain, fast = (
        assign_with_dustbin(scores, 0.0, config=implicit(step=step, iterations=2000), **taus)
        for step in ("sinkhorn", "nesterov")
    )
    assert fast.converged.all()
    # The tolerance of 1e-5 over the distance of 1 - tau from 1.
    np.testing.assert_allclose(fast.log_plan, plain.log_plan, atol=5e-4)


@float64
def test_annealing_by_hand() -> None:
    """Its schedule in numpy; at its end it is at epsilon itself, and before the rows are met."""
    scores, log_mu, log_nu = map(np.asarray, inputs())
    row: Any = np.zeros(ROWS)
    lse: Any = scipy.special.logsumexp
    for epsilon in (8.0, 4.0, 2.0, 1.0):
        column = epsilon * (log_nu - lse((scores + row[:, None]) / epsilon, axis=0))
        row = epsilon * (log_mu - lse((scores + column) / epsilon, axis=1))
    config = SinkhornConfig(step=AnnealingStep(start=8.0, cooling=3), iterations=4)
    found = solve(*inputs(), config=config)
    np.testing.assert_allclose(found.log_plan, scores + row[:, None] + column, atol=1e-12)
    cut = solve(*inputs(), config=SinkhornConfig(step="annealing", iterations=1))
    assert cut.row_error < 1e-12
    plain = solve(*inputs(), config=SinkhornConfig(step=AnnealingStep(start=1.0)))
    # Roundings in another order.
    np.testing.assert_allclose(plain.log_plan, solve(*inputs()).log_plan, atol=1e-12)


def test_annealing_that_never_cools_has_not_converged() -> None:
    """A fixed point by optimistix takes every step for the first."""
    at = [jnp.asarray(x, jnp.float32) for x in inputs()]
    config = implicit(step="annealing", gradient="optimistix", tolerance=1e-4, iterations=100)
    assert not solve(*at, config=config).converged


# Other plans


@float64
def test_capacities_are_the_bounded_dual() -> None:
    """The semi-dual over potentials of at most 0, by scipy's L-BFGS-B."""
    at = inputs(more=3.0)
    scores, log_mu, log_nu = map(np.asarray, at)
    kernel, mu, nu = scores / 0.7, np.exp(log_mu), np.exp(log_nu)
    for free in (True, False):

        def worth(column: np.ndarray) -> tuple[float, np.ndarray]:
            sums = log_sums(kernel + column)
            masses = (mu[:, None] * np.exp(kernel + column - sums[:, None])).sum(axis=0)
            return float(mu @ sums - nu @ column), masses - nu

        bounds = [(None, 0)] * (COLUMNS - 1) + [(0 if free else None, 0)]
        options = {"ftol": 1e-16, "gtol": 1e-12}
        column = scipy.optimize.minimize(
            worth, np.zeros(COLUMNS), jac=True, method="L-BFGS-B", bounds=bounds, options=options
        ).x
        sums = log_sums(kernel + column)
        expected = mu[:, None] * np.exp(kernel + column - sums[:, None])
        result = at_rest(CapacityStep(free_last=free), at)
        # L-BFGS-B stops where its gradient is of order 1e-8.
        np.testing.assert_allclose(plan_of(result), expected, atol=1e-6)
        full = (result.potentials.column < 0)[:-1]
        assert full.any()
        assert not full.all()
        assert result.row_error < 1e-12
        assert result.column_error < 1e-10


@float64
def test_quadratic_plans_are_pots_and_sparse() -> None:
    at = inputs()
    mu, nu = np.exp(at.log_mu), np.exp(at.log_nu)
    limits = {"stopThr": 1e-14, "numItermax": 100000}
    expected: Any = ot.smooth.smooth_ot_dual(mu, nu, -np.asarray(at.scores), 0.7, "l2", **limits)
    plan = plan_of(at_rest("quadratic", at, tolerance=1e-11))
    # What POT's L-BFGS leaves.
    np.testing.assert_allclose(plan, expected, atol=1e-6)
    assert (plan == 0).mean() > 0.5


def project(values: np.ndarray, mass: float) -> np.ndarray:
    """The nearest point with numbers from 0 on that sum to `mass`: by bisection of the shift."""
    low, high = values.min() - mass, values.max()
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if np.maximum(values - middle, 0).sum() > mass else (low, middle)
    return np.maximum(values - high, 0)


def test_a_row_of_quadratic_transport_is_a_sparsemax() -> None:
    scores = 2 * np.random.default_rng(2).normal(size=(20, 6))
    mass = np.linspace(0.5, 3, 20)
    expected = np.stack([project(row, each) for row, each in zip(scores, mass, strict=True)])
    shift = simplex_offset(jnp.asarray(scores, jnp.float32), jnp.asarray(mass, jnp.float32))
    found = np.maximum(scores + np.asarray(shift)[:, None], 0)
    np.testing.assert_allclose(found, expected, atol=2e-6)  # sums of six numbers up to 6, float32
    assert (expected == 0).mean() > 0.3


@float64
def test_top_k_cuts_sinkhorns_plan() -> None:
    whole = plan_of(solve(*inputs()))
    least = np.sort(whole, axis=1)[:, -2:-1]
    kept = np.where(whole >= least, whole, 0)
    kept *= np.exp(inputs().log_mu)[:, None] / kept.sum(axis=1, keepdims=True)
    found = solve(*inputs(), config=SinkhornConfig(step=TopKStep(k=2)))
    np.testing.assert_allclose(plan_of(found), kept, atol=1e-13)  # rounding
    assert ((plan_of(found) > 0).sum(axis=1) == 2).all()
    all_of = solve(*inputs(), config=SinkhornConfig(step=TopKStep(k=COLUMNS)))
    np.testing.assert_allclose(plan_of(all_of), whole, rtol=1e-13)


# All of them

ALL: dict[str, tuple[Any, str, float]] = {
    "nesterov": ("nesterov", "implicit", 1.0),
    "annealing": ("annealing", "implicit", 1.0),
    "capacities": ("capacities", "optimistix", 3.0),
    "quadratic": ("quadratic", "optimistix", 1.0),
    "top-k": (TopKStep(k=2), "optimistix", 1.0),
}


@float64
@pytest.mark.parametrize("name", slow_unless({"capacities", "quadratic"}, ALL))
def test_gradients_three_ways(name: str) -> None:
    """By scores and masses; what a sum of all masses moves, no balanced plan says."""
    step, gradient, more = ALL[name]
    weights = np.random.default_rng(3).standard_normal((ROWS, COLUMNS))

    def loss(at: Inputs, config: SinkhornConfig) -> Any:
        totals = [jax.nn.logsumexp(x) for x in at[1:]]
        log_nu = at.log_nu + (totals[0] - totals[1] if more == 1 else 0)
        result = solve(at.scores, at.log_mu, log_nu, epsilon=0.7, config=config)
        return (weights * jnp.exp(result.log_plan)).sum()

    assert_three_ways(loss, inputs(more=more), step, count=200, gradient=gradient)


@pytest.mark.parametrize("name", slow_unless({"nesterov"}, ALL))
def test_float32_is_finite_for_any_scores(name: str) -> None:
    """Flat and sharp scores in one batch; half-precision ones are widened."""
    scores = jax.random.normal(jax.random.key(0), (4, 20, 5))
    scores = scores * jnp.array([0.0, 1.0, 100.0, 1e4])[:, None, None]
    config = SinkhornConfig(step=ALL[name][0], iterations=5)

    @jax.jit
    def of(scores: jax.Array) -> Any:
        result = assign_with_dustbin(scores, 1.0, config=config)
        return jnp.sin(jnp.exp(result.log_plan)).sum() + result.row_error.sum(), result

    slope, result = jax.grad(of, has_aux=True)(scores)
    assert np.isfinite(slope).all()
    assert np.isfinite(result.log_plan).all()
    # Scores of 1e4 are rounded at 1e-3, and so are their sums with potentials.
    np.testing.assert_allclose(plan_of(result).sum(axis=-1), 1, rtol=5e-3)
    half = scores[1].astype(jnp.bfloat16)
    narrow, wide = (of(x)[1].log_plan for x in (half, half.astype(jnp.float32)))
    np.testing.assert_array_equal(narrow, wide)


@pytest.mark.parametrize("name", ["annealing", "quadratic"])
def test_steps_of_balanced_problems_refuse_others(name: str) -> None:
    zeros = jnp.zeros(3)
    with pytest.raises(InputError, match=f"^step {name}: found relaxed marginals, expected"):
        solve(jnp.zeros((3, 3)), zeros, zeros, row_tau=0.5, config=SinkhornConfig(step=name))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: AnnealingStep(start=0.5), "AnnealingStep.start: found 0.5, expected at least 1"),
        (lambda: TopKStep(k=0), "TopKStep.k: found 0, expected"),
    ],
)
def test_bad_settings_raise(make: Any, message: str) -> None:
    with pytest.raises(InputError, match=f"^{message}"):
        make()
