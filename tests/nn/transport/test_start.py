"""Where solvers start, against potentials computed in numpy and scipy."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from crisalad_jax.nn.transport.start import from_columns
from crisalad_jax.sinkhorn import (
    GaussianStart,
    NetworkStart,
    Potentials,
    Problem,
    SinkhornConfig,
    Start,
    assign_with_dustbin,
    register_start,
    solve,
)
from crisalad_jax.utils.errors import InputError
from tests.nn.conftest import slow_unless
from tests.nn.transport.problems import assert_three_ways, implicit

ROWS, COLUMNS = 12, 5


def inputs(std: float = 2.0) -> tuple[Any, Any, Any]:
    generator = np.random.default_rng(0)
    scores = std * generator.standard_normal((2, ROWS, COLUMNS))
    mu, nu = generator.uniform(0.5, 2, ROWS), generator.uniform(0.5, 3, COLUMNS)
    return tuple(map(jnp.asarray, (scores, np.log(mu), np.log(nu * mu.sum() / nu.sum()))))


def problem_of(scores: Any, log_mu: Any, log_nu: Any) -> Problem:
    lead = (*scores.shape[:-2], 1)
    return Problem.of(scores, log_mu + jnp.zeros(lead), log_nu + jnp.zeros(lead))


@pytest.mark.usefixtures("float64")
def test_the_gaussian_guess_by_hand() -> None:
    """Its matrix root by scipy; rows are met."""
    scores, log_mu, log_nu = map(np.asarray, inputs())
    found = GaussianStart().potentials(problem_of(*inputs()), None)
    mu, nu = (np.exp(x) / np.exp(x).sum() for x in (log_mu, log_nu))
    for each, row, column in zip(scores, *map(np.asarray, found), strict=True):
        mean = mu @ each
        off = each - mean
        off = np.sqrt(mu)[:, None] * (off - (off @ nu)[:, None]) * np.sqrt(nu)
        bend = np.real(np.diag(scipy.linalg.sqrtm(np.eye(COLUMNS) + 4 * off.T @ off))) - 1
        # Rounding, and of scipy's root.
        np.testing.assert_allclose(column, log_nu - mean - bend / (4 * nu), atol=1e-10)
        plan = np.exp(each + row[:, None] + column)
        np.testing.assert_allclose(plan.sum(axis=1), np.exp(log_mu), rtol=1e-12)


@pytest.mark.usefixtures("float64")
def test_the_gaussian_guess_is_exact_for_gaussians() -> None:
    """Scores are products of points on a line with normal masses: potentials are quadratic there.

    The closed form of Janati et al. (2020) in one dimension, by solving its two conditions.
    """
    points = np.linspace(-6, 6, 81)
    scale, masses = (1.0, 1.5), []
    for deviation in scale:
        mass = np.exp(-0.5 * (points / deviation) ** 2)
        masses.append(np.log(mass / mass.sum()))
    scores = jnp.asarray(0.5 * np.outer(points, points))
    log_mu, log_nu = map(jnp.asarray, masses)
    start = GaussianStart().potentials(problem_of(scores, log_mu, log_nu), None)
    exact = solve(scores, log_mu, log_nu, config=implicit(tolerance=1e-10, iterations=5000))
    bend = (start.column - exact.potentials.column)[20:61]  # to two deviations
    # The line ends at four deviations of the wider, which cuts its tails of 1e-4.
    np.testing.assert_allclose(bend - bend.mean(), 0, atol=2e-2)
    assert np.ptp(exact.potentials.column - log_nu) > 1


@pytest.mark.parametrize("start", slow_unless({"network"}, ("gaussian", "network")))
def test_a_start_is_nearer_and_arrives_at_the_same_plan(start: str) -> None:
    """Scores of low rank, of which one Gaussian iteration leaves less than half the error."""
    keys = jax.random.split(jax.random.key(0))
    scores = 0.8 * jax.random.normal(keys[0], (4, 60, 3)) @ jax.random.normal(keys[1], (4, 3, 8))
    part = {"gaussian": GaussianStart(), "network": NetworkStart()}[start]
    params = part.init_params(jax.random.key(1))
    options: dict[str, Any] = {"start_params": params}
    once = SinkhornConfig(iterations=1, start=start)
    cold = assign_with_dustbin(scores, 0.0, config=SinkhornConfig(iterations=1))
    warm = assign_with_dustbin(scores, 0.0, config=once, **options)
    assert (warm.column_error < (0.5 if start == "gaussian" else 1) * cold.column_error).all()
    config = implicit(start=start)
    found = assign_with_dustbin(scores, 0.0, config=config, **options)
    expected = assign_with_dustbin(scores, 0.0, config=implicit())
    assert found.converged.all()
    assert (found.iterations <= expected.iterations).all()
    # Ten times the tolerance of each.
    np.testing.assert_allclose(jnp.exp(found.log_plan), jnp.exp(expected.log_plan), atol=2e-4)


@pytest.mark.usefixtures("float64")
def test_a_network_that_moves_nothing_is_an_iteration() -> None:
    """The first; and one with weights is numpy's."""
    part = NetworkStart(hidden=3)
    params = part.init_params(jax.random.key(0))
    config = SinkhornConfig(iterations=2, start=part)
    found = solve(*inputs(), config=config, start_params=params)
    expected = solve(*inputs(), config=SinkhornConfig(iterations=3))
    # The same sums.
    np.testing.assert_allclose(found.log_plan, expected.log_plan, atol=1e-12)
    params |= {"out": jnp.array([0.5, -1.0, 0.2]), "bias": jnp.array([0.1, 0.0, -0.3])}
    moved = part.potentials(problem_of(*inputs()), params)
    scores, log_mu, log_nu = map(np.asarray, inputs())
    mu = np.exp(log_mu) / np.exp(log_mu).sum()
    first = log_nu - np.log(np.exp(scores).sum(axis=1))
    mean = np.einsum("n,bnk->bk", mu, scores)
    deviation = np.sqrt(np.einsum("n,bnk->bk", mu, (scores - mean[:, None]) ** 2))
    inner = np.stack([first, mean, deviation, scores.max(axis=1)], axis=-1)
    hidden = np.tanh(inner @ np.asarray(params["hidden"]) + np.asarray(params["bias"]))
    # The floor of the variance.
    np.testing.assert_allclose(moved.column, first + hidden @ params["out"], atol=1e-10)


