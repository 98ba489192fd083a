"""Rows and columns of mass 0: the problem without them, under every step, gradient and domain.

In float64, so that what is left of a tolerance is small; float32 and its tolerances are at the end.
"""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

from crisalad_jax.sinkhorn import (
    CapacityStep,
    Potentials,
    Problem,
    SinkhornConfig,
    SinkhornStep,
    Step,
    TopKStep,
    marginal_error,
    register_step,
    solve,
)
from crisalad_jax.utils.errors import InputError
from tests.nn.conftest import slow_unless
from tests.nn.transport.problems import Way, implicit, pot_plan, relaxed

pytestmark = pytest.mark.usefixtures("float64")

TIGHT = 1e-11
ROWS, COLUMNS = 12, 6
# Of each of two problems, as many: at the ends too, where a step may treat a column apart.
EMPTY_ROWS, EMPTY_COLUMNS = ((0, 5), (2, 11)), ((1,), (5,))


@register_step("test-zero-mass-push")
@dataclasses.dataclass(frozen=True)
class _Push(Step):
    """Sinkhorn's step and a share of the last move: a step of the user's own with a memory."""

    entropic: ClassVar[bool] = True

    def init(self, problem: Problem, params: Any) -> Any:
        return problem.zeros().column

    def step(
        self, problem: Problem, potentials: Potentials, state: Any, iteration: Any
    ) -> tuple[Potentials, Any]:
        column = problem.log_nu - problem.lse_rows(potentials.row) + 0.2 * state
        return (
            Potentials(problem.log_mu - problem.lse_columns(column), column),
            column - potentials.column,
        )


def to_rest(**fields: Any) -> SinkhornConfig:
    return implicit(**{"iterations": 2000, "tolerance": TIGHT} | fields)


BOTH = relaxed(0.9, 0.7)
WAYS: dict[str, Way] = {
    "published": Way(SinkhornConfig()),
    "published, log": Way(SinkhornConfig(domain="log")),
    "unrolled, relaxation": Way(SinkhornConfig(step=SinkhornStep(1.6), iterations=6)),
    "unrolled, anderson": Way(SinkhornConfig(anderson_memory=3, iterations=6)),
    "unrolled, newton": Way(SinkhornConfig(step="newton", iterations=6)),
    "unrolled, own": Way(SinkhornConfig(step="test-zero-mass-push", iterations=5)),
    "unrolled, softmax": Way(SinkhornConfig(step="softmax")),
    "unrolled, tau, relaxation": Way(SinkhornConfig(step=SinkhornStep(1.6), iterations=6), BOTH),
    "implicit": Way(to_rest()),
    "implicit, anderson": Way(to_rest(anderson_memory=5)),
    "implicit, newton": Way(to_rest(step="newton")),
    "implicit, own": Way(to_rest(step="test-zero-mass-push")),
    "implicit, tau": Way(to_rest(), BOTH),
    "optimistix": Way(to_rest(gradient="optimistix")),
    "optimistix, solver": Way(
        to_rest(gradient="optimistix"), solver=optimistix.Newton(rtol=TIGHT, atol=TIGHT)
    ),
    "unrolled, nesterov": Way(SinkhornConfig(step="nesterov", iterations=6)),
    "implicit, nesterov": Way(to_rest(step="nesterov")),
    "unrolled, annealing": Way(SinkhornConfig(step="annealing", iterations=6)),
    "unrolled, quadratic": Way(SinkhornConfig(step="quadratic")),
    "unrolled, top-k": Way(SinkhornConfig(step=TopKStep(k=2))),
    "unrolled, capacities": Way(SinkhornConfig(step=CapacityStep(free_last=False))),
    "stop, fixed": Way(SinkhornConfig(gradient="stop")),
}
QUICK = {
    "published",
    "published, log",
    "unrolled, nesterov",
    "unrolled, softmax",
    "implicit",
    "implicit, newton",
    "implicit, tau",
    "optimistix",
}


