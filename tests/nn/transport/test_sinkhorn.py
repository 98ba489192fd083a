"""Transport plans against their defining properties, numpy and torch, in float32.

Other libraries' plans and all exact gradients are in test_sinkhorn_float64.py, bad input in
test_sinkhorn_input.py, the published iterations in parity/.
"""

import dataclasses
import functools
import logging
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from crisalad_jax.sinkhorn import (
    NewtonStep,
    Potentials,
    Problem,
    SinkhornConfig,
    SinkhornResult,
    SinkhornStep,
    append_dustbin,
    assign_with_dustbin,
    log_marginals,
    marginal_error,
    register_step,
    solve,
)
from crisalad_jax.utils.errors import InputError
from tests.nn.conftest import slow_unless
from tests.nn.transport.problems import implicit


def scores_of(seed: int, *shape: int, scale: float = 1.0) -> jax.Array:
    return scale * jax.random.normal(jax.random.key(seed), shape)


def plan_of(result: SinkhornResult) -> np.ndarray:
    return np.exp(np.asarray(result.log_plan, np.float64))


# Over-relaxation


@pytest.mark.parametrize("fields", [{}, {"row_tau": 0.7}, {"column_tau": 0.7}], ids=str)
def test_over_relaxed_iterations_by_hand(fields: Any) -> None:
    scores, w = np.asarray(scores_of(2, 7, 3), np.float64), 1.5
    row_tau, column_tau = fields.get("row_tau", 1.0), fields.get("column_tau", 1.0)
    mu, nu = np.linspace(0.5, 1.5, 7), np.array([2.0, 4.0, 1.0])
    row, column = np.zeros(7), np.zeros(3)
    for _ in range(2):
        target = column_tau * (np.log(nu) - np.log(np.exp(scores + row[:, None]).sum(axis=0)))
        column = (1 - w) * column + w * target
        target = row_tau * (np.log(mu) - np.log(np.exp(scores + column).sum(axis=1)))
        row = (1 - w) * row + w * target
    # And in the end the rows are met, so that no plan is too large for a float.
    row = row_tau * (np.log(mu) - np.log(np.exp(scores + column).sum(axis=1)))
    config = SinkhornConfig(step=SinkhornStep(relaxation=w), iterations=2)
    log_mu, log_nu = jnp.log(jnp.asarray(mu)), jnp.log(jnp.asarray(nu))
    result = solve(jnp.asarray(scores), log_mu, log_nu, config=config, **fields)
    # Rounding of logarithms.
    np.testing.assert_allclose(plan_of(result), np.exp(scores + row[:, None] + column), rtol=1e-5)


@pytest.mark.parametrize("taus", [(1.0, 1.0), (0.97, 1.0), (0.3, 0.97)])
def test_over_relaxation_never_makes_the_dual_fall(taus: tuple[float, float]) -> None:
    """Where the step of 1.9 everywhere does: of columns with far too little mass.

    The dual of relaxed marginals is that of Chizat et al., Math. Comp. 2018.
    """
    scores = np.asarray(scores_of(0, 30, 5, scale=4.0), np.float64)
    log_mu, log_nu = np.zeros(30), np.log([1.0, 1, 1, 1, 26])

    def worth(log_mass: np.ndarray, potential: np.ndarray, tau: float) -> float:
        weight = tau / (1 - tau) if tau < 1 else np.inf
        gain = potential if tau == 1 else -weight * np.expm1(-potential / weight)
        return np.exp(log_mass) @ gain

    def dual(row: np.ndarray, column: np.ndarray) -> float:
        plan = np.exp(scores + row[:, None] + column)
        return worth(log_mu, row, taus[0]) + worth(log_nu, column, taus[1]) - plan.sum()

    arrays = (jnp.asarray(x, jnp.float32) for x in (scores, log_mu, log_nu))
    problem = Problem.of(*arrays, *taus)
    at, step, duals = Potentials(jnp.zeros(30), jnp.zeros(5)), SinkhornStep(relaxation=1.9), []
    for number in range(20):
        at, _ = step.step(problem, at, None, jnp.asarray(number))
        duals.append(dual(*(np.asarray(x, np.float64) for x in at)))
    # Rounding of float32 potentials of order 10, times masses of 30.
    assert (np.diff(duals) > -1e-4).all()


# Diagnostics


def test_three_iterations_leave_sharp_scores_unbalanced_and_say_so() -> None:
    result = assign_with_dustbin(scores_of(0, 50, 8, scale=10.0), 1.0)
    masses = plan_of(result).sum(axis=0)
    relative = np.abs(masses / np.array([1] * 8 + [42]) - 1).max()
    np.testing.assert_allclose(result.column_error, relative, rtol=1e-4)
    assert result.column_error > 0.01
    assert result.row_error < 1e-5  # rows are met last


def test_marginal_error_by_hand() -> None:
    plan = jnp.log(jnp.array([[0.5, 0.25], [0.5, 1.0]]))
    rows, columns = marginal_error(plan, jnp.log(jnp.array([1.0, 2.0])), jnp.log(jnp.ones(2)))
    # Rounding of logarithms.
    np.testing.assert_allclose(rows, 0.25, atol=1e-6)
    np.testing.assert_allclose(columns, 0.25, atol=1e-6)


