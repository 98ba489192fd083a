"""What `solve`, `assign_with_dustbin`, a registration and the settings refuse, and say."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.sinkhorn import (
    Dustbin,
    Marginals,
    Potentials,
    Problem,
    SinkhornConfig,
    SinkhornStep,
    Step,
    append_dustbin,
    assign_with_dustbin,
    log_marginals,
    register_dustbin,
    register_step,
    solve,
)
from crisalad_jax.utils.errors import InputError
from tests.nn.conftest import slow_unless
from tests.nn.transport.problems import implicit


@register_step("test-input-tuple")
def _plain_tuple(problem: Problem, at: Potentials) -> Any:
    return tuple(at)


@register_step("test-input-state")
@dataclasses.dataclass(frozen=True)
class _Unsteady(Step):
    """Its state is a whole number, then one that is not."""

    def init(self, problem: Problem, params: Any) -> Any:
        return jnp.zeros((), jnp.int32)

    def step(self, problem: Problem, potentials: Potentials, state: Any, iteration: Any) -> Any:
        return potentials, state + 0.5


@register_step("test-input-alone")
@dataclasses.dataclass(frozen=True)
class _Alone(Step):
    def step(self, problem: Problem, potentials: Potentials, state: Any, iteration: Any) -> Any:
        return potentials


MU, NU = jnp.zeros(6), jnp.log(jnp.array([1.0, 2.0, 3.0]))
SCORES = jnp.zeros((6, 3))
BAD_SOLVES: dict[str, tuple[dict[str, Any], str]] = {
    "one axis": ({"scores": jnp.zeros(3)}, r"found scores of shape \(3,\), expected"),
    "no columns": (
        {"scores": SCORES[:, :0], "log_nu": NU[:0]},
        r"found scores of shape \(6, 0\), expected",
    ),
    "rows": ({"scores": SCORES[:5]}, r"log_mu found of shape \(6,\), expected \(5,\)"),
    "batches": (
        {"scores": jnp.zeros((2, 6, 3)), "log_mu": jnp.zeros((3, 6))},
        r"log_mu found of shape \(3, 6\), expected \(2, 6\) for scores of \(2, 6, 3\)",
    ),
    "epsilons": ({"epsilon": jnp.ones(3)}, r"epsilon found of shape \(3,\), expected \(\)"),
    "row_tau": ({"row_tau": 0.0}, "row_tau found 0.0, expected more than 0 and at most 1"),
    "column_tau": ({"column_tau": 1.1}, "column_tau found 1.1, expected more than 0 and at most"),
    "init.row": (
        {"init": Potentials(jnp.zeros(5), jnp.zeros(3))},
        r"^sinkhorn: init.row .* \(5,\), expected \(6,\)",
    ),
    "init.column": (
        {"init": (jnp.zeros(6), jnp.zeros(6))},
        r"^sinkhorn: init.column found of shape \(6,\), expected \(3,\)",
    ),
    "complex scores": ({"scores": SCORES + 1j}, "found complex scores, expected real ones"),
    "newton, relaxed rows": (
        {"row_tau": 0.5, "config": SinkhornConfig("newton")},
        "step newton: found relaxed marginals, expected row_tau 1 and column_tau 1",
    ),
    "a step's tuple": (
        {"config": SinkhornConfig("test-input-tuple")},
        r"^step test-input-tuple, step: found to return \(\(float32.*, expected \(Potentials\(row",
    ),
    "a step's state": (
        {"config": SinkhornConfig("test-input-state")},
        "^step test-input-state, step: found to return .*, float32.*, expected .*, int32",
    ),
    "a step without a state": (
        {"config": SinkhornConfig("test-input-alone")},
        r"^step test-input-alone, step: found to return P.*expected \(Potentials.*, None\)",
    ),
}
BAD_DUSTBINS: dict[str, tuple[tuple[Any, ...], str]] = {
    "its name": ((SCORES, 1.0, "row"), "^dustbin: found 'row', expected one of column, mass, none"),
    "one axis": ((SCORES[:, 0], 1.0), r"assign_with_dustbin: found scores of shape \(6,"),
    "no mass": ((jnp.zeros((6, 6)), 1.0), "6 patches for 6 clusters"),
    "one score": (
        (SCORES, jnp.float32(1), "token"),
        r"dustbin: found parameters of shape \(\), expected \(6,\)",
    ),
}


def solve_with(options: dict[str, Any]) -> Any:
    return solve(**{"scores": SCORES, "log_mu": MU, "log_nu": NU} | options)


@pytest.mark.usefixtures("_unchecked")
@pytest.mark.parametrize("traced", [False, True], ids=["eager", "traced"])
@pytest.mark.parametrize("name", BAD_SOLVES)
def test_bad_shapes_and_pairs_raise(name: str, traced: bool) -> None:
    options, message = BAD_SOLVES[name]
    with pytest.raises(InputError, match=message) as raised:
        jax.eval_shape(lambda: solve_with(options)) if traced else solve_with(options)
    assert "\n" not in str(raised.value)


@pytest.mark.usefixtures("_unchecked")
@pytest.mark.parametrize("name", BAD_DUSTBINS)
def test_what_no_dustbin_takes(name: str) -> None:
    arguments, message = BAD_DUSTBINS[name]
    with pytest.raises(InputError, match=message):
        assign_with_dustbin(*arguments)


@pytest.mark.parametrize("name", ["row", "column"])
def test_a_start_that_is_nan_is_refused(name: str) -> None:
    start = Potentials(MU, NU)
    start = start._replace(**{name: getattr(start, name).at[1].set(jnp.nan)})
    with pytest.raises(InputError, match=rf"^sinkhorn: init\.{name} found with NaN"):
        solve_with({"init": start})


@pytest.mark.usefixtures("_unchecked")
@pytest.mark.parametrize(
    ("scores", "log_mu", "log_nu", "epsilon", "message"),
    [
        (jnp.nan, MU, NU, 1.0, "scores found with NaN or infinity"),
        (0.0, MU.at[1].set(-jnp.inf), NU, 1.0, "found to sum to 5 and 6, expected the same"),
        (0.0, MU, NU, 1e-300, "epsilon found 1e-300, expected at least"),
        (0.0, MU, NU, jnp.float32(jnp.nan), "epsilon found nan, expected at least"),
        (1e10, MU, NU, 1e-35, "scores overflow, expected quotients in float32's range"),
        (0.0, MU, NU + 3e-4, 1.0, "found to sum to 6 and 6.0018, expected the same"),
        (0.0, jnp.stack([MU, MU - 1]), NU, 1.0, "found to sum to 2.20728 and 6, expected the same"),
    ],
)
def test_bad_numbers_raise(
    scores: float, log_mu: Any, log_nu: Any, epsilon: Any, message: str
) -> None:
    full = jnp.zeros((2, 6, 3)).at[1, 2, 1].set(scores)
    with pytest.raises(InputError, match=f"sinkhorn: .*{message}") as raised:
        solve(full, log_mu, log_nu, epsilon=epsilon)
    assert "\n" not in str(raised.value)
    known = jnp.isfinite(scores)
    if known and epsilon == 1:  # and where they are known while the scores are traced
        with pytest.raises(InputError, match=message):
            jax.jit(lambda scores: solve(scores, log_mu, log_nu))(full)


def test_totals_of_a_step_of_another_problem_need_not_agree() -> None:
    """Rows of a softmax send all their mass, whatever the columns' marginals."""
    plan = jnp.exp(solve(SCORES, MU, NU - 1, config=SinkhornConfig(step="softmax")).log_plan)
    np.testing.assert_allclose(plan, 1 / 3, rtol=1e-6)  # a quotient of exponentials in float32