class Inputs(NamedTuple):
    scores: Any
    log_mu: Any
    log_nu: Any


def whole(zero: float = -np.inf) -> Inputs:
    """Two problems with rows and columns of mass 0, of equal totals."""
    generator = np.random.default_rng(0)
    scores = 2 * generator.standard_normal((2, ROWS, COLUMNS))
    mu, nu = (generator.uniform(0.5, 2, (2, size)) for size in (ROWS, COLUMNS))
    for index in range(2):
        mu[index, EMPTY_ROWS[index]] = 0
        nu[index, EMPTY_COLUMNS[index]] = 0
    nu *= mu.sum(axis=1, keepdims=True) / nu.sum(axis=1, keepdims=True)
    log_mu, log_nu = (np.where(x > 0, np.log(np.where(x > 0, x, 1)), zero) for x in (mu, nu))
    return Inputs(*map(jnp.asarray, (scores, log_mu, log_nu)))


def without(x: Any, rows: bool, columns: bool) -> np.ndarray:
    """The same without what has no mass."""
    found = []
    for index, one in enumerate(np.asarray(x)):
        if rows:
            one = np.delete(one, EMPTY_ROWS[index], axis=0)
        if columns:
            one = np.delete(one, EMPTY_COLUMNS[index], axis=-1)
        found.append(one)
    return np.stack(found)


def only(x: Any) -> np.ndarray:
    """What is left of the entries that have no mass, of matrices."""
    mask = np.zeros((2, ROWS, COLUMNS), bool)
    for index in range(2):
        mask[index, EMPTY_ROWS[index], :] = True
        mask[index][:, EMPTY_COLUMNS[index]] = True
    return np.asarray(x)[mask]


def reduced(at: Inputs) -> Inputs:
    sides = (True, True), (True, False), (False, True)
    return Inputs(*(jnp.asarray(without(x, *which)) for x, which in zip(at, sides, strict=True)))


WEIGHTS = np.random.default_rng(3).standard_normal((2, ROWS, COLUMNS))


def slope(at: Inputs, weights: Any, way: Way, init: Potentials | None = None) -> Any:
    def loss(at: Inputs) -> Any:
        result = solve(*at, config=way.config, solver=way.solver, init=init, **way.taus)
        return (weights * jnp.exp(result.log_plan)).sum(), result

    return jax.jit(jax.grad(loss, has_aux=True))(at)


def balanced(gradient: Inputs, at: Inputs) -> Inputs:
    """Leave out what a gradient says of marginals whose totals differ.

    No balanced plan has them. Once Newton's method has converged, rounding decides whether its last
    step is Newton's or Sinkhorn's, and these differ there by a multiple of the marginals.
    """
    mu, nu = jnp.exp(at.log_mu), jnp.exp(at.log_nu)
    share = gradient.log_mu.sum(axis=-1, keepdims=True) / mu.sum(axis=-1, keepdims=True)
    return gradient._replace(
        log_mu=gradient.log_mu - share * mu, log_nu=gradient.log_nu + share * nu
    )