def test_iterations_are_counted_until_nothing_changes_more() -> None:
    """The count of a loop in numpy that stops at the same change."""
    scores = np.asarray(scores_of(4, 30, 5, scale=3.0), np.float64)
    full = np.concatenate([scores, np.zeros((30, 1))], axis=1)
    log_nu = np.log([1, 1, 1, 1, 1, 25.0])
    row, column, changes = np.zeros(30), np.zeros(6), []
    for _ in range(60):
        old_row, old_column = row, column
        column = log_nu - np.log(np.exp(full + row[:, None]).sum(axis=0))
        row = -np.log(np.exp(full + column).sum(axis=1))
        shift = np.average(column - old_column, weights=np.exp(log_nu))
        moved = row - old_row + shift, column - old_column - shift
        changes.append(max(np.abs(move).max() for move in moved))
    for tolerance in (1e-1, 1e-3):
        expected = int(np.argmax(np.array(changes) <= tolerance)) + 1
        assert 3 < expected < 60
        for config in (implicit(tolerance=tolerance), implicit(tolerance=tolerance, domain="log")):
            result = assign_with_dustbin(jnp.asarray(scores, jnp.float32), 0.0, config=config)
            assert result.iterations == expected
            assert result.converged
            assert result.column_error <= tolerance


def test_a_change_of_the_rows_alone_goes_on_too() -> None:
    """Flat scores and even columns: the first step moves rows only, and the second nothing."""
    mu = np.array([0.25, 0.5, 1.0, 2.25])
    for domain in ("scaling", "log"):
        config = implicit(domain=domain)
        result = solve(jnp.zeros((4, 4)), jnp.log(mu), jnp.zeros(4), config=config)
        assert result.iterations == 2
        # Rounding of logarithms of order 1.
        np.testing.assert_allclose(plan_of(result), np.stack([mu / 4] * 4, axis=1), rtol=1e-6)


@pytest.mark.parametrize(
    "config", [SinkhornConfig(), SinkhornConfig(domain="log"), implicit()], ids=["3", "log", "rest"]
)
def test_what_is_not_finite_says_so_and_has_not_converged(config: SinkhornConfig) -> None:
    """Under `jit`, where no value can be refused; its neighbour in the batch has."""
    scores = scores_of(0, 2, 12, 4)

    @jax.jit
    def flags(scores: jax.Array) -> Any:
        result = assign_with_dustbin(scores, 1.0, config=config)
        return result.finite, result.converged

    # Without a tolerance nothing is known of convergence.
    known = np.array(config.tolerance is not None)
    for bad in (0.0, jnp.nan, jnp.inf):
        expected = [True, bool(bad == 0)]
        finite, converged = flags(scores.at[1, 3, 2].set(bad))
        np.testing.assert_array_equal(finite, expected)
        np.testing.assert_array_equal(converged, expected & known)


SLOW = pytest.mark.slow


@pytest.mark.parametrize("fields", [{}, {"step": "newton"}, {"gradient": "optimistix"}], ids=str)
def test_too_small_a_budget_is_reported_and_can_raise(fields: Any) -> None:
    scores = scores_of(0, 2, 30, 5, scale=20.0).at[1].multiply(0.001)
    config = implicit(iterations=4, **fields)
    result = assign_with_dustbin(scores, 0.0, config=config)
    np.testing.assert_array_equal(result.converged, [False, True])
    assert result.iterations[0] == 4
    assert result.iterations[1] < 4
    assert result.column_error[0] > 1e-4
    strict = dataclasses.replace(config, throw=True)
    assert assign_with_dustbin(0.001 * scores, 0.0, config=strict).converged.all()
    message = "no convergence to 1e-05 in 4 iterations"
    with pytest.raises(InputError, match=f"^sinkhorn: found {message} for 1 of 2 problems$"):
        assign_with_dustbin(scores, 0.0, config=strict)
    if not fields:
        with pytest.raises(RuntimeError, match=message):
            jax.block_until_ready(
                jax.jit(lambda x: assign_with_dustbin(x, 0.0, config=strict))(scores)
            )


@pytest.mark.parametrize(
    "fields",
    [
        {"anderson_memory": 6},
        {"step": SinkhornStep(relaxation=1.7)},
        pytest.param({"step": "newton"}, marks=SLOW),
    ],
    ids=str,
)
def test_acceleration_accelerates(fields: Any) -> None:
    """Sharp scores, where the plain iteration takes hundreds."""
    scores = scores_of(1, 4, 40, 6, scale=6.0)
    plain, fast = (
        assign_with_dustbin(scores, 0.0, config=implicit(tolerance=1e-3, iterations=2000, **more))
        for more in ({}, fields)
    )
    assert plain.converged.all()
    assert fast.converged.all()
    assert fast.iterations.sum() < 0.7 * plain.iterations.sum()
    # The tolerance, for a plain iteration a good part of the distance that is left.
    np.testing.assert_allclose(plan_of(fast), plan_of(plain), atol=3e-2)


