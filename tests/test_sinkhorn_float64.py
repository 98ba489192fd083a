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
from jax.flatten_util import ravel_pytree
from ott.geometry.geometry import Geometry
from ott.problems.linear.linear_problem import LinearProblem
from ott.solvers.linear.sinkhorn import Sinkhorn

from crisalad_jax.config import SinkhornConfig
from crisalad_jax.sinkhorn import (
    SCALING_RANGE,
    Potentials,
    Problem,
    SinkhornResult,
    sinkhorn,
)

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
    "relaxed rows": (to_rest(row_tau=0.6), None),
    "relaxed columns": (to_rest(column_tau=0.8, domain="log"), None),
    "relaxed": (to_rest(row_tau=0.9, column_tau=0.7, relaxation=1.2), None),
    "relaxed, anderson": (to_rest(row_tau=0.9, column_tau=0.7, anderson=5), None),
    "relaxed, optimistix, Levenberg-Marquardt": (
        to_rest(gradient="optimistix", row_tau=0.9, column_tau=0.7),
        optimistix.LevenbergMarquardt(rtol=TIGHT, atol=TIGHT),
    ),
}


# References


@functools.cache
def ott_plan(row_tau: float = 1.0, column_tau: float = 1.0) -> np.ndarray:
    at = inputs()
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


def pot_plan(row_tau: float = 1.0, column_tau: float = 1.0) -> np.ndarray:
    at = inputs()
    mu, nu, cost = np.exp(at.log_mu), np.exp(at.log_nu), -np.asarray(at.scores)
    epsilon = float(at.epsilon)
    if row_tau == column_tau == 1:
        return ot.sinkhorn(mu, nu, cost, epsilon, stopThr=1e-13, numItermax=20000)
    penalties = tuple(
        epsilon * tau / (1 - tau) if tau < 1 else np.inf for tau in (row_tau, column_tau)
    )
    # "entropy": that of the plan by itself, as here, not against mu nu^T.
    kind = {"reg_type": "entropy", "c": np.ones(cost.shape)}
    limits = {"stopThr": 1e-14, "numItermax": 20000}
    return ot.unbalanced.sinkhorn_unbalanced(mu, nu, cost, epsilon, penalties, **kind, **limits)


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


def differences(of: Callable[[Inputs], Any], at: Inputs) -> Inputs:
    """Central differences of fourth order in every number of the inputs, all at once.

    The step leaves 1e-15 times fifth derivatives, which for epsilon are of order 1e8, and 1e4
    times the 1e-12 that has not converged.
    """
    step = 2e-4
    flat, back = ravel_pytree(at)
    values = jax.jit(jax.vmap(lambda move: of(back(flat + step * move))))
    near, near_back, far, far_back = (
        values(times * jnp.eye(flat.size)) for times in (1, -1, 2, -2)
    )
    return back((8 * (near - near_back) - (far - far_back)) / (12 * step))


def assert_close(ours: Inputs, expected: Inputs, relative: float) -> None:
    """Each part's largest difference, relative to the part's largest value."""
    for name, found, wanted in zip(Inputs._fields, ours, expected, strict=True):
        error = np.abs(np.asarray(found) - np.asarray(wanted)).max()
        assert error <= relative * np.abs(wanted).max(), (name, error)


# Converged


# A solver of each kind; their combinations take minutes.
QUICK = {"scaling", "log", "newton", "fixed", "optimistix", "relaxed"}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in SOLVERS],
)
def test_plan_and_gradient_of_every_solver(name: str) -> None:
    """The plans of ott-jax and of POT, and the gradient of 3000 iterations."""
    config, solver = SOLVERS[name]

    def of(at: Inputs) -> Any:
        result = solve(at, config, solver=solver)
        return score(result.log_plan, *result.potentials), result

    at, taus = inputs(), (config.row_tau, config.column_tau)
    gradient, result = jax.jit(jax.grad(of, has_aux=True))(at)
    assert result.converged
    assert result.log_plan.dtype == jnp.float64
    plan = np.exp(result.log_plan)
    # Everyone came to rest at 1e-12: what is left of a geometric series of ratio up to 0.99.
    np.testing.assert_allclose(plan, ott_plan(*taus), atol=1e-10)
    # Relative: what POT stops at is relative to its largest scaling.
    np.testing.assert_allclose(plan, pot_plan(*taus), rtol=1e-9)
    # Of the same 1e-12, what a system of condition number 1e2 or so leaves.
    assert_close(gradient, long_gradient(*taus), 1e-9)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("fields", [{"anderson": 8}, {"method": "newton"}], ids=str)
