"""Converged plans and gradients in float64, against other libraries and the long way round.

The float32 side, apart because optimistix mixes no precisions, is in test_sinkhorn.py.
"""

import functools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import ot
import pytest
from ott.geometry.geometry import Geometry
from ott.problems.linear.linear_problem import LinearProblem
from ott.solvers.linear.sinkhorn import Sinkhorn

from crisalad_jax.config import SinkhornConfig
from crisalad_jax.sinkhorn import Potentials, Problem, SinkhornResult, sinkhorn

TIGHT = 1e-12
"""What float64 potentials of order 10, rounded at 2e-15, can be asked to come to rest at."""
ROWS, COLUMNS = 12, 5


@pytest.fixture(autouse=True)
def _float64() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


class Inputs(NamedTuple):
    """What a plan is a function of."""

    scores: Any
    log_mu: Any
    log_nu: Any
    epsilon: Any


def inputs(*batch: int, std: float = 2.0, epsilon: float = 0.7, seed: int = 0) -> Inputs:
    """Uneven marginals of equal totals, so that no mistake of either side can hide."""
    generator = np.random.default_rng(seed)
    mu = generator.uniform(0.5, 2, ROWS)
    nu = generator.uniform(0.5, 3, COLUMNS)
    nu *= mu.sum() / nu.sum()
    scores = std * generator.standard_normal((*batch, ROWS, COLUMNS))
    return Inputs(*map(jnp.asarray, (scores, np.log(mu), np.log(nu), np.float64(epsilon))))


def solve(at: Inputs, config: SinkhornConfig, **how: Any) -> SinkhornResult:
    scores, log_mu, log_nu, epsilon = at
    return sinkhorn(scores, log_mu, log_nu, epsilon=epsilon, config=config, **how)


def to_rest(**fields: Any) -> SinkhornConfig:
    settings: dict[str, Any] = {"iterations": 5000, "tolerance": TIGHT, "gradient": "implicit"}
    return SinkhornConfig(**{**settings, **fields})


SOLVERS: dict[str, tuple[SinkhornConfig, Any]] = {
    "scaling": (to_rest(), None),
    "log": (to_rest(domain="log"), None),
    "relaxation": (to_rest(relaxation=1.3), None),
    "anderson": (to_rest(anderson=6), None),
    "newton": (to_rest(method="newton", iterations=40), None),
    "fixed": (SinkhornConfig(iterations=3000), None),
    "optimistix": (to_rest(gradient="optimistix"), None),
    "optimistix, Newton": (
        to_rest(gradient="optimistix", iterations=100),
        optimistix.Newton(rtol=TIGHT, atol=TIGHT),
    ),
}
RELAXED = {
    name: (to_rest(row_tau=row_tau, column_tau=column_tau, **fields), None)
    for name, row_tau, column_tau, fields in (
        ("rows", 0.6, 1.0, {}),
        ("columns", 1.0, 0.8, {"domain": "log"}),
        ("both", 0.9, 0.7, {"relaxation": 1.2}),
        ("anderson", 0.9, 0.7, {"anderson": 5}),
        ("optimistix", 0.9, 0.7, {"gradient": "optimistix"}),
    )
} | {
    "fixed": (SinkhornConfig(iterations=3000, row_tau=0.9, column_tau=0.7), None),
    "optimistix, Levenberg-Marquardt": (
        to_rest(gradient="optimistix", row_tau=0.9, column_tau=0.7),
        optimistix.LevenbergMarquardt(rtol=TIGHT, atol=TIGHT),
    ),
}


# Plans


def ott_plan(at: Inputs, row_tau: float = 1.0, column_tau: float = 1.0) -> np.ndarray:
    problem = LinearProblem(
        Geometry(cost_matrix=-at.scores, epsilon=at.epsilon, scale_cost=1.0),
        a=jnp.exp(at.log_mu),
        b=jnp.exp(at.log_nu),
        tau_a=row_tau,
        tau_b=column_tau,
    )
    # One inner iteration: with more, ott-jax looks whether it has converged too rarely.
    out = Sinkhorn(threshold=TIGHT, inner_iterations=1, max_iterations=20000)(problem)
    assert out.converged
    return np.asarray(out.matrix)


@functools.cache
def references() -> tuple[Inputs, list[np.ndarray]]:
    at = inputs(2)
    plans = [ott_plan(at._replace(scores=scores)) for scores in at.scores]
    mu, nu = np.exp(at.log_mu), np.exp(at.log_nu)
    for scores, plan in zip(np.asarray(at.scores), plans, strict=True):
        theirs = ot.sinkhorn(mu, nu, -scores, float(at.epsilon), stopThr=1e-13, numItermax=20000)
        # That the two libraries agree with each other, each stopped at about 1e-12.
        np.testing.assert_allclose(plan, theirs, atol=1e-10)
    return at, plans