def newton_by_hand(
    scores: np.ndarray, mu: np.ndarray, nu: np.ndarray, column: np.ndarray, temperature: float
) -> tuple[np.ndarray, float, int]:
    """The columns' potentials and the temperature after a step, and which change it took."""

    def masses(column: np.ndarray, temperature: float) -> tuple[np.ndarray, np.ndarray]:
        parts = nu * np.exp((scores + column - np.log(nu)) / temperature)
        return mu[:, None] * parts / parts.sum(axis=1, keepdims=True), parts.sum(axis=1)

    def error(column: np.ndarray, temperature: float) -> float:
        return np.abs(np.log(masses(column, temperature)[0].sum(axis=0) / nu)).max()

    if not temperature:
        temperature = 1.0
        while error(column, temperature) > 3:
            temperature *= 1.5
    plan, sums = masses(column, temperature)
    found = plan.sum(axis=0)
    hessian = np.diag(found) - plan.T @ (plan / mu[:, None])
    heavy = int(found.argmax())
    others = np.delete(np.arange(len(nu)), heavy)
    step = np.zeros(len(nu))  # a constant changes nothing: the heaviest column's unknown is 0
    step[others] = np.linalg.solve(hessian[np.ix_(others, others)], (nu - found)[others])
    step -= np.median(step)
    tries = [np.clip(step, -most, most) for most in (8, 2, 0.5)]
    tries.append(np.clip(np.log(nu / found), -8, 8))  # Sinkhorn's own
    tries = [x - np.average(x, weights=nu) for x in tries]

    def semi_dual(change: np.ndarray) -> float:
        after = masses(column + temperature * change, temperature)[1]
        return nu @ change - mu @ np.log(after / sums)

    best = int(np.argmax([semi_dual(x) for x in tries]))
    assert semi_dual(tries[best]) > 0
    off = np.abs(np.log(found / nu)).max()
    near = off <= 0.03 or (off <= 1 and np.abs(step).max() <= 2)
    after = max(temperature / 1.5, 1.0) if near else temperature
    return column + temperature * tries[best], after, best


def test_newtons_steps_by_hand() -> None:
    """Scores of four sharpnesses, from temperatures of 1 and more; the best of its changes."""
    scales = (2.0, 4.0, 20.0, 60.0)
    scores = np.stack([scale * np.asarray(scores_of(3, 12, 5), np.float64) for scale in scales])
    mu, nu = np.ones(12), np.array([1.0, 1, 1, 1, 8])
    columns, temperatures, taken = [np.zeros(5)] * 4, [0.0] * 4, set()
    with jax.enable_x64(True):
        log_mu, log_nu = np.zeros((4, 12)), np.log([nu] * 4)
        problem = Problem.of(*map(jnp.asarray, (scores, log_mu, log_nu)))
        at, newton = Potentials(jnp.zeros((4, 12)), jnp.zeros((4, 5))), NewtonStep()
        state = newton.init(problem, None)
        step = jax.jit(lambda at, state, number: newton.step(problem, at, state, number))
        started = None
        for number in range(5):
            at, state = step(at, state, number)
            for i in range(4):
                columns[i], temperatures[i], best = newton_by_hand(
                    scores[i], mu, nu, columns[i], temperatures[i]
                )
                taken.add(best)
            # Rounding of float64 potentials of 100, amplified tenfold by each of five systems.
            np.testing.assert_allclose(at.column, columns, rtol=1e-9, atol=1e-8)
            np.testing.assert_allclose(state, temperatures, rtol=1e-12)
            started = started or list(temperatures)
    assert started is not None
    assert started[0] == 1
    assert started[-1] > 5
    assert len(taken) > 1


@pytest.mark.parametrize("warm", [False, True], ids=["cold", "warm"])
def test_anderson_by_hand(warm: bool) -> None:
    """Six steps in numpy, in float64; from the fourth the oldest of three images is forgotten."""
    generator = np.random.default_rng(0)
    scores = generator.standard_normal((9, 5))
    mu, nu = np.linspace(0.5, 1.5, 9), np.array([1.0, 2, 1, 1, 4])
    init = 2 * warm * generator.standard_normal(14)
    start, images, moves = init, [], []
    for _ in range(6):
        column = np.log(nu) - np.log(np.exp(scores + start[:9, None]).sum(axis=0))
        row = np.log(mu) - np.log(np.exp(scores + column).sum(axis=1))
        images = [*images, np.append(row, column)][-3:]
        moves = [*moves, images[-1] - start][-3:]
        # Weights that sum to 1 and leave the shortest mixture of the moves: the last by the others.
        others = np.array([move - moves[-1] for move in moves[:-1]]).reshape(-1, 14).T
        weights = np.linalg.lstsq(others, -moves[-1], rcond=None)[0]
        start = np.append(weights, 1 - weights.sum()) @ np.array(images)
    expected = scores + images[-1][:9, None] + images[-1][9:]
    with jax.enable_x64(True):
        config = SinkhornConfig(anderson_memory=3, iterations=6, domain="log")
        at = Potentials(jnp.asarray(init[:9]), jnp.asarray(init[9:]))
        found = solve(jnp.asarray(scores), jnp.log(mu), jnp.log(nu), config=config, init=at)
        # Normal equations square the condition number of the moves, some 1e3: 1e6 of 1e-16.
        np.testing.assert_allclose(found.log_plan, expected, atol=1e-9)


@register_step("test-sinkhorn-plus-one")
def _plus_one(problem: Problem, at: Potentials) -> Potentials:
    return Potentials(at.row + 1, at.column)


def test_anderson_takes_the_mean_where_all_moves_are_alike() -> None:
    """Whose system is singular: a step that adds 1 to every row, from 0 to 1, 2, and from 1.5."""
    config = SinkhornConfig(
        step="test-sinkhorn-plus-one", anderson_memory=2, iterations=3, domain="log"
    )
    zeros = jnp.zeros(4)
    found = solve(jnp.zeros((4, 4)), zeros, zeros, config=config)
    # A system of condition number 2 / eps, but of exact numbers: weights to a few eps.
    np.testing.assert_allclose(found.potentials.row, 2.5, rtol=1e-6)


def test_anderson_is_the_plain_iteration_where_moves_are_too_long_to_square() -> None:
    scores, log_mu, log_nu = scores_of(2, 12, 5, scale=1e25), *log_marginals(12, 4)
    configs = (SinkhornConfig(anderson_memory=n, iterations=4, domain="log") for n in (0, 3))
    plans = [solve(scores, log_mu, log_nu, config=config) for config in configs]
    assert jnp.isfinite(plans[0].log_plan).all()
    # The potentials: plans of float32 scores of 1e25 are all rounding. The very same code.
    for plain, ours in zip(*(plan.potentials for plan in plans), strict=True):
        assert jnp.abs(plain).max() > 1e20
        np.testing.assert_array_equal(ours, plain)