def test_totals_need_not_agree_to_the_last_digits_nor_where_marginals_are_relaxed() -> None:
    """Sums of logarithms in float32 do not."""
    assert solve(SCORES, MU, NU + 1e-5).finite
    assert solve(SCORES, MU, NU + 1, column_tau=0.5).finite


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16])
@pytest.mark.parametrize("coarse", slow_unless({"both"}, ("both", "rows", "columns")))
def test_half_precision_marginals_have_the_totals_of_their_rounding(
    coarse: str, dtype: Any
) -> None:
    """Masses of 256 rows and 65 columns, whose totals differ by up to half a hundredth as given.

    The columns take the rows' total.
    """
    generator = np.random.default_rng(0)
    # One heavy mass a side, whose rounding no others' makes up for.
    mu, nu = (np.append(generator.uniform(0.5, 2, size), 150.0) for size in (255, 64))
    nu *= mu.sum() / nu.sum()
    rounded = {"rows": coarse != "columns", "columns": coarse != "rows"}
    log_mu, log_nu = (
        jnp.log(jnp.asarray(x, jnp.float32)).astype(dtype if rounded[side] else jnp.float32)
        for side, x in (("rows", mu), ("columns", nu))
    )
    given = [np.exp(np.asarray(x.astype(jnp.float32), np.float64)) for x in (log_mu, log_nu)]
    totals = [x.sum() for x in given]
    assert abs(totals[0] / totals[1] - 1) > 2e-5
    scores = jax.random.normal(jax.random.key(0), (256, 65)).astype(dtype)
    config = implicit()
    for call in (solve, jax.jit(solve, static_argnames="config")):
        result = call(scores, log_mu, log_nu, config=config)
        assert result.converged
        plan = np.exp(np.asarray(result.log_plan, np.float64))
        # The tolerance of 1e-5, and as much rounding of sums in float32.
        np.testing.assert_allclose(plan.sum(axis=1), given[0], rtol=3e-5)
        np.testing.assert_allclose(plan.sum(axis=0), given[1] * totals[0] / totals[1], rtol=3e-5)


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16])
def test_salads_marginals_in_half_precision(dtype: Any) -> None:
    """The logarithm of the dustbin's 192 is rounded by a hundredth; published iterations meet it.

    What is more than rounding is refused, and under jit left as it is and told.
    """
    log_mu, log_nu = log_marginals(256, 64, dtype=dtype)
    scores = jax.random.normal(jax.random.key(0), (256, 64)).astype(dtype)
    full = append_dustbin(scores, 1.0)
    result = solve(full, log_mu, log_nu, config=SinkhornConfig(iterations=20))
    # float32 at convergence: nothing is left of the difference of the totals.
    assert result.column_error < 1e-5
    exact = solve(full, *log_marginals(256, 64), config=SinkhornConfig(iterations=20))
    # Of the dustbin's mass: half a unit in the last place of its logarithm of 5.26, times the
    # share of all mass that it has not.
    rounding = 4 * float(jnp.finfo(dtype).eps) / 2
    np.testing.assert_allclose(
        jnp.exp(result.log_plan)[:, -1].sum(), jnp.exp(exact.log_plan)[:, -1].sum(), rtol=rounding
    )
    off = log_nu.at[-1].add(0.5)
    with pytest.raises(InputError, match="expected the same"):
        solve(full, log_mu, off)
    told = jax.jit(lambda x: solve(full, log_mu, x, config=implicit()))(off)
    assert not told.converged
    assert told.column_error > 0.1