def test_plan_nears_the_linear_programme_as_epsilon_falls(seed: int, fields: Any) -> None:
    at = inputs(seed=seed)
    mu, nu, scores = np.exp(at.log_mu), np.exp(at.log_nu), np.asarray(at.scores)
    best = ot.emd(mu, nu, -scores)
    distances = []
    for epsilon in (0.5, 0.05, 0.002):
        # 1e-9: scores over epsilon are of order 1e3, rounded at 1e-13, and iterations add up.
        config = to_rest(tolerance=1e-9, iterations=20000, **fields)
        result = solve(at._replace(epsilon=epsilon), config)
        assert result.converged
        plan = np.exp(result.log_plan)
        # Entropy is worth no more than epsilon times its range.
        lost = (best * scores).sum() - (plan * scores).sum()
        assert -1e-7 < lost < epsilon * mu.sum() * np.log(plan.size)
        distances.append(np.abs(plan - best).max())
    assert distances[0] > distances[1] > 1e3 * distances[2]
    # The distance is exp(-gap / epsilon), the gap in score per mass between the best two
    # vertices, which is 0.045 or more here; and the tolerance's 1e-9 times masses of up to 3.
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


@pytest.mark.slow
@pytest.mark.parametrize(
    "config",
    [
        to_rest(),
        SinkhornConfig(),
        SinkhornConfig(relaxation=1.4, row_tau=0.9, iterations=6, domain="log"),
        pytest.param(SinkhornConfig(anderson=4, iterations=5), marks=pytest.mark.slow),
        pytest.param(SinkhornConfig(anderson=3, iterations=9), marks=pytest.mark.slow),
        pytest.param(to_rest(gradient="optimistix"), marks=pytest.mark.slow),
        pytest.param(to_rest(row_tau=0.9, column_tau=0.7), marks=pytest.mark.slow),
    ],
    ids=["implicit", "3", "over-relaxed", "anderson", "scaling", "optimistix", "relaxed"],
)
def test_gradient_equals_central_differences(config: SinkhornConfig) -> None:
    of = functools.partial(loss, config=config)
    ours = jax.jit(jax.grad(of))(inputs())
    # See `differences`; gradients are of order 1 and 10.
    assert_close(ours, differences(of, inputs()), 1e-6)


@pytest.mark.parametrize("domain", ["scaling", "log"])
def test_unrolled_gradient_is_that_of_so_many_iterations(domain: Any) -> None:
    for count in (1, 9):  # 9 are a scan
        config = SinkhornConfig(domain=domain, iterations=count)
        value, ours = jax.jit(jax.value_and_grad(functools.partial(loss, config=config)))(inputs())
        # The same sums in another order.
        np.testing.assert_allclose(value, score(*long_way(inputs(), 1, 1, count)), rtol=1e-12)
        assert_close(ours, long_gradient(count=count), 1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["sinkhorn", "newton"])
def test_stopped_gradient_takes_potentials_for_constants(method: Any) -> None:
    config = SinkhornConfig(method=method, gradient="stop")
    ours = jax.grad(functools.partial(loss, config=config))(inputs())
    result = solve(inputs(), config)
    at_plan = jax.grad(score)(result.log_plan, *result.potentials)
    # Rounding.
    np.testing.assert_allclose(ours.scores, at_plan / 0.7, rtol=1e-12, atol=1e-14)
    by_epsilon = -(at_plan * inputs().scores).sum() / 0.7**2
    np.testing.assert_allclose(ours.epsilon, by_epsilon, rtol=1e-12)
    np.testing.assert_array_equal(ours.log_mu, 0)
    np.testing.assert_array_equal(ours.log_nu, 0)