def test_anderson_at_rest_has_a_gradient() -> None:
    """Flat scores, where from the second step on every move is 0, and the memory full of them."""
    zeros, weights = jnp.zeros(4), scores_of(3, 4, 4)
    config = SinkhornConfig(anderson_memory=2, iterations=5, domain="log")

    def of(scores: jax.Array) -> jax.Array:
        return (weights * jnp.exp(solve(scores, zeros, zeros, config=config).log_plan)).sum()

    # By hand, where the plan is 1/4 everywhere: a fourth of the weights, less their means by rows
    # and by columns.
    mean = np.asarray(weights, np.float64)
    mean = mean - mean.mean(axis=0) - mean.mean(axis=1, keepdims=True) + mean.mean()
    # Rounding of sums of 16 terms of order 1.
    np.testing.assert_allclose(jax.jit(jax.grad(of))(jnp.zeros((4, 4))), mean / 4, atol=1e-6)


# Domains, batches, transformations


@pytest.mark.parametrize(("apart", "scaled"), [(2, True), (55, True), (65, False), (100, False)])
def test_scaling_is_for_scores_in_a_row_up_to_60_apart(apart: int, scaled: bool) -> None:
    """Over epsilon, which is 2. The log domain has other roundings: some of 120 numbers differ."""
    scores = scores_of(3, 2, 12, 4).at[1, 5].set(jnp.array([0.0, 2.0 * apart, 0.0, 0.0]))
    scaling, logarithmic = (
        assign_with_dustbin(scores, 0.0, epsilon=2.0, config=SinkhornConfig(domain=domain)).log_plan
        for domain in ("scaling", "log")
    )
    assert (scaling != logarithmic).any() == scaled


@pytest.mark.parametrize(
    "fields", [{}, {"anderson_memory": 4}, pytest.param({"step": "newton"}, marks=SLOW)], ids=str
)
def test_a_plan_owes_nothing_to_its_batch(fields: Any) -> None:
    """The second problem takes many times the iterations of the first."""
    scores = scores_of(5, 3, 20, 4) * jnp.array([0.5, 4.0, 1.0])[:, None, None]
    together = assign_with_dustbin(scores, 0.0, config=implicit(**fields))
    assert together.iterations[1] > together.iterations[0]
    for index in range(3):
        alone = assign_with_dustbin(scores[index : index + 1], 0.0, config=implicit(**fields))
        assert alone.iterations[0] == together.iterations[index]
        # Rounding: matrix products of a batch may add up in another order.
        np.testing.assert_allclose(plan_of(together)[index], plan_of(alone)[0], rtol=1e-5)


def test_any_leading_axes_jit_and_vmap_agree() -> None:
    scores = scores_of(6, 2, 3, 12, 4, scale=2.0)
    weights = scores_of(7, 12, 5)

    def of(scores: jax.Array) -> Any:
        result = assign_with_dustbin(scores, 1.0, config=implicit())
        return (weights * jnp.exp(result.log_plan)).sum(), result

    both = jax.grad(of, has_aux=True)
    gradient, result = jax.jit(both)(scores)
    assert result.log_plan.shape == (2, 3, 12, 5)
    assert result.potentials.row.shape == (2, 3, 12)
    assert result.potentials.column.shape == (2, 3, 5)
    for field in (result.row_error, result.column_error, result.iterations, result.converged):
        assert field.shape == (2, 3)
    mapped = jax.jit(jax.vmap(jax.vmap(both)))(scores)
    row = jax.jit(both)(scores[1])
    one = jax.jit(both)(scores[1, 2])
    for ours, theirs in (
        (mapped, (gradient, result)),
        (row, jax.tree.map(lambda x: x[1], (gradient, result))),
        (one, jax.tree.map(lambda x: x[1, 2], (gradient, result))),
    ):
        np.testing.assert_array_equal(ours[1].iterations, theirs[1].iterations)
        # Rounding of logarithms of order 10.
        np.testing.assert_allclose(ours[1].log_plan, theirs[1].log_plan, atol=1e-5)
        np.testing.assert_allclose(ours[0], theirs[0], atol=1e-5)


def test_newton_meets_sharp_scores_in_float32() -> None:
    """Cosines of unit vectors at an epsilon of 1e-3, and scores that are a hundred times sharper.

    In as few iterations as are asserted: 32 and fewer were seen.
    """
    config = implicit(step="newton", tolerance=1e-3, iterations=60)
    patches, clusters = (
        x / jnp.linalg.norm(x, axis=-1, keepdims=True)
        for x in (scores_of(0, 4, 256, 16), scores_of(1, 4, 64, 16))
    )
    cosines = jnp.einsum("bnd,bkd->bnk", patches, clusters)
    for scores, epsilon in ((cosines, 1e-3), (scores_of(0, 4, 30, 6, scale=100.0), 1.0)):
        result = assign_with_dustbin(scores, 0.0, epsilon=epsilon, config=config)
        assert result.converged.all()
        masses = plan_of(result).sum(axis=1)
        rows, columns = scores.shape[1:]
        # The tolerance, and rounding of logarithms of 500 or 1000.
        np.testing.assert_allclose(masses, [[1] * columns + [rows - columns]] * 4, rtol=1.2e-3)