@pytest.mark.usefixtures("_unchecked")
def test_whole_numbers_are_logarithms_too() -> None:
    """Which have no rounding."""
    zeros = jnp.zeros(4, jnp.int32)
    plan = jnp.exp(solve(jnp.zeros((4, 4)), zeros, zeros).log_plan)
    np.testing.assert_allclose(plan, 0.25, rtol=1e-6)  # quotients of exponentials


@pytest.mark.usefixtures("_unchecked")
@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"step": "simplex"}, "step: found 'simplex', expected one of .*is a plug-in missing"),
        ({"step": 3}, "step: found 3, expected a step or its name"),
        ({"domain": "kernel"}, "domain: found 'kernel'"),
        ({"gradient": "exact"}, "gradient: found 'exact', expected one of implicit, optim"),
        ({"tolerance": 0.0, "gradient": "stop"}, "tolerance: found 0.0"),
        ({"anderson_memory": 1}, "anderson_memory: found 1"),
        ({"gradient": "implicit"}, "found Implicit.*expected a tolerance"),
        ({"tolerance": 1e-3}, "expected a fixed number of iterations"),
        ({"throw": True}, "throw: found True, expected a tolerance"),
        (
            {"gradient": "optimistix", "tolerance": 1e-3, "anderson_memory": 3},
            "anderson_memory: found 3, expected 0; or a whole number from 2, with",
        ),
        (
            {"step": "softmax", "gradient": "implicit", "tolerance": 1e-3},
            "expected a step that says it solves the entropic problem, not 'softmax'",
        ),
    ],
)
def test_bad_settings_raise(fields: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as raised:
        SinkhornConfig(**fields)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        *((SinkhornStep, {"relaxation": bad}) for bad in (2.0, 0.9, float("nan"))),
        (SaladConfig, {"dustbin": "row"}),
        (SaladConfig, {"epsilon": float("inf")}),
        (SaladConfig, {"row_tau": 0.0}),
        (SaladConfig, {"column_tau": 1.1}),
    ],
)
def test_bad_fields_are_named_with_what_was_found(kind: type, fields: dict[str, Any]) -> None:
    ((name, bad),) = fields.items()
    with pytest.raises(InputError, match=f"{kind.__name__}.{name}: found {bad!r}, expected"):
        kind(**fields)