@pytest.mark.parametrize("name", SOLVERS)
def test_balanced_plan_equals_ott_jax_and_pot(name: str) -> None:
    at, expected = references()
    config, solver = SOLVERS[name]
    result = solve(at, config, solver=solver)
    assert result.converged.all()
    # Both came to rest at 1e-12 a step; what is left of a geometric series of ratio up to 0.99.
    np.testing.assert_allclose(np.exp(result.log_plan), expected, atol=1e-10)
    assert result.log_plan.dtype == jnp.float64


@pytest.mark.parametrize("name", RELAXED)
def test_relaxed_plan_equals_ott_jax_and_pot(name: str) -> None:
    at = inputs()
    config, solver = RELAXED[name]
    result = solve(at, config, solver=solver)
    assert result.converged
    expected = ott_plan(at, config.row_tau, config.column_tau)
    # As above.
    np.testing.assert_allclose(np.exp(result.log_plan), expected, atol=1e-10)
    penalty = [
        float(at.epsilon) * tau / (1 - tau) if tau < 1 else np.inf
        for tau in (config.row_tau, config.column_tau)
    ]
    theirs = ot.unbalanced.sinkhorn_unbalanced(
        np.exp(at.log_mu),
        np.exp(at.log_nu),
        -np.asarray(at.scores),
        float(at.epsilon),
        tuple(penalty),
        reg_type="entropy",  # entropy of the plan by itself, as here, not against mu nu^T
        stopThr=1e-14,
        numItermax=20000,
    )
    # Relative: what POT stops at is relative to its largest potential.
    np.testing.assert_allclose(np.exp(result.log_plan), theirs, rtol=1e-9)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("fields", [{"anderson": 8}, {"method": "newton"}], ids=str)
def test_plan_nears_the_linear_programme_as_epsilon_falls(seed: int, fields: Any) -> None:
    at = inputs(seed=seed)
    mu, nu, scores = np.exp(at.log_mu), np.exp(at.log_nu), np.asarray(at.scores)
    mu, nu = mu / mu.sum(), nu / nu.sum()
    best = ot.emd(mu, nu, -scores)
    # Down in steps: the distance falls as exp(-gap / epsilon), gap between the best two vertices.
    distances = []
    for epsilon in (0.5, 0.1, 0.01):
        scaled = Inputs(at.scores, jnp.log(mu), jnp.log(nu), jnp.float64(epsilon))
        result = solve(scaled, to_rest(tolerance=1e-9, iterations=20000, **fields))
        assert result.converged
        plan = np.exp(result.log_plan)
        # Entropy can be worth no more than epsilon times its range.
        lost = (best * scores).sum() - (plan * scores).sum()
        assert -1e-9 < lost < epsilon * np.log(plan.size)
        distances.append(np.abs(plan - best).max())
    assert distances[0] > distances[1] > distances[2]
    assert distances[0] > 1e-2
    # The gaps of these three are 0.2 and more: exp(-20), and the tolerance's 1e-9.
    assert distances[2] < 1e-8


def test_potentials_are_centred_and_make_the_plan() -> None:
    at = inputs(2)
    for config in (to_rest(), SinkhornConfig(), to_rest(row_tau=0.8)):
        result = solve(at, config)
        row, column = result.potentials
        made = at.scores / at.epsilon + row[..., None] + column[..., None, :]
        # Rounding of sums of order 10.
        np.testing.assert_allclose(result.log_plan, made, atol=1e-13)
        if config.balanced:
            np.testing.assert_allclose(column.mean(axis=-1), 0, atol=1e-13)
    # Relaxed marginals fix the constant: the rows' condition by hand.
    mass = np.exp(result.log_plan).sum(axis=-1)
    expected = 0.8 / 0.2 * (np.asarray(at.log_mu) - np.log(mass))
    np.testing.assert_allclose(result.potentials.row, expected, atol=1e-10)


# Gradients


def long_way(at: Inputs, row_tau: float, column_tau: float, count: int) -> Any:
    """The log plan and the potentials by `count` iterations, columns first, as one would write."""
    scores, log_mu, log_nu, epsilon = at
    kernel = scores / epsilon

    def both(potentials: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], None]:
        row, column = potentials
        column = column_tau * (log_nu - jax.nn.logsumexp(kernel + row[:, None], axis=0))
        row = row_tau * (log_mu - jax.nn.logsumexp(kernel + column[None], axis=1))
        return (row, column), None

    start = (jnp.zeros(ROWS), jnp.zeros(COLUMNS))
    (row, column), _ = jax.lax.scan(both, start, length=count)
    log_plan = kernel + row[:, None] + column[None]
    if row_tau == column_tau == 1:
        row, column = row + column.mean(), column - column.mean()
    return log_plan, row, column


