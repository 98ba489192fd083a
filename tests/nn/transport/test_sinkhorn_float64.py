"""Converged plans and gradients in float64, against other libraries and the long way round.

The float32 side, apart because optimistix mixes no precisions, is in test_sinkhorn.py.
"""

import dataclasses
import functools
from collections.abc import Callable
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

from crisalad_jax.sinkhorn import (
    SCALING_RANGE,
    Potentials,
    Problem,
    SinkhornConfig,
    SinkhornResult,
    SinkhornStep,
    Step,
    register_step,
)
from crisalad_jax.sinkhorn import solve as solve_transport
from tests.nn.conftest import slow_unless
from tests.nn.transport.problems import Way, implicit, pot_plan, relaxed

pytestmark = pytest.mark.usefixtures("float64")

TIGHT = 1e-12
"""What float64 potentials of order 10, rounded at 2e-15, can be asked to come to rest at."""
ROWS, COLUMNS = 12, 5


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
    return solve_transport(scores, log_mu, log_nu, epsilon=epsilon, config=config, **how)


def to_rest(**fields: Any) -> SinkhornConfig:
    return implicit(**{"iterations": 5000, "tolerance": TIGHT} | fields)


SOLVERS: dict[str, Way] = {
    "scaling": Way(to_rest()),
    "log": Way(to_rest(domain="log")),
    "anderson": Way(to_rest(anderson_memory=6)),
    "newton": Way(to_rest(step="newton", iterations=40)),
    "fixed": Way(SinkhornConfig(iterations=3000)),
    "optimistix": Way(to_rest(gradient="optimistix")),
    "relaxed rows": Way(to_rest(), relaxed(row_tau=0.6)),
    "relaxed columns": Way(to_rest(domain="log"), relaxed(column_tau=0.8)),
    "relaxed": Way(to_rest(step=SinkhornStep(relaxation=1.2)), relaxed(0.9, 0.7)),
    "relaxed, optimistix, Levenberg-Marquardt": Way(
        to_rest(gradient="optimistix"),
        relaxed(0.9, 0.7),
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


def loss(at: Inputs, config: SinkhornConfig, **how: Any) -> Any:
    result = solve(at, config, **how)
    return score(result.log_plan, *result.potentials)


@functools.cache
def long_gradient(row_tau: float = 1.0, column_tau: float = 1.0, count: int = 3000) -> Inputs:
    return jax.jit(jax.grad(lambda at: score(*long_way(at, row_tau, column_tau, count))))(inputs())


def differences(of: Callable[[Any], Any], at: Any) -> Any:
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


@pytest.mark.parametrize("name", slow_unless(QUICK, SOLVERS))
def test_plan_and_gradient_of_every_solver(name: str) -> None:
    """The plans of ott-jax and of POT, and the gradient of 3000 iterations."""
    config, taus, solver = SOLVERS[name]

    def of(at: Inputs) -> Any:
        result = solve(at, config, solver=solver, **taus)
        return score(result.log_plan, *result.potentials), result

    gradient, result = jax.jit(jax.grad(of, has_aux=True))(inputs())
    assert result.finite
    assert result.converged == (config.tolerance is not None)
    assert result.log_plan.dtype == jnp.float64
    plan = np.exp(result.log_plan)
    # Everyone came to rest at 1e-12: what is left of a geometric series of ratio up to 0.99.
    np.testing.assert_allclose(plan, ott_plan(**taus), atol=1e-10)
    # Relative: what POT stops at is relative to its largest scaling.
    np.testing.assert_allclose(plan, pot_plan(*inputs(), **relaxed(**taus)), rtol=1e-9)
    # Of the same 1e-12, what a system of condition number 1e2 or so leaves.
    assert_close(gradient, long_gradient(**taus), 1e-9)


@pytest.mark.parametrize(
    "config",
    [
        pytest.param(SinkhornConfig(step="newton", iterations=12), marks=pytest.mark.slow),
        to_rest(step="newton", gradient="optimistix", iterations=40),
    ],
    ids=["unrolled", "optimistix"],
)
def test_newtons_other_gradients(config: SinkhornConfig) -> None:
    """Where the totals of the marginals change as one, columns and rows share out what is missed.

    So gradients by the marginals are those above but for a multiple of the masses themselves.
    """
    at = inputs()
    ours, expected = jax.jit(jax.grad(functools.partial(loss, config=config)))(at), long_gradient()
    more, less = (
        (getattr(ours, name) - getattr(expected, name)) / np.exp(getattr(at, name))
        for name in ("log_mu", "log_nu")
    )
    # As above.
    np.testing.assert_allclose(np.append(more, -less), more[0], atol=1e-8)
    same = {"log_mu": expected.log_mu, "log_nu": expected.log_nu}
    assert_close(ours._replace(**same), expected, 1e-9)


@pytest.mark.parametrize("fields", [{"anderson_memory": 8}, {"step": "newton"}], ids=str)
def test_plan_nears_the_linear_programme_as_epsilon_falls(fields: Any) -> None:
    at = inputs()
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
    for config, taus in ((to_rest(), {}), (SinkhornConfig(), {}), (to_rest(), {"row_tau": 0.8})):
        result = solve(at, config, **taus)
        row, column = result.potentials
        made = at.scores / at.epsilon + row[..., None] + column[..., None, :]
        # Rounding of sums of order 10.
        np.testing.assert_allclose(result.log_plan, made, atol=1e-13)
        if not taus:
            np.testing.assert_allclose(column.mean(axis=-1), 0, atol=1e-13)
    # Relaxed marginals fix the constant: the rows' condition by hand.
    mass = np.exp(result.log_plan).sum(axis=-1)
    expected = 0.8 / 0.2 * (np.asarray(at.log_mu) - np.log(mass))
    np.testing.assert_allclose(result.potentials.row, expected, atol=1e-10)


def cosines(count: int, rows: int, columns: int) -> np.ndarray:
    """Of random unit vectors of 16 numbers."""
    generator = np.random.default_rng(0)
    sides = (generator.standard_normal((count, size, 16)) for size in (rows, columns))
    rows_, columns_ = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in sides)
    return rows_ @ columns_.transpose(0, 2, 1)


@pytest.mark.parametrize("masses", ["whole numbers", "uneven"])
def test_newton_at_the_sharpest_scores_is_the_linear_programme(masses: str) -> None:
    """At an epsilon of 2e-4 of cosines, in few iterations: 48 and fewer were seen.

    Where the masses are whole numbers the programme has many duals, and no rows that are split.
    """
    scores, epsilon = cosines(4, 256, 64), 2e-4
    generator = np.random.default_rng(1)
    mu, nu = np.ones(256), np.full(64, 4.0)
    if masses == "uneven":
        mu, nu = generator.uniform(0.5, 2, 256), generator.uniform(0.5, 2, 64)
        nu *= mu.sum() / nu.sum()
    config = to_rest(step="newton", tolerance=1e-6, iterations=100)
    result = solve(Inputs(*map(jnp.asarray, (scores, np.log(mu), np.log(nu))), epsilon), config)
    assert result.converged.all()
    plan = np.exp(result.log_plan)
    # The tolerance.
    np.testing.assert_allclose(plan.sum(axis=1), [nu] * 4, rtol=1.1e-6)
    np.testing.assert_allclose(plan.sum(axis=2), [mu] * 4, rtol=1.1e-6)
    for one, found in zip(scores, plan, strict=True):
        best = (ot.emd(mu, nu, -one) * one).sum()
        # Entropy is worth no more than epsilon times its range; the tolerance, of all masses.
        lost = best - (found * one).sum()
        assert -1e-6 * mu.sum() < lost < epsilon * mu.sum() * np.log(found.size)


@pytest.mark.parametrize(
    "gradient",
    ["implicit", *(pytest.param(x, marks=pytest.mark.slow) for x in ("unrolled", "optimistix"))],
)
def test_newton_from_a_temperature_has_the_converged_plan_and_its_gradient(gradient: Any) -> None:
    """Scores so sharp that it starts above 1: ott-jax's plan, and the implicit gradient."""
    at = inputs(std=2.0, epsilon=0.05)
    of, exact = (
        functools.partial(loss, config=config)
        for config in (
            SinkhornConfig(step="newton", iterations=25)
            if gradient == "unrolled"
            else to_rest(step="newton", gradient=gradient, tolerance=1e-10, iterations=200),
            to_rest(anderson_memory=8, tolerance=1e-10, iterations=20000),
        )
    )
    ours, expected = (jax.jit(jax.grad(x))(at) for x in (of, exact))
    # 1e-10 that has not converged, times a condition number of 1e3.
    assert_close(ours._replace(log_mu=0, log_nu=0), expected._replace(log_mu=0, log_nu=0), 1e-6)


# Gradients


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "taus"),
    [
        (SinkhornConfig(SinkhornStep(1.4), iterations=6, domain="log"), {"row_tau": 0.9}),
        (SinkhornConfig(anderson_memory=3, iterations=9), {}),
    ],
    ids=["over-relaxed", "anderson"],
)
def test_gradient_equals_central_differences(config: SinkhornConfig, taus: Any) -> None:
    of = functools.partial(loss, config=config, **taus)
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
@pytest.mark.parametrize("step", ["sinkhorn", "newton"])
def test_stopped_gradient_takes_potentials_for_constants(step: Any) -> None:
    config = SinkhornConfig(step=step, gradient="stop")
    ours = jax.grad(functools.partial(loss, config=config))(inputs())
    result = solve(inputs(), config)
    at_plan = jax.grad(score)(result.log_plan, *result.potentials)
    # Rounding.
    np.testing.assert_allclose(ours.scores, at_plan / 0.7, rtol=1e-12, atol=1e-14)
    by_epsilon = -(at_plan * inputs().scores).sum() / 0.7**2
    np.testing.assert_allclose(ours.epsilon, by_epsilon, rtol=1e-12)
    np.testing.assert_array_equal(ours.log_mu, 0)
    np.testing.assert_array_equal(ours.log_nu, 0)