def assert_is_the_problem_without(found: Any, expected: Any) -> None:
    """Gradient and result, against those of the problem without what has no mass."""
    (gradient, result), (expected_gradient, wanted) = found, expected
    plan = np.exp(np.asarray(result.log_plan))
    np.testing.assert_array_equal(only(plan), 0)
    np.testing.assert_array_equal(only(gradient.scores), 0)
    # Sums in another order, and systems of condition number 1e2 to 1e4 or so.
    close: dict[str, Any] = {"rtol": 1e-8, "atol": 1e-10}
    np.testing.assert_allclose(without(plan, True, True), np.exp(wanted.log_plan), **close)
    for name, sides in (("scores", (True, True)), ("log_mu", (True, False))):
        ours = getattr(gradient, name)
        assert np.isfinite(ours).all()
        np.testing.assert_allclose(without(ours, *sides), getattr(expected_gradient, name), **close)
    assert np.isfinite(gradient.log_nu).all()
    np.testing.assert_allclose(
        without(gradient.log_nu, False, True), expected_gradient.log_nu, **close
    )
    for index in range(2):
        np.testing.assert_array_equal(gradient.log_mu[index, EMPTY_ROWS[index]], 0)
        np.testing.assert_array_equal(gradient.log_nu[index, EMPTY_COLUMNS[index]], 0)
    np.testing.assert_allclose(result.row_error, wanted.row_error, **close)
    np.testing.assert_allclose(result.column_error, wanted.column_error, **close)
    np.testing.assert_array_equal(result.converged, wanted.converged)
    assert result.finite.all()
    for ours, theirs, sides in zip(
        result.potentials, wanted.potentials, ((True, False), (False, True)), strict=True
    ):
        assert np.isfinite(ours).all()
        np.testing.assert_allclose(without(ours, *sides), theirs, **close)


@pytest.mark.parametrize("name", slow_unless(QUICK, WAYS))
def test_no_mass_is_the_problem_without(name: str) -> None:
    way, at = WAYS[name], whole()
    found = slope(at, jnp.asarray(WEIGHTS), way)
    expected = slope(reduced(at), jnp.asarray(without(WEIGHTS, True, True)), way)
    if name == "unrolled, newton":
        found, expected = (
            (balanced(x[0], y), x[1]) for x, y in ((found, at), (expected, reduced(at)))
        )
    assert_is_the_problem_without(found, expected)
    assert found[1].converged.all() == (way.config.tolerance is not None)
    # Rounding may decide whether a last change is within 1e-11.
    assert np.abs(found[1].iterations - expected[1].iterations).max() <= 1


STARTS = ("implicit", "published", "implicit, newton", "implicit, anderson", "implicit, tau")


@pytest.mark.parametrize("name", slow_unless({"implicit"}, STARTS))
def test_a_results_potentials_are_where_the_next_solve_starts(name: str) -> None:
    """Those of what has no mass included; another library's, of -inf there, are the same."""
    way, at = WAYS[name], whole()
    _, cold = slope(at, jnp.asarray(WEIGHTS), way)
    row = jnp.asarray(without(cold.potentials.row, True, False))
    column = jnp.asarray(without(cold.potentials.column, False, True))
    weights = jnp.asarray(without(WEIGHTS, True, True))
    expected = slope(reduced(at), weights, way, Potentials(row, column))
    own = cold.potentials
    infinite = Potentials(*(jnp.where(x < -1e5, -jnp.inf, x) for x in own))
    assert not np.isfinite(infinite.row).all()
    for init in (own, infinite):
        warm = slope(at, jnp.asarray(WEIGHTS), way, init)
        assert_is_the_problem_without(warm, expected)
        if way.config.tolerance is not None:
            assert (warm[1].iterations <= 2).all()
            assert (cold.iterations > 3).all()


@pytest.mark.parametrize("zero", [-np.inf, -1e9])
@pytest.mark.parametrize("taus", [{}, BOTH], ids=["balanced", "relaxed"])
@pytest.mark.parametrize("how", ["eager", "jit", "vmap"])
def test_plans_are_pots(how: str, taus: Any, zero: float) -> None:
    def plan(scores: Any, log_mu: Any, log_nu: Any) -> Any:
        result = solve(scores, log_mu, log_nu, config=to_rest(), **taus)
        return jnp.exp(result.log_plan), result.converged

    ways = {"eager": plan, "jit": jax.jit(plan), "vmap": jax.jit(jax.vmap(plan))}
    found, converged = ways[how](*whole(zero))
    assert converged.all()
    np.testing.assert_array_equal(only(found), 0)
    # Relative: what POT stops at is relative to its largest scaling.
    expected = [pot_plan(*at, 1.0, **relaxed(**taus)) for at in zip(*reduced(whole()), strict=True)]
    np.testing.assert_allclose(without(found, True, True), expected, rtol=1e-8)