@pytest.mark.parametrize(("share", "expected"), [(0.75, False), (1.25, True)])
def test_the_last_change_is_within_the_tolerance_or_it_has_not_converged(
    share: float, expected: bool
) -> None:
    """By numpy, with relaxed rows; four iterations are all that there are."""
    scores = np.asarray(scores_of(2, 7, 3), np.float64)
    log_mu, log_nu = np.log(np.linspace(0.5, 1.5, 7)), np.log([2.0, 4.0, 1.0])
    row, column, changes = np.zeros(7), np.zeros(3), []
    for _ in range(4):
        old = np.concatenate([row, column])
        column = log_nu - scipy.special.logsumexp(scores + row[:, None], axis=0)
        row = 0.7 * (log_mu - scipy.special.logsumexp(scores + column, axis=1))
        changes.append(np.abs(np.concatenate([row, column]) - old).max())
    config = implicit(iterations=4, tolerance=share * changes[-1])
    masses = jnp.asarray(log_mu), jnp.asarray(log_nu)
    result = solve(jnp.asarray(scores), *masses, config=config, row_tau=0.7)
    assert changes[-2] > 1.25 * changes[-1]
    assert bool(result.converged) is expected


def test_a_tolerance_below_the_rounding_of_masses_is_met() -> None:
    """Nothing moves any more; that rounded masses miss their marginals by more is no reproach."""
    masses = jnp.zeros(30), jnp.log(jnp.full(5, 6.0))
    result = solve(scores_of(0, 30, 5), *masses, config=implicit(tolerance=1e-9, iterations=500))
    assert result.column_error > 1e-9
    assert result.iterations < 100
    assert result.converged


def test_what_misses_a_marginal_has_not_converged() -> None:
    """Totals that differ, where they are not known: rows are met, columns cannot be."""
    log_nu = jnp.log(jnp.array([1.0, 2.0, 3.0]))

    def of(log_nu: jax.Array) -> SinkhornResult:
        return solve(scores_of(0, 6, 3), jnp.zeros(6), log_nu, config=implicit())

    assert jax.jit(of)(log_nu).converged
    result = jax.jit(of)(log_nu + 1)
    assert result.column_error > 0.5
    assert not result.converged


def test_relaxed_masses_too_large_for_a_float_still_have_gradients() -> None:
    """Of the logarithm of the plan."""
    taus = {"row_tau": 0.9, "column_tau": 0.8}

    def log_plan(scores: jax.Array) -> jax.Array:
        config = implicit(iterations=1000)
        return assign_with_dustbin(scores, 0.0, config=config, **taus).log_plan

    scores = scores_of(0, 12, 4, scale=1e3)
    assert jnp.isinf(jnp.exp(log_plan(scores))).any()
    gradient = jax.grad(lambda x: jnp.tanh(0.01 * log_plan(x)).sum())(scores)
    assert jnp.isfinite(gradient).all()
    assert jnp.abs(gradient).max() > 1e-3


@pytest.mark.parametrize("apart", [1.0, 100.0])
def test_one_column_has_a_plan_and_a_gradient(apart: float) -> None:
    """All mass goes there, whatever the scores."""
    scores = apart * scores_of(0, 2, 6, 1)

    def of(scores: jax.Array) -> jax.Array:
        return solve(scores, jnp.zeros(6), jnp.log(jnp.array([6.0]))).log_plan

    # Potentials of the scores' size cancel them.
    np.testing.assert_allclose(of(scores), np.zeros((2, 6, 1)), atol=1e-6 * apart)
    gradient = jax.grad(lambda scores: (scores_of(1, 2, 6, 1) * of(scores)).sum())(scores)
    np.testing.assert_allclose(gradient, np.zeros((2, 6, 1)), atol=1e-6)


@pytest.mark.parametrize(
    "config",
    [SinkhornConfig(), implicit(anderson_memory=3), implicit(step="newton")],
    ids=["3", "anderson", "newton"],
)
def test_no_problems_at_all(config: SinkhornConfig) -> None:
    def of(scores: jax.Array) -> jax.Array:
        return assign_with_dustbin(scores, 1.0, config=config).log_plan.sum()

    assert jax.grad(of)(jnp.zeros((0, 6, 3))).shape == (0, 6, 3)


def test_half_precision_is_widened() -> None:
    scores = scores_of(8, 12, 4).astype(jnp.bfloat16)
    result = assign_with_dustbin(scores, jnp.bfloat16(1))
    assert result.log_plan.dtype == jnp.float32
    wide = assign_with_dustbin(scores.astype(jnp.float32), 1.0)
    np.testing.assert_array_equal(result.log_plan, wide.log_plan)
    gradient = jax.grad(
        lambda s: jnp.exp(assign_with_dustbin(s, jnp.bfloat16(1)).log_plan)[:, 0].sum()
    )(scores)
    assert gradient.dtype == jnp.bfloat16
    assert jnp.abs(gradient).max() > 0


@pytest.mark.slow
def test_nothing_is_compiled_anew_for_another_number(caplog: pytest.LogCaptureFixture) -> None:
    scores = scores_of(9, 11, 4)
    log_mu, log_nu = log_marginals(11, 4)

    def everything(number: float) -> None:
        assign_with_dustbin(scores + number, jnp.float32(number))
        assign_with_dustbin(scores, jnp.float32(number), epsilon=number)
        assign_with_dustbin(scores, jnp.float32(number), "mass")
        full = append_dustbin(scores, jnp.float32(number))
        solve(full, log_mu, log_nu, epsilon=number)
        solve(full, log_mu, log_nu, epsilon=jnp.float32(number), config=implicit())

    jax.clear_caches()
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        everything(0.5)
        assert any("Compiling" in record.message for record in caplog.records)
        caplog.clear()
        everything(0.75)
        assert not [r.message for r in caplog.records if "Compiling" in r.message]