# A step of the user's own


@register_step("test-float64-rows-first")
def _rows_first(problem: Problem, potentials: Potentials) -> Potentials:
    """Rows, columns, rows; and columns half as far again: another way to the same plan."""
    row = problem.log_mu - problem.lse_columns(potentials.column)
    met = problem.log_nu - problem.lse_rows(row)
    column = potentials.column + 1.2 * (met - potentials.column)
    return Potentials(problem.log_mu - problem.lse_columns(column), column)


@pytest.mark.parametrize(
    "config",
    [
        to_rest(gradient="stop", step="test-float64-rows-first", anderson_memory=5, domain="log"),
        to_rest(gradient="optimistix", step="test-float64-rows-first"),
        SinkhornConfig(iterations=300, step="test-float64-rows-first"),
    ],
    ids=["anderson", "optimistix", "unrolled"],
)
def test_a_step_of_ones_own(config: SinkhornConfig) -> None:
    def of(at: Inputs) -> Any:
        result = solve(at, config)
        log_plan, (row, column) = result.log_plan, result.potentials
        # Only of steps that say they are entropic potentials are centred.
        shift = column.mean()
        return score(log_plan, row + shift, column - shift), result

    gradient, result = jax.jit(jax.grad(of, has_aux=True))(inputs())
    # Came to rest at 1e-12, as above.
    np.testing.assert_allclose(np.exp(result.log_plan), ott_plan(), atol=1e-10)
    assert result.converged == (config.tolerance is not None)
    assert result.column_error < 1e-10
    if config.gradient.part_name != "stop":
        assert_close(gradient, long_gradient(), 1e-9)