def test_forward_mode_and_second_order() -> None:
    """The implicit rule, as differences of plans and of gradients have it."""
    at, config = whole(), to_rest()
    direction = jnp.asarray(np.random.default_rng(5).standard_normal(at.scores.shape))

    def loss(scores: Any) -> Any:
        result = solve(scores, at.log_mu, at.log_nu, config=config)
        return (jnp.asarray(WEIGHTS) * jnp.exp(result.log_plan)).sum()

    def along(length: Any) -> Any:
        return loss(at.scores + length * direction)

    first = jax.jit(jax.jacfwd(along))
    step = 1e-4
    forward = first(0.0)
    differences = (along(step) - along(-step)) / (2 * step)
    # Third derivatives of order 1 times 1e-8, and 1e-10 that has not converged over 1e-4.
    np.testing.assert_allclose(forward, differences, atol=1e-5)
    second = jax.jit(jax.jacfwd(jax.grad(along)))(0.0)
    differences = (first(step) - first(-step)) / (2 * step)
    np.testing.assert_allclose(second, differences, atol=1e-5)


# What is refused, and what is told


@pytest.mark.parametrize(
    ("name", "bad"), [("log_nu", np.nan), ("log_mu", np.inf), ("log_mu", -np.inf)]
)
def test_bad_masses_are_refused_where_they_are_known(name: str, bad: float) -> None:
    message = f"^sinkhorn: {name} found with NaN, infinity or no mass at all, expected finite"
    at = whole()
    masses = getattr(at, name)
    # One number, or all of one problem where none is by itself bad.
    place = (1,) if bad == -np.inf else (1, 3)
    at = at._replace(**{name: masses.at[place].set(bad)})
    with pytest.raises(InputError, match=message) as raised:
        solve(*at)
    assert "\n" not in str(raised.value)
    with pytest.raises(InputError, match=message):  # and beside scores that are traced
        jax.jit(lambda scores: solve(scores, at.log_mu, at.log_nu))(at.scores)


@pytest.mark.parametrize("name", ["published", "implicit"])
@pytest.mark.parametrize("part", ["scores", "log_mu", "log_nu"])
def test_nan_under_jit_is_never_converged(name: str, part: str) -> None:
    """Beside rows and columns without mass; the problem beside it has its plan."""
    way, at = WAYS[name], whole()
    values = getattr(at, part)
    bad = at._replace(**{part: values.at[(1, 4, 2) if part == "scores" else (1, 4)].set(jnp.nan)})
    result = jax.jit(lambda at: solve(*at, config=way.config))(bad)
    np.testing.assert_array_equal(result.finite, [True, False])
    known = way.config.tolerance is not None
    np.testing.assert_array_equal(result.converged, [known, False])
    alone = jax.jit(lambda at: solve(*at, config=way.config))(at)
    np.testing.assert_allclose(result.log_plan[0], alone.log_plan[0], rtol=1e-9)


@pytest.mark.parametrize("name", ["published", "implicit"])
def test_a_problem_without_any_mass_under_jit(name: str) -> None:
    """Its plan is 0 and says whether that is right; gradients are 0, and its neighbour's its own.

    Where only its rows have none, its columns miss all of theirs.
    """
    way, at = WAYS[name], whole()
    for nothing in ("both", "rows"):
        log_nu = at.log_nu.at[1].set(-jnp.inf) if nothing == "both" else at.log_nu
        none = at._replace(log_mu=at.log_mu.at[1].set(-jnp.inf), log_nu=log_nu)
        gradient, result = slope(none, jnp.asarray(WEIGHTS), way)
        np.testing.assert_array_equal(jnp.exp(result.log_plan[1]), 0)
        assert result.row_error[1] == 0
        assert result.column_error[1] == (nothing == "rows")
        assert not (nothing == "rows" and result.converged[1])
        for part in gradient:
            assert np.isfinite(part).all()
            np.testing.assert_array_equal(part[1], 0)
        expected, alone = slope(at, jnp.asarray(WEIGHTS), way)
        np.testing.assert_allclose(result.log_plan[0], alone.log_plan[0], rtol=1e-9)
        np.testing.assert_allclose(gradient.scores[0], expected.scores[0], atol=1e-10)