def test_what_is_registered_twice_is_the_later() -> None:
    """As where a notebook's cell is run again: one class of one module, with other code."""

    def make(step: float) -> Any:
        @register_step("test-input-again")
        def again(problem: Problem, at: Potentials) -> Potentials:
            return at._replace(row=at.row + step)

        return again

    zeros = jnp.zeros(3)
    for step in (1.0, 2.0):
        make(step)
        config = SinkhornConfig(step="test-input-again", iterations=2)
        result = solve(jnp.zeros((3, 3)), zeros, zeros, config=config)
        assert result.potentials.row.tolist() == [2 * step] * 3


@register_dustbin("test-input-last-patch")
@dataclasses.dataclass(frozen=True)
class _LastPatch(Dustbin):
    """The last number of each patch's features is its score for the dustbin, with a factor."""

    takes_difference = True
    factor: float = 2.0

    def init(self, key: Any, dim: int) -> Any:
        return {"shift": jnp.full((), 0.5)}

    def marginals(self, params: Any, scores: Any, patches: Any) -> Any:
        column = self.factor * patches[..., -1] + params["shift"]
        log_mu, log_nu = log_marginals(*scores.shape[-2:])
        return Marginals(append_dustbin(scores, column), log_mu, log_nu)


def test_a_dustbin_of_ones_own() -> None:
    scores, patches = (jax.random.normal(jax.random.key(x), (2, 9, 4)) for x in (0, 1))
    dustbin = _LastPatch(factor=3.0)
    params = dustbin.init(jax.random.key(2), 4)
    found = assign_with_dustbin(scores, params, dustbin, patches=patches)
    expected = assign_with_dustbin(scores, 3 * patches[..., -1] + 0.5, "token")
    assert (found.log_plan == expected.log_plan).all()
    named = assign_with_dustbin(scores, params, "test-input-last-patch", patches=patches)
    expected = assign_with_dustbin(scores, 2 * patches[..., -1] + 0.5, "token")
    assert (named.log_plan == expected.log_plan).all()