def score(log_plan: Any, row: Any, column: Any) -> Any:
    """A number that depends on everything that comes out, all of it differently."""
    weights = np.random.default_rng(7).standard_normal((ROWS + 2, COLUMNS))
    return (
        (weights[:ROWS] * jnp.exp(log_plan)).sum()
        + (weights[ROWS] * jnp.tanh(log_plan)).sum()
        + (weights[ROWS + 1] * column).sum()
        + jnp.sin(jnp.arange(1.0, ROWS + 1) * row).sum()
    )


def loss(at: Inputs, config: SinkhornConfig, solver: Any = None) -> Any:
    result = solve(at, config, solver=solver)
    return score(result.log_plan, *result.potentials)


@functools.cache
def long_gradient(row_tau: float = 1.0, column_tau: float = 1.0, count: int = 3000) -> Inputs:
    return jax.jit(jax.grad(lambda at: score(*long_way(at, row_tau, column_tau, count))))(inputs())


def differences(of: Callable[[Inputs], Any], at: Inputs, step: float) -> Inputs:
    """Central differences in every number of the inputs, all at once."""
    flat, back = jax.flatten_util.ravel_pytree(at)
    moves = step * jnp.eye(flat.size)
    values = jax.jit(jax.vmap(lambda move: of(back(flat + move))))
    return back((values(moves) - values(-moves)) / (2 * step))


def assert_close(ours: Inputs, expected: Inputs, relative: float) -> None:
    """Each part's largest difference, relative to the part's largest value."""
    for name, found, wanted in zip(Inputs._fields, ours, expected, strict=True):
        error = np.abs(np.asarray(found) - np.asarray(wanted)).max()
        assert error <= relative * np.abs(wanted).max(), (name, error)


@pytest.mark.parametrize("name", SOLVERS)
def test_gradient_equals_long_unrolling(name: str) -> None:
    config, solver = SOLVERS[name]
    ours = jax.jit(jax.grad(functools.partial(loss, config=config, solver=solver)))(inputs())
    # Of the tolerance's 1e-12, what a system of condition number 1e2 or so leaves.
    assert_close(ours, long_gradient(), 1e-9)


@pytest.mark.parametrize("name", RELAXED)
def test_relaxed_gradient_equals_long_unrolling(name: str) -> None:
    config, solver = RELAXED[name]
    ours = jax.jit(jax.grad(functools.partial(loss, config=config, solver=solver)))(inputs())
    # As above.
    assert_close(ours, long_gradient(config.row_tau, config.column_tau), 1e-9)


@pytest.mark.parametrize(
    "config",
    [
        to_rest(),
        to_rest(gradient="optimistix"),
        to_rest(row_tau=0.9, column_tau=0.7),
        SinkhornConfig(),
        SinkhornConfig(domain="log", iterations=12),
        SinkhornConfig(relaxation=1.4, row_tau=0.9, iterations=6),
        SinkhornConfig(anderson=4, iterations=6),
        SinkhornConfig(anderson=3, domain="log", iterations=4),
    ],
    ids=["implicit", "optimistix", "relaxed", "3", "log 12", "over-relaxed", "anderson", "log"],
)
def test_gradient_equals_central_differences(config: SinkhornConfig) -> None:
    of = functools.partial(loss, config=config)
    ours = jax.jit(jax.grad(of))(inputs())
    # step^2 of third derivatives of order 1e2, and 1e-12 of convergence over the step: 1e-8 each.
    assert_close(ours, differences(of, inputs(), 1e-5), 1e-6)


@pytest.mark.parametrize("domain", ["scaling", "log"])
def test_unrolled_gradient_is_that_of_so_many_iterations(domain: Any) -> None:
    for count in (1, 3, 9):  # 9 are a scan
        config = SinkhornConfig(domain=domain, iterations=count)
        value, ours = jax.jit(jax.value_and_grad(functools.partial(loss, config=config)))(inputs())
        # The same sums in another order.
        np.testing.assert_allclose(value, score(*long_way(inputs(), 1, 1, count)), rtol=1e-12)
        assert_close(ours, long_gradient(count=count), 1e-11)