SHARDED = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from crisalad_jax.sinkhorn import SinkhornConfig, assign_with_dustbin

assert len(jax.devices()) == 8
scores = 2 * jax.random.normal(jax.random.key(0), (16, 12, 4))
weights = jax.random.normal(jax.random.key(1), (12, 5))
over = NamedSharding(Mesh(np.array(jax.devices()), ("batch",)), PartitionSpec("batch"))
spread = jax.device_put(scores, over)
for fields in ({}, {"gradient": "implicit", "tolerance": 1e-5, "iterations": 300}):
    def of(scores):
        result = assign_with_dustbin(scores, 1.0, config=SinkhornConfig(**fields))
        return (weights * jnp.exp(result.log_plan)).sum(), result

    mapped = jax.shard_map(
        lambda x: of(x)[1].log_plan, mesh=over.mesh, in_specs=over.spec, out_specs=over.spec
    )
    np.testing.assert_allclose(jax.jit(mapped)(spread), of(scores)[1].log_plan, atol=1e-5)
    step = jax.jit(jax.grad(of, has_aux=True))
    for x in (1, 100):  # in range of the scaling domain, and out of it
        gradient, result = step(x * spread)
        expected_gradient, expected = step(x * scores)
        assert len(result.log_plan.sharding.device_set) == 8, result.log_plan.sharding
        np.testing.assert_array_equal(result.iterations, expected.iterations)
        # Rounding of logarithms of order 10 x.
        np.testing.assert_allclose(result.log_plan, expected.log_plan, atol=1e-5 * x)
        np.testing.assert_allclose(gradient, expected_gradient, atol=1e-5)