# Second order and forward mode


SECOND: dict[str, Way] = {
    "unrolled": Way(SinkhornConfig()),
    "implicit": Way(to_rest()),
    "unrolled, log": Way(SinkhornConfig(domain="log")),
    "implicit, relaxed": Way(to_rest(), relaxed(0.9, 0.7)),
    "optimistix": Way(to_rest(gradient="optimistix")),
}


@pytest.mark.parametrize("name", slow_unless({"unrolled", "implicit"}, SECOND))
@pytest.mark.parametrize("apart", [0, 2 * SCALING_RANGE], ids=["near", "far"])
def test_gradient_of_the_gradient(name: str, apart: float) -> None:
    """Of a gradient's product with a fixed direction, with respect to every input."""
    config, taus, _ = SECOND[name]
    at, direction = inputs(), inputs(seed=5)
    at = at._replace(scores=at.scores.at[1, 2].add(-apart * at.epsilon))

    def slope(at: Inputs) -> Any:
        gradient = jax.grad(functools.partial(loss, config=config, **taus))(at)
        return sum(jnp.vdot(a, b) for a, b in zip(gradient, direction, strict=True))

    # As for the gradient; this one is of order 1e3.
    assert_close(jax.jit(jax.grad(slope))(at), differences(slope, at), 1e-6)


FORWARD: dict[str, Way] = {
    **SECOND,
    "unrolled, anderson": Way(SinkhornConfig(iterations=5, anderson_memory=4)),
    "unrolled, newton": Way(SinkhornConfig(iterations=3, step="newton")),
    "unrolled, relaxed": Way(SinkhornConfig(step=SinkhornStep(relaxation=1.4)), relaxed(0.9, 0.7)),
    "stop": Way(SinkhornConfig(gradient="stop")),
}