@pytest.mark.slow
@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("start", ["gaussian", "network"])
def test_gradients_through_a_start(start: str) -> None:
    """Of two iterations, by differences; at convergence none is left of it."""
    scores, log_mu, log_nu = inputs()
    weights = np.random.default_rng(3).standard_normal(scores.shape)
    params = NetworkStart().init_params(jax.random.key(0))
    params = jax.tree.map(lambda x: x.astype(jnp.float64) + 0.1, params)

    def loss(scores: Any, config: SinkhornConfig) -> Any:
        config = dataclasses.replace(config, start=start)
        options = {"start_params": params} if start == "network" else {}
        result = solve(scores, log_mu, log_nu, config=config, **options)
        return (weights * jnp.exp(result.log_plan)).sum()

    assert_three_ways(loss, scores, "sinkhorn", count=200, gradient="implicit")
    few, by = SinkhornConfig(iterations=1), 1e-5
    slope = jax.jit(jax.grad(lambda x: loss(x, few)))(scores)
    towards = np.random.default_rng(4).standard_normal(scores.shape)
    difference = (loss(scores + by * towards, few) - loss(scores - by * towards, few)) / (2 * by)
    # Third derivatives of order 10 to 1e3 times 1e-10.
    np.testing.assert_allclose((slope * towards).sum(), difference, rtol=1e-6)


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("start", slow_unless({"gaussian"}, ("gaussian", "network")))
def test_no_mass_is_the_problem_without(start: str) -> None:
    scores, log_mu, log_nu = inputs()
    log_mu, log_nu = log_mu.at[3].set(-jnp.inf), log_nu.at[1].set(-jnp.inf)
    log_nu = log_nu + jnp.log(jnp.exp(log_mu).sum() / jnp.exp(log_nu).sum())
    params = NetworkStart().init_params(jax.random.key(0)) if start == "network" else None

    def of(scores: Any, log_mu: Any, log_nu: Any) -> Any:
        config = SinkhornConfig(iterations=2, start=start)
        log_plan = solve(scores, log_mu, log_nu, config=config, start_params=params).log_plan
        return (jnp.exp(log_plan) ** 2).sum(), log_plan

    less = jnp.delete(jnp.delete(scores, 3, axis=1), 1, axis=2)
    both = jax.jit(jax.grad(of, has_aux=True))
    slope, log_plan = both(scores, log_mu, log_nu)
    slope_less, expected = both(less, jnp.delete(log_mu, 3), jnp.delete(log_nu, 1))
    for found, wanted in ((slope, slope_less), (log_plan, expected)):
        kept = jnp.delete(jnp.delete(found, 3, axis=1), 1, axis=2)
        # Other sums, and an eigendecomposition of another size.
        np.testing.assert_allclose(kept, wanted, rtol=1e-8, atol=1e-10)


def test_float32_is_finite_for_any_scores() -> None:
    scores = jax.random.normal(jax.random.key(0), (4, 20, 5))
    scores = scores * jnp.array([0.0, 1.0, 100.0, 1e4])[:, None, None]

    def of(scores: jax.Array) -> jax.Array:
        config = SinkhornConfig(start="gaussian")
        return jnp.sin(jnp.exp(assign_with_dustbin(scores, 1.0, config=config).log_plan)).sum()

    assert np.isfinite(jax.jit(jax.grad(of))(scores)).all()


@register_start("test-start-rows")
@dataclasses.dataclass(frozen=True)
class _Rows(Start):
    """Rows alone."""

    def potentials(self, problem: Problem, params: Any) -> Any:
        return from_columns(problem, problem.zeros().column).row


def test_what_is_no_start_is_refused() -> None:
    zeros = jnp.zeros(3)
    with pytest.raises(InputError, match="start test-start-rows: found to return"):
        solve(jnp.zeros((3, 3)), zeros, zeros, config=SinkhornConfig(start="test-start-rows"))
    words = "^start network: found no start_params, expected those of its init_params"
    with pytest.raises(InputError, match=words):
        solve(jnp.zeros((3, 3)), zeros, zeros, config=SinkhornConfig(start="network"))
    own = solve(
        jnp.zeros((3, 3)),
        zeros,
        zeros,
        config=SinkhornConfig(start="network"),
        init=Potentials(zeros, zeros),
    )
    assert own.finite  # an init needs no start