def test_marginal_error_of_no_mass_by_hand() -> None:
    """0 where the plan has none, infinite where it has some; the others' as ever."""
    with np.errstate(divide="ignore"):
        log_plan = jnp.asarray(np.log([[0.5, 0.0, 0.25], [0.0, 0.0, 0.0]]))
        mu, nu = np.log([0.5, 0.0]), np.log([0.5, 0.0, 0.5])
    rows, columns = marginal_error(log_plan, jnp.asarray(mu), jnp.asarray(nu))
    # Rounding of logarithms.
    np.testing.assert_allclose([rows, columns], [0.5, 0.5], rtol=1e-12)
    rows, columns = marginal_error(log_plan, jnp.asarray(mu), jnp.asarray(nu).at[2].set(-jnp.inf))
    assert columns == jnp.inf


# In float32, as models compute


@pytest.mark.parametrize("domain", ["scaling", "log"])
@pytest.mark.parametrize("gradient", ["unrolled", "implicit", "optimistix", "stop"])
def test_float32_under_jit(gradient: Any, domain: Any) -> None:
    """A row and a column of mass 0 in four: 0.25 in each other column, and gradients."""
    settings: dict[str, Any] = {"gradient": gradient, "domain": domain, "iterations": 200}
    if gradient != "unrolled":
        settings["tolerance"] = 1e-5
    with jax.enable_x64(False):
        scores = 2 * jax.random.normal(jax.random.key(0), (5, 5), jnp.float32)
        log_mass = jnp.log(jnp.array([0.25, 0.25, 0, 0.25, 0.25], jnp.float32))

        @jax.jit
        def of(scores: jax.Array, log_mass: jax.Array) -> Any:
            def loss(scores: jax.Array) -> Any:
                config = SinkhornConfig(**settings)
                result = solve(scores, log_mass, log_mass, config=config)
                # Through the logarithm of what has mass, and through the plan.
                plan = jnp.exp(result.log_plan)
                return (plan * result.log_plan).sum() + plan[0, 0], result

            return jax.grad(loss, has_aux=True)(scores)

        slopes, result = of(scores, log_mass)
        plan = np.asarray(jnp.exp(result.log_plan), np.float64)
        # What the tolerance, or float32 potentials at convergence, leave.
        np.testing.assert_allclose(plan.sum(axis=0), [0.25, 0.25, 0, 0.25, 0.25], rtol=1e-4)
        np.testing.assert_allclose(plan.sum(axis=1), [0.25, 0.25, 0, 0.25, 0.25], rtol=1e-4)
        assert result.converged == (gradient != "unrolled")
        assert np.isfinite(slopes).all()
        assert np.abs(slopes).max() > 1e-3
        np.testing.assert_array_equal(slopes[2], 0)
        np.testing.assert_array_equal(slopes[:, 2], 0)


@pytest.mark.parametrize("score", [0.0, -80.0], ids=["near", "far"])
def test_no_nan_on_the_way(score: float) -> None:
    """A hunt for NaNs finds none, forward and backward, in the unused domain either."""
    at = whole()

    def loss(scores: jax.Array) -> jax.Array:
        return jnp.exp(solve(scores, at.log_mu, at.log_nu).log_plan).max()

    with jax.debug_nans(True):
        slopes = jax.grad(loss)(at.scores.at[1, 4, 2].set(score))
    assert np.isfinite(slopes).all()