@pytest.mark.parametrize("name", slow_unless({"unrolled", "implicit"}, FORWARD))
def test_forward_mode_is_reverse_mode(name: str) -> None:
    config, taus, _ = FORWARD[name]
    of, direction = functools.partial(loss, config=config, **taus), inputs(seed=5)
    _, forward = jax.jit(lambda at: jax.jvp(of, (at,), (direction,)))(inputs())
    gradient = jax.jit(jax.grad(of))(inputs())
    reverse = sum(jnp.vdot(*pair) for pair in zip(gradient, direction, strict=True))
    # Linear systems of one matrix and of its transpose.
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)


@pytest.mark.parametrize("name", ["implicit", "unrolled", "implicit, relaxed"])
def test_vmap_is_one_problem_after_the_other(name: str) -> None:
    """Over everything at once: scores, both marginals and epsilon; one is out of scaling's range.

    Derivatives, too.
    """
    config, taus, _ = SECOND[name]
    each = [inputs(seed=seed, epsilon=0.5 + 0.2 * seed) for seed in range(3)]
    each[1] = each[1]._replace(scores=each[1].scores.at[1, 2].add(-2 * SCALING_RANGE))
    both = jax.value_and_grad(functools.partial(loss, config=config, **taus))
    values, gradients = jax.jit(jax.vmap(both))(jax.tree.map(lambda *x: jnp.stack(x), *each))
    for index, at in enumerate(each):
        value, gradient = jax.jit(both)(at)
        # Rounding: what is vmapped may add up in another order; amplified by a system's condition.
        np.testing.assert_allclose(values[index], value, rtol=1e-9)
        assert_close(jax.tree.map(lambda x, i=index: x[i], gradients), gradient, 1e-9)


# Out of scaling's range


BEYOND: dict[str, Way] = {
    "unrolled": Way(SinkhornConfig(iterations=4)),
    "anderson": Way(SinkhornConfig(iterations=5, anderson_memory=3)),
    "newton": Way(SinkhornConfig(iterations=3, step="newton")),
    "implicit": Way(to_rest(iterations=60)),
    "stop": Way(SinkhornConfig(gradient="stop")),
    "relaxed": Way(SinkhornConfig(), relaxed(0.9, 0.7)),
}


@pytest.mark.parametrize("name", slow_unless({"unrolled", "implicit"}, BEYOND))
def test_beyond_scalings_range_all_is_exactly_the_log_domains(name: str) -> None:
    """Values and gradients, of every problem of the batch as if it were alone."""
    config, taus, _ = BEYOND[name]
    at = inputs(4, epsilon=1.0)

    def of(scores: Any, config: SinkhornConfig) -> Any:
        result = solve(at._replace(scores=scores), config, **taus)
        each = score
        for _ in scores.shape[:-2]:
            each = jax.vmap(each)
        return each(result.log_plan, *result.potentials).sum(), result

    both = jax.value_and_grad(of, has_aux=True)
    logarithmic = functools.partial(both, config=dataclasses.replace(config, domain="log"))
    one_by_one = jax.jit(lambda far: jax.lax.map(logarithmic, far))
    for largest in (300.0, 1e4):
        far = at.scores.at[2].multiply(largest / jnp.abs(at.scores[2]).max())
        (_, found), gradient = jax.jit(both, static_argnums=1)(far, config)
        (_, expected), expected_gradient = one_by_one(far)
        pairs = zip((gradient, *found), (expected_gradient, *expected), strict=True)
        for ours, theirs in pairs:
            for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
                assert np.isfinite(one).all()
                # The very same code, compiled in another place.
                np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


# Steps with a state, parameters and measures of their own


def two_halves(problem: Problem, potentials: Potentials) -> Potentials:
    column = problem.log_nu - problem.lse_rows(potentials.row)
    return Potentials(problem.log_mu - problem.lse_columns(column), column)


@register_step("test-float64-momentum")
@dataclasses.dataclass(frozen=True)
class _Momentum(Step):
    """Sinkhorn's step with momentum, which starts at its second iteration: state and a number."""

    beta: float = 0.3

    def init(self, problem: Problem, params: Any) -> Any:
        return {"last": problem.zeros(), "sum": jnp.zeros((), jnp.int32)}

    def step(
        self, problem: Problem, potentials: Potentials, state: Any, iteration: Any
    ) -> tuple[Potentials, Any]:
        weight = jnp.where(iteration > 0, self.beta, 0.0)
        pushed = jax.tree.map(lambda a, b: a + weight * (a - b), potentials, state["last"])
        new = two_halves(problem, pushed)
        return new, {"last": potentials, "sum": state["sum"] + iteration}