print("agreed")
"""


@pytest.mark.slow
def test_eight_devices_give_the_same_plans() -> None:
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=8", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", SHARDED],
        env={**os.environ, **flags},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "agreed\n", done.stderr


# Finite for finite scores

CLUSTERS = 8
MODES: dict[str, dict[str, Any]] = {
    "scaling": {},
    "scan": {"config": SinkhornConfig(iterations=10)},
    "relaxation": {"config": SinkhornConfig(step=SinkhornStep(1.9), iterations=10)},
    "anderson": {"config": SinkhornConfig(anderson_memory=4, iterations=10)},
    "implicit": {"config": implicit(iterations=30)},
    "implicit, relaxation": {"config": implicit(iterations=30, step=SinkhornStep(1.9))},
    "newton": {"config": implicit(iterations=6, step="newton")},
    "optimistix": {"config": implicit(iterations=30, gradient="optimistix")},
    "columns": {"config": implicit(iterations=30), "column_tau": 0.5},
    "mass": {"dustbin": "mass"},
    "row and column": {"dustbin": "row and column"},
    "token": {"config": implicit(iterations=30), "dustbin": "token"},
}
QUICK = {"scaling", "scan", "relaxation", "implicit", "implicit, relaxation", "newton", "columns"}
PATTERNS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "random": lambda scores: scores,
    "flat": lambda scores: 0 * scores + scores[0, 0],
    "sharp": lambda scores: jnp.where(scores == scores.max(axis=1, keepdims=True), 1.0, -1.0),
    "one cluster": lambda scores: jnp.zeros_like(scores).at[:, 0].set(1.0).at[:, 1].set(-1.0),
    "one patch": lambda scores: jnp.zeros_like(scores).at[0].set(-1.0).at[0, 0].set(1.0),
    "low rank": lambda scores: scores[:, :1] * scores[:1],
}


@functools.lru_cache
def finite_check(mode: str, mapped: bool) -> Callable[[jax.Array, jax.Array], Any]:
    def loss(scores: jax.Array, dustbin: jax.Array) -> jax.Array:
        log_plan = assign_with_dustbin(scores, dustbin, **MODES[mode]).log_plan
        # Through the plan as in a model, and through its logarithm.
        return jnp.sin(jnp.exp(log_plan)).sum() + 1e-3 * log_plan.sum()

    both = jax.value_and_grad(loss, argnums=(0, 1))
    return jax.jit(jax.vmap(both) if mapped else both)


@pytest.mark.parametrize("mapped", [False, pytest.param(True, marks=SLOW)])
@pytest.mark.parametrize("rows", [CLUSTERS + 1, *(pytest.param(n, marks=SLOW) for n in (40, 2048))])
@pytest.mark.parametrize("mode", slow_unless(QUICK, MODES))
@given(
    pattern=st.sampled_from(sorted(PATTERNS)),
    scale=st.sampled_from([1e-3, 1.0, 10.0, 30.0, 100.0, 1e3, 1e4]),
    seed=st.integers(0, 1000),
)
@example(pattern="random", scale=1e4, seed=0)
@example(pattern="sharp", scale=1e4, seed=0)
@settings(max_examples=12, deadline=None)
def test_never_nan(
    mode: str, rows: int, mapped: bool, pattern: str, scale: float, seed: int
) -> None:
    """With the least mass that a dustbin can have, and scores of 30 either side of the guard.

    Under `vmap`, beside a harmless problem, both of what the guard chooses from are computed.
    """
    scores = jnp.clip(scale * PATTERNS[pattern](scores_of(seed, rows, CLUSTERS)), -1e4, 1e4)
    dustbin = jnp.full(rows, 1.0) if MODES[mode].get("dustbin") == "token" else jnp.float32(1)
    if mapped:
        scores, dustbin = jnp.stack([scores, 0.1 * scores]), jnp.stack([dustbin, dustbin])
    out = finite_check(mode, mapped)(scores, dustbin)
    for name, x in zip(("value", "gradient", "dustbin's"), jax.tree.leaves(out), strict=True):
        assert jnp.isfinite(x).all(), (name, x)


@pytest.mark.parametrize(
    "taus", [{}, pytest.param({"row_tau": 0.9, "column_tau": 0.8}, marks=SLOW)], ids=str
)
def test_implicit_gradient_in_float32(taus: Any) -> None:
    """Against the same in float64, which test_sinkhorn_float64.py holds to unrolling."""
    scores = np.asarray(scores_of(10, 4, 64, 16, scale=3.0))
    weights = np.asarray(scores_of(11, 64, 17))

    def gradient(dtype: Any, tolerance: float) -> np.ndarray:
        def of(scores: jax.Array) -> jax.Array:
            config = implicit(tolerance=tolerance, iterations=1000)
            result = assign_with_dustbin(scores, jnp.zeros((), dtype), config=config, **taus)
            return (jnp.asarray(weights, dtype) * jnp.exp(result.log_plan)).sum()

        return np.asarray(jax.jit(jax.grad(of))(jnp.asarray(scores, dtype)))

    ours = {tolerance: gradient(jnp.float32, tolerance) for tolerance in (1e-5, 1e-3)}
    with jax.enable_x64(True):
        exact = gradient(jnp.float64, 1e-12)
    errors = {x: np.linalg.norm(found - exact) / np.linalg.norm(exact) for x, found in ours.items()}
    # What is left where the last change was the tolerance: these contract by 0.5 to 0.83 a
    # step, so that the worst entry is up to five tolerances off; but in norm over all entries a
    # fourth of one at most, in float64 as well. The rest is rounding, of 1e-6.
    assert errors[1e-5] < 1e-5
    assert errors[1e-3] < 1e-3


# Dustbins


def test_no_dustbin_shares_the_patches_alike() -> None:
    config = SinkhornConfig(iterations=100)
    result = assign_with_dustbin(scores_of(0, 12, 5), None, "none", config=config)
    plan = plan_of(result)
    assert plan.shape == (12, 5)
    # What float32 potentials allow at convergence.
    np.testing.assert_allclose(plan.sum(axis=0), 12 / 5, rtol=1e-5)
    np.testing.assert_allclose(plan.sum(axis=1), 1, rtol=1e-5)
    # As few patches as one likes.
    few = assign_with_dustbin(scores_of(0, 3, 5), None, "none", config=config)
    np.testing.assert_allclose(plan_of(few).sum(axis=0), 3 / 5, rtol=1e-5)


def test_row_and_column_are_superglue() -> None:
    """Its log_optimal_transport, written out in torch from the paper (Sarlin et al., Eq. 7-9)."""
    scores, alpha, rows, clusters = np.asarray(scores_of(1, 9, 4)), 0.8, 9, 4
    couplings = torch.full((rows + 1, clusters + 1), alpha, dtype=torch.float64)
    couplings[:-1, :-1] = torch.from_numpy(scores)
    mu = torch.tensor([1.0] * rows + [clusters], dtype=torch.float64) / (rows + clusters)
    nu = torch.tensor([1.0] * clusters + [rows], dtype=torch.float64) / (rows + clusters)
    u, v = torch.zeros(rows + 1), torch.zeros(clusters + 1)
    for _ in range(100):
        u = mu.log() - torch.logsumexp(couplings + v, dim=1)
        v = nu.log() - torch.logsumexp(couplings + u[:, None], dim=0)
    expected = (couplings + u[:, None] + v).exp() * (rows + clusters)
    config = SinkhornConfig(iterations=100)
    result = assign_with_dustbin(
        jnp.asarray(scores), jnp.float32(alpha), "row and column", config=config
    )
    ours = plan_of(result)
    # Both have converged: rounding of logarithms. The dustbin's row is left out.
    np.testing.assert_allclose(ours, expected[:-1], rtol=1e-5)


def test_a_score_a_patch() -> None:
    """As a column of scores like any other."""
    scores, dustbin = scores_of(2, 3, 12, 4), scores_of(3, 3, 12)
    ours = assign_with_dustbin(scores, dustbin, "token")
    full = jnp.concatenate([scores, dustbin[..., None]], axis=-1)
    log_nu = jnp.log(jnp.array([1.0, 1, 1, 1, 8]))
    expected = solve(full, jnp.zeros(12), log_nu)
    np.testing.assert_allclose(ours.log_plan, expected.log_plan, atol=1e-6)  # rounding


@pytest.mark.parametrize("logit", [-2.0, 0.0, 3.0])
def test_learnt_mass(logit: float) -> None:
    config = SinkhornConfig(iterations=100)
    result = assign_with_dustbin(scores_of(4, 12, 4), jnp.float32(logit), "mass", config=config)
    plan = plan_of(result)
    share = 1 / (1 + np.exp(-logit))
    # What float32 potentials allow at convergence.
    np.testing.assert_allclose(plan.sum(axis=0)[-1], 12 * share, rtol=1e-5)
    np.testing.assert_allclose(plan.sum(axis=0)[:-1], 12 * (1 - share) / 4, rtol=1e-5)
    np.testing.assert_allclose(plan.sum(axis=1), 1, rtol=1e-5)


@pytest.mark.parametrize("dustbin", ["none", "column", "row and column", "token", "mass"])
def test_epsilon_divides_the_scores_under_every_dustbin(dustbin: Any) -> None:
    """And the dustbin's, where it has one: the logit of a mass it leaves alone."""
    scores = scores_of(6, 12, 4)
    score = {"none": None, "token": scores_of(3, 12)}.get(dustbin, jnp.float32(1.5))
    divided = score if score is None or dustbin == "mass" else score / 0.25
    ours = assign_with_dustbin(scores, score, dustbin, epsilon=0.25)
    expected = assign_with_dustbin(scores / 0.25, divided, dustbin)
    # Division by a power of two is exact: rounding of logarithms of order 10 at most.
    np.testing.assert_allclose(ours.log_plan, expected.log_plan, atol=1e-5)