@pytest.mark.slow
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
def test_a_step_of_ones_own(config: SinkhornConfig) -> None:
    def of(at: Inputs) -> Any:
        result = solve(at, config, step=rows_first)
        return score(result.log_plan, *result.potentials), result

    gradient, result = jax.jit(jax.grad(of, has_aux=True))(inputs())
    # Came to rest at 1e-12, as above.
    np.testing.assert_allclose(np.exp(result.log_plan), ott_plan(), atol=1e-10)
    assert result.converged
    assert result.row_error < 1e-10
    assert result.column_error < 1e-10
    if config.tolerance is not None:
        assert result.iterations < 300
    if config.gradient != "stop":
        assert_close(gradient, long_gradient(), 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("domain", ["scaling", "log"])
def test_a_step_may_read_the_kernel(domain: Any) -> None:
    """In the scaling domain too, where the built-in step reads exponentials of it."""
    config = SinkhornConfig(domain=domain)

    def of(at: Inputs, step: Any) -> Any:
        result = solve(at, config, step=step)
        return score(result.log_plan, *result.potentials)

    # The same sums in another order.
    assert_close(jax.grad(of)(inputs(), by_the_kernel), jax.grad(of)(inputs(), None), 1e-11)


# Second order and forward mode


@pytest.mark.slow
@pytest.mark.parametrize(
    "config",
    [
        SinkhornConfig(),
        SinkhornConfig(iterations=9),  # a scan
        SinkhornConfig(domain="log"),
        to_rest(),
        pytest.param(to_rest(row_tau=0.9, column_tau=0.7), marks=pytest.mark.slow),
        pytest.param(to_rest(gradient="optimistix"), marks=pytest.mark.slow),
    ],
    ids=["scaling", "many", "log", "implicit", "relaxed", "optimistix"],
)
def test_gradient_of_the_gradient(config: SinkhornConfig) -> None:
    """Of a gradient's product with a fixed direction, with respect to every input."""
    direction = inputs(seed=5)

    def slope(at: Inputs) -> Any:
        gradient = jax.grad(functools.partial(loss, config=config))(at)
        return sum(jnp.vdot(a, b) for a, b in zip(gradient, direction, strict=True))

    # As for the gradient; this one is of order 1e3.
    assert_close(jax.jit(jax.grad(slope))(inputs()), differences(slope, inputs()), 1e-6)


@pytest.mark.slow
def test_gradient_of_the_gradient_where_scaling_does_not_do() -> None:
    at, direction = inputs(), inputs(seed=5)
    far = SCALING_RANGE * at.epsilon + jnp.ptp(at.scores)
    at = at._replace(scores=at.scores.at[1, 2].add(-far))

    def slope(at: Inputs) -> Any:
        gradient = jax.grad(functools.partial(loss, config=SinkhornConfig()))(at)
        return sum(jnp.vdot(a, b) for a, b in zip(gradient, direction, strict=True))

    # As above.
    assert_close(jax.jit(jax.grad(slope))(at), differences(slope, at), 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "config",
    [to_rest(gradient="optimistix"), SinkhornConfig(gradient="stop")],
    ids=["optimistix", "stop"],
)
def test_forward_mode(config: SinkhornConfig) -> None:
    of, direction = functools.partial(loss, config=config), inputs(seed=5)
    _, forward = jax.jvp(of, (inputs(),), (direction,))
    reverse = sum(jnp.vdot(*pair) for pair in zip(jax.grad(of)(inputs()), direction, strict=True))
    # Linear systems of one matrix and of its transpose.
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)


@pytest.mark.parametrize("config", [to_rest(), SinkhornConfig()], ids=["implicit", "unrolled"])
def test_no_forward_mode_says_so(config: SinkhornConfig) -> None:
    of = functools.partial(loss, config=config)
    with pytest.raises(TypeError, match="can't apply forward-mode"):
        jax.jvp(of, (inputs(),), (inputs(),))