@pytest.mark.parametrize("domain", ["scaling", "log"])
@pytest.mark.parametrize("count", [4, 12])  # written out, and a scan
def test_a_step_with_a_state_and_the_iterations_number(domain: Any, count: int) -> None:
    """In numpy, with its own loop; and the gradient of that loop."""
    config = SinkhornConfig(step=_Momentum(0.4), iterations=count, domain=domain)
    at = inputs()
    scores, log_mu, log_nu, epsilon = map(np.asarray, at)
    kernel = scores / epsilon
    row, column = np.zeros(ROWS), np.zeros(COLUMNS)
    last = (row, column)
    for number in range(count):
        weight = 0.4 if number else 0.0
        pushed = row + weight * (row - last[0])
        last = (row, column)
        column = log_nu - np.log(np.exp(kernel + pushed[:, None]).sum(axis=0))
        row = log_mu - np.log(np.exp(kernel + column).sum(axis=1))
    result = solve(at, config)
    # The same sums in another order.
    np.testing.assert_allclose(result.log_plan, kernel + row[:, None] + column, atol=1e-12)
    assert result.iterations == count
    of = functools.partial(loss, config=config)
    assert_close(jax.jit(jax.grad(of))(at), differences(of, at), 1e-6)


@pytest.mark.parametrize("domain", ["scaling", "log"])
def test_a_state_is_a_problems_own_with_a_tolerance(domain: Any) -> None:
    config = to_rest(step=_Momentum(), gradient="stop", domain=domain)
    at = inputs()
    result = solve(at, config)
    assert result.converged
    np.testing.assert_allclose(np.exp(result.log_plan), ott_plan(), atol=1e-10)
    # Momentum is there for that.
    assert result.iterations < solve(at, to_rest(gradient="stop", domain=domain)).iterations


@register_step("test-float64-lengths")
@dataclasses.dataclass(frozen=True)
class _Lengths(Step):
    """How far each half step goes is learnt, one length an iteration; what is left is projected."""

    count: int = 3

    def init_params(self, key: Any) -> Any:
        return {"lengths": 1 + 0.1 * jax.random.normal(key, (self.count, 2))}

    def step(
        self, problem: Problem, potentials: Potentials, state: Any, iteration: Any
    ) -> tuple[Potentials, Any]:
        lengths = state["lengths"][iteration]
        column = problem.log_nu - problem.lse_rows(potentials.row)
        column = potentials.column + lengths[0] * (column - potentials.column)
        row = problem.log_mu - problem.lse_columns(column)
        return Potentials(potentials.row + lengths[1] * (row - potentials.row), column), state

    def finish(self, problem: Problem, potentials: Potentials) -> Potentials:
        row = problem.log_mu - problem.lse_columns(potentials.column)
        return Potentials(row, potentials.column)


@pytest.mark.parametrize("domain", ["scaling", "log"])
@pytest.mark.parametrize("far", [False, True], ids=["near", "far"])
def test_what_a_step_learns_has_a_gradient(domain: Any, far: bool) -> None:
    at, config = inputs(), SinkhornConfig(step=_Lengths(), domain=domain)
    if far:
        at = at._replace(scores=at.scores.at[1, 2].add(-SCALING_RANGE))
    params = config.step.init_params(jax.random.key(0))
    assert params["lengths"].shape == (3, 2)

    def of(lengths: Any) -> Any:
        return loss(at, config, step_params={"lengths": lengths})

    lengths = params["lengths"].astype(jnp.float64)
    ours = jax.jit(jax.grad(of))(lengths)
    # As above. The last iteration's rows are projected away: its gradient is 0.
    np.testing.assert_allclose(ours, differences(of, lengths), atol=1e-7)
    assert (jnp.abs(ours.ravel()[:5]) > 1e-3).all()
    assert ours[2, 1] == 0
    result = solve(at, config, step_params=params)
    assert result.row_error < 1e-12