@pytest.mark.parametrize("method", ["sinkhorn", "newton"])
def test_stopped_gradient_takes_potentials_for_constants(method: Any) -> None:
    config = SinkhornConfig(method=method, gradient="stop")
    ours = jax.grad(functools.partial(loss, config=config))(inputs())
    result = solve(inputs(), config)
    at_plan = jax.grad(score)(result.log_plan, *result.potentials)
    np.testing.assert_allclose(ours.scores, at_plan / 0.7, rtol=1e-12)
    by_epsilon = -(at_plan * inputs().scores).sum() / 0.7**2
    np.testing.assert_allclose(ours.epsilon, by_epsilon, rtol=1e-12)
    np.testing.assert_array_equal(ours.log_mu, 0)
    np.testing.assert_array_equal(ours.log_nu, 0)


def test_a_batch_has_the_gradients_of_its_members() -> None:
    at = inputs(3)

    def total(scores: Any) -> Any:
        result = solve(at._replace(scores=scores), to_rest())
        return jax.vmap(score)(result.log_plan, *result.potentials).sum()

    together = jax.jit(jax.grad(total))(at.scores)
    alone = [
        jax.grad(loss)(at._replace(scores=scores), config=to_rest()).scores for scores in at.scores
    ]
    # Rounding: a problem stops by itself, whatever its batch.
    np.testing.assert_allclose(together, alone, rtol=1e-12, atol=1e-12)


# A step of the user's own


def rows_first(problem: Problem, potentials: Potentials) -> Potentials:
    """Rows, columns, rows; and columns half as far again: another way to the same plan."""
    row = problem.log_mu - problem.over_columns(potentials.column)
    met = problem.log_nu - problem.over_rows(row)
    column = potentials.column + 1.2 * (met - potentials.column)
    return Potentials(problem.log_mu - problem.over_columns(column), column)


def by_the_kernel(problem: Problem, potentials: Potentials) -> Potentials:
    """The published step, from the scores themselves."""
    log_sum = jax.nn.logsumexp
    column = problem.log_nu - log_sum(problem.kernel + potentials.row[..., None], axis=-2)
    row = problem.log_mu - log_sum(problem.kernel + column[..., None, :], axis=-1)
    return Potentials(row, column)


@pytest.mark.parametrize(
    "config",
    [
        to_rest(gradient="stop"),
        to_rest(gradient="stop", anderson=5, domain="log"),
        to_rest(gradient="optimistix"),
        SinkhornConfig(iterations=300),
    ],
    ids=["stop", "anderson", "optimistix", "unrolled"],
)
@pytest.mark.parametrize("step", [rows_first, by_the_kernel])
def test_a_step_of_ones_own(step: Any, config: SinkhornConfig) -> None:
    def of(at: Inputs) -> Any:
        result = solve(at, config, step=step)
        return score(result.log_plan, *result.potentials), result

    gradient, result = jax.jit(jax.grad(of, has_aux=True))(inputs())
    # Came to rest at 1e-12, as above.
    np.testing.assert_allclose(np.exp(result.log_plan), ott_plan(inputs()), atol=1e-10)
    assert result.converged
    assert result.row_error < 1e-10
    assert result.column_error < 1e-10
    if config.tolerance is not None:
        assert result.iterations < 300
    if config.gradient != "stop":
        assert_close(gradient, long_gradient(), 1e-9)


@pytest.mark.parametrize("domain", ["scaling", "log"])
def test_a_step_may_read_the_kernel(domain: Any) -> None:
    """In the scaling domain too, where the built-in step reads exponentials of it."""
    config = SinkhornConfig(domain=domain)

    def of(at: Inputs, step: Any) -> Any:
        result = solve(at, config, step=step)
        return score(result.log_plan, *result.potentials)

    # The same sums in another order.
    assert_close(
        jax.grad(of)(inputs(), by_the_kernel), jax.grad(of)(inputs(), None), 1e-11
    )


# Second order and forward mode


@pytest.mark.parametrize(
    "config",
    [
        SinkhornConfig(iterations=4),
        SinkhornConfig(iterations=4, domain="log"),
        to_rest(),
        to_rest(row_tau=0.9, column_tau=0.7),
        to_rest(gradient="optimistix"),
    ],
    ids=["scaling", "log", "implicit", "relaxed", "optimistix"],
)
def test_gradient_of_the_gradient(config: SinkhornConfig) -> None:
    """Of a gradient's product with a fixed direction, with respect to every input."""
    direction = inputs(seed=5)

    def slope(at: Inputs) -> Any:
        gradient = jax.grad(functools.partial(loss, config=config))(at)
        return sum(jnp.vdot(a, b) for a, b in zip(gradient, direction, strict=True))

    # As for the gradient; fourth derivatives are larger.
    assert_close(jax.jit(jax.grad(slope))(inputs()), differences(slope, inputs(), 1e-5), 1e-6)