def dustbin_gradient(at: jax.Array, iterations: int = 3, **problem: Any) -> jax.Array:
    """Of the plan's clusters, squared, for sharp scores."""
    scores = scores_of(5, 20, 4, scale=3.0)

    def loss(dustbin: jax.Array) -> jax.Array:
        config = SinkhornConfig(iterations=iterations)
        log_plan = assign_with_dustbin(scores, dustbin, config=config, **problem).log_plan
        return (jnp.exp(log_plan[..., :4]) ** 2).sum()

    return jax.jit(jax.grad(loss))(at)


@pytest.mark.parametrize(("iterations", "z"), [(1, 10.0), (3, 1.0), (20, -10.0)])
def test_the_published_dustbin_is_dead(iterations: int, z: float) -> None:
    # Sums of 20 float32 terms that cancel.
    assert jnp.abs(dustbin_gradient(jnp.float32(z), iterations=iterations)) < 1e-5
    config = SinkhornConfig(iterations=iterations)
    plans = [plan_of(assign_with_dustbin(scores_of(5, 20, 4), x, config=config)) for x in (0.0, z)]
    np.testing.assert_allclose(*plans, atol=1e-5)  # rounding of logarithms of 10


def test_other_dustbins_live() -> None:
    """By margins of 100 and more over the rounding above."""
    one, many = jnp.float32(1), jnp.ones(20)
    assert jnp.abs(dustbin_gradient(many, dustbin="token")).max() > 0.03
    assert jnp.abs(dustbin_gradient(one, dustbin="mass")) > 0.1
    assert jnp.abs(dustbin_gradient(one, dustbin="row and column")) > 1e-3
    assert jnp.abs(dustbin_gradient(one, column_tau=0.9, iterations=20)) > 0.03


# Baselines, and what a step may be


def test_softmax_and_dual_softmax_are_torchs() -> None:
    scores, epsilon = scores_of(6, 2, 7, 3), 0.6
    kernel = torch.from_numpy(np.asarray(scores)) / epsilon
    bin_ = torch.cat([kernel, torch.full((2, 7, 1), 1.5 / epsilon)], dim=2)
    config = SinkhornConfig(step="softmax")
    # Rounding.
    ours = plan_of(assign_with_dustbin(scores, jnp.float32(1.5), epsilon=epsilon, config=config))
    np.testing.assert_allclose(ours, bin_.softmax(dim=2), rtol=1e-5)
    dual = SinkhornConfig(step="dual-softmax")
    result = assign_with_dustbin(scores, None, "none", epsilon=epsilon, config=dual)
    expected = kernel.softmax(dim=2) * kernel.softmax(dim=1)
    np.testing.assert_allclose(plan_of(result), expected, rtol=1e-5)
    log_mu, log_nu = jnp.log(jnp.arange(1.0, 8)), jnp.log(jnp.array([4.0, 12, 12]))
    weighted = solve(scores, log_mu, log_nu, config=SinkhornConfig(step="softmax"))
    # Each row has the mass that it is given.
    np.testing.assert_allclose(plan_of(weighted).sum(axis=2), [np.arange(1.0, 8)] * 2, rtol=1e-5)
    # Steps like any other, which change nothing from the second on.
    rested = solve(scores, log_mu, log_nu, config=implicit(gradient="stop", step="softmax"))
    assert rested.iterations.tolist() == [2, 2]
    assert rested.converged.all()
    # The potentials make the plan, the masses in them.
    row, column = weighted.potentials
    made = scores + row[..., None] + column[:, None]
    np.testing.assert_allclose(weighted.log_plan, made, atol=1e-6)  # rounding


@register_step("test-sinkhorn-capacity")
def _capacity(problem: Problem, potentials: Potentials) -> Potentials:
    """Columns take no more than their marginals, and may take less."""
    column = jnp.minimum(problem.log_nu - problem.lse_rows(potentials.row), 0)
    return Potentials(problem.log_mu - problem.lse_columns(column), column)


def test_a_step_with_marginals_of_its_own() -> None:
    """Optimal: no column above its capacity, and only full ones have a price."""
    scores = scores_of(7, 20, 4, scale=2.0)
    log_mu, log_nu = jnp.zeros(20), jnp.log(jnp.array([3.0, 4, 30, 30]))
    for gradient in ("stop", "optimistix"):
        config = implicit(gradient=gradient, step="test-sinkhorn-capacity")
        # A tau below 1 says that totals may differ.
        result = solve(scores, log_mu, log_nu, column_tau=0.5, config=config)
        assert result.converged
        masses, price = plan_of(result).sum(axis=0), result.potentials.column
        np.testing.assert_allclose(masses[:2], [3, 4], rtol=1e-4)  # ten times the tolerance
        assert (masses[2:] < 29).all()
        assert (price[:2] < -0.1).all()
        np.testing.assert_array_equal(price[2:], 0)
        np.testing.assert_allclose(plan_of(result).sum(axis=1), 1, rtol=1e-5)
