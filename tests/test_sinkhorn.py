"""Transport plans against their defining properties, and against torch-free recomputation.

The published outputs and gradients are in parity/test_goldens.py.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crisalad_jax.config import SinkhornConfig
from crisalad_jax.errors import InputError
from crisalad_jax.sinkhorn import (
    append_dustbin,
    assign,
    log_marginals,
    marginal_error,
    sinkhorn,
)


def scores_of(seed: int, *shape: int, scale: float = 1.0) -> jax.Array:
    return scale * jax.random.normal(jax.random.key(seed), shape)


def test_equals_the_scaling_form_in_float64() -> None:
    """u = mu / (K v), v = nu / (K^T u), written out in numpy."""
    scores, epsilon = np.asarray(scores_of(0, 9, 4), np.float64), 0.7
    kernel = np.exp(np.concatenate([scores, np.full((9, 1), 1.3)], axis=1) / epsilon)
    nu = np.array([1, 1, 1, 1, 5.0])
    u = np.ones(9)
    for _ in range(4):
        v = nu / (kernel.T @ u)
        u = 1 / (kernel @ v)
    expected = u[:, None] * kernel * v
    config = SinkhornConfig(iterations=4, epsilon=epsilon)
    ours = jnp.exp(assign(jnp.asarray(scores, jnp.float32), jnp.float32(1.3), config).log_plan)
    np.testing.assert_allclose(ours, expected, rtol=1e-5)  # logarithms of order 5 in float32


def test_converged_plan_meets_both_marginals_and_reports_it() -> None:
    result = assign(scores_of(0, 2, 20, 6), jnp.float32(0), SinkhornConfig(iterations=200))
    plan = np.exp(np.asarray(result.log_plan, np.float64))
    # What float32 potentials allow at convergence.
    np.testing.assert_allclose(plan.sum(axis=2), 1, atol=1e-5)
    np.testing.assert_allclose(plan.sum(axis=1), [[1] * 6 + [14]] * 2, rtol=1e-5)
    assert result.row_error.shape == result.column_error.shape == (2,)
    assert (result.row_error < 1e-5).all()
    assert (result.column_error < 1e-5).all()


def test_three_iterations_leave_sharp_scores_unbalanced_and_say_so() -> None:
    result = assign(scores_of(0, 50, 8, scale=10.0), jnp.float32(1))
    masses = np.exp(np.asarray(result.log_plan)).sum(axis=0)
    relative = np.abs(masses / np.array([1] * 8 + [42]) - 1).max()
    np.testing.assert_allclose(result.column_error, relative, rtol=1e-4)
    assert result.column_error > 0.01
    assert result.row_error < 1e-5  # rows are met last


def test_optimal_as_epsilon_falls() -> None:
    """At small epsilon the plan is the assignment found by trying all permutations."""
    import itertools

    scores = np.asarray(scores_of(3, 4, 4), np.float64)
    best = max(
        itertools.permutations(range(4)), key=lambda p: sum(scores[i, j] for i, j in enumerate(p))
    )
    zeros = jnp.zeros(4)
    config = SinkhornConfig(iterations=2000)
    plan = sinkhorn(jnp.asarray(scores, jnp.float32), zeros, zeros, epsilon=0.02, config=config)
    np.testing.assert_array_equal(np.asarray(plan.log_plan).argmax(axis=1), best)


@given(
    seed=st.integers(0, 1000),
    scale=st.sampled_from([0.0, 1.0, 100.0, 1e4]),
    rows=st.sampled_from([5, 17]),
)
@settings(max_examples=20, deadline=None)
def test_never_nan_for_finite_scores(seed: int, scale: float, rows: int) -> None:
    def loss(scores: jax.Array) -> jax.Array:
        return jnp.sin(jnp.exp(assign(scores, jnp.float32(1)).log_plan)).sum()

    scores = scores_of(seed, rows, 4, scale=scale)
    value, gradient = jax.value_and_grad(loss)(scores)
    assert jnp.isfinite(value)
    assert jnp.isfinite(gradient).all()


@given(seed=st.integers(0, 1000), dustbin=st.floats(-20, 20))
@settings(max_examples=20, deadline=None)
def test_the_dustbins_constant_score_changes_nothing(seed: int, dustbin: float) -> None:
    scores = scores_of(seed, 12, 4)
    plans = [jnp.exp(assign(scores, jnp.float32(z)).log_plan) for z in (0.0, dustbin)]
    # The potential absorbs it: rounding of logarithms of up to 20 is left.
    np.testing.assert_allclose(plans[0], plans[1], atol=1e-5)


def test_epsilon_may_be_traced_and_learnt() -> None:
    scores = append_dustbin(scores_of(0, 10, 3), jnp.float32(1))
    log_mu, log_nu = log_marginals(10, 3)

    def entropy(epsilon: jax.Array) -> jax.Array:
        log_plan = sinkhorn(scores, log_mu, log_nu, epsilon=epsilon).log_plan
        return -(jnp.exp(log_plan) * log_plan).sum()

    gradient = jax.grad(entropy)(jnp.float32(0.5))
    step = 1e-2
    difference = (entropy(jnp.float32(0.5 + step)) - entropy(jnp.float32(0.5 - step))) / (2 * step)
    # Central differences: step^2 of curvature and 1e-6 / step of rounding.
    np.testing.assert_allclose(gradient, difference, rtol=5e-3)
    assert gradient > 0


def test_marginal_error_by_hand() -> None:
    plan = jnp.log(jnp.array([[0.5, 0.25], [0.5, 1.0]]))
    rows, columns = marginal_error(plan, jnp.log(jnp.array([1.0, 1.5])), jnp.log(jnp.ones(2)))
    np.testing.assert_allclose(rows, 0.25, atol=1e-6)
    np.testing.assert_allclose(columns, 0.25, atol=1e-6)


@pytest.mark.parametrize("rows", [3, 4])
def test_a_dustbin_without_mass_raises_while_tracing(rows: int) -> None:
    with pytest.raises(InputError, match=f"found {rows} patches for 4 clusters"):
        jax.eval_shape(lambda s: assign(s, jnp.float32(1)).log_plan, jnp.zeros((rows, 4)))


@pytest.mark.parametrize(
    ("field", "value"), [("iterations", 0), ("epsilon", 0.0), ("epsilon", float("nan"))]
)
def test_bad_settings_raise(field: str, value: float) -> None:
    with pytest.raises(InputError, match=f"SinkhornConfig.{field}: found {value}"):
        SinkhornConfig(**{field: value})