@register_step("test-float64-rounds")
@dataclasses.dataclass(frozen=True)
class _Rounds(Step):
    """Stops where columns err little, leaves their potentials shifted, and thins the plan."""

    def step(
        self, problem: Problem, potentials: Potentials, state: Any, iteration: Any
    ) -> tuple[Potentials, Any]:
        return two_halves(problem, potentials), state

    def error(self, problem: Problem, new: Potentials, old: Potentials) -> Any:
        masses = jnp.exp(problem.lse_rows(new.row) + new.column)
        return jnp.abs(masses - jnp.exp(problem.log_nu)).sum(axis=-1)

    def finish(self, problem: Problem, potentials: Potentials) -> Potentials:
        return Potentials(potentials.row - 1, potentials.column + 3)

    def log_plan(self, problem: Problem, potentials: Potentials) -> Any:
        return 2 * problem.log_plan(potentials)


@pytest.mark.parametrize("domain", ["scaling", "log"])
def test_a_steps_own_error_end_and_plan(domain: Any) -> None:
    at = inputs()
    scores, log_mu, log_nu, epsilon = map(np.asarray, at)
    kernel, row = scores / epsilon, np.zeros(ROWS)
    number, missed = 0, np.inf
    while missed > 1e-3:
        number += 1
        column = log_nu - np.log(np.exp(kernel + row[:, None]).sum(axis=0))
        row = log_mu - np.log(np.exp(kernel + column).sum(axis=1))
        masses = np.exp(kernel + row[:, None] + column).sum(axis=0)
        missed = np.abs(masses - np.exp(log_nu)).sum()
    assert 5 < number < 100
    config = to_rest(step="test-float64-rounds", gradient="stop", tolerance=1e-3, domain=domain)
    result = solve(at, config)
    assert result.iterations == number
    assert result.converged
    # Not centred: it does not say that it is entropic.
    np.testing.assert_allclose(result.potentials.row, row - 1, atol=1e-12)
    np.testing.assert_allclose(result.potentials.column, column + 3, atol=1e-12)
    plan = 2 * (kernel + row[:, None] + column + 2)
    np.testing.assert_allclose(result.log_plan, plan, atol=1e-11)
    # Of the plan that comes out.
    rows = np.abs(np.exp(plan).sum(axis=1) / np.exp(log_mu) - 1).max()
    np.testing.assert_allclose(result.row_error, rows, rtol=1e-9)


# A warm start


WARM = ("scaling", "log", "newton", "anderson", "relaxed")


@pytest.mark.parametrize("name", slow_unless({"scaling", "log"}, WARM))
def test_a_warm_start_arrives_sooner_at_the_same_plan(name: str) -> None:
    config, taus, _ = SOLVERS[name]
    at = inputs(2)
    cold = solve(at, config, **taus)
    again = solve(at, config, init=cold.potentials, **taus)
    # Centred potentials have rows and columns as after a last step but for rounding.
    assert (again.iterations <= 2).all()
    near = at._replace(scores=at.scores + 1e-3 * inputs(2, seed=3).scores)
    plain, warm = (solve(near, config, init=init, **taus) for init in (None, cold.potentials))
    for result in (cold, again, plain, warm):
        assert result.converged.all()
    assert (warm.iterations < plain.iterations).all()
    # Both came to rest at 1e-12, as above.
    np.testing.assert_allclose(np.exp(warm.log_plan), np.exp(plain.log_plan), atol=1e-10)
    np.testing.assert_allclose(np.exp(again.log_plan), np.exp(cold.log_plan), atol=1e-10)


def test_a_warm_start_is_where_a_run_that_was_cut_goes_on() -> None:
    """2 and 3 iterations are 5, in either domain; with a gradient through both."""
    for domain in ("scaling", "log"):
        config = SinkhornConfig(domain=domain)

        def cut(at: Inputs, config: SinkhornConfig = config) -> Any:
            first = solve(at, dataclasses.replace(config, iterations=2))
            second = solve(at, config, init=first.potentials)
            return score(second.log_plan, *second.potentials)

        whole = functools.partial(loss, config=dataclasses.replace(config, iterations=5))
        # The same sums; potentials were centred on the way.
        np.testing.assert_allclose(cut(inputs()), whole(inputs()), rtol=1e-12)
        ours, expected = (jax.jit(jax.grad(of))(inputs()) for of in (cut, whole))
        assert_close(ours, expected, 1e-11)


def test_where_a_converged_solution_started_has_no_gradient() -> None:
    at = inputs()
    start = solve(at, SinkhornConfig()).potentials

    def of(init: Potentials) -> Any:
        result = solve(at, to_rest(), init=init)
        return score(result.log_plan, *result.potentials)

    for gradient in jax.grad(of)(start):
        np.testing.assert_array_equal(gradient, 0)
