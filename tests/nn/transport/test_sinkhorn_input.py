"""What `solve`, `assign_with_dustbin`, a registration and the settings refuse, and say."""

import dataclasses
from collections.abc import Callable
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


def implicit(**fields: Any) -> SinkhornConfig:
    return SinkhornConfig(gradient="implicit", tolerance=1e-5, **fields)


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
BAD_CALLS: dict[str, tuple[Callable[[], Any], str]] = {
    "one axis": (
        lambda: solve(jnp.zeros(3), MU, NU),
        r"found scores of shape \(3,\), expected",
    ),
    "rows": (
        lambda: solve(jnp.zeros((5, 3)), MU, NU),
        r"log_mu found of shape \(6,\), expected \(5,\)",
    ),
    "batches": (
        lambda: solve(jnp.zeros((2, 6, 3)), jnp.zeros((3, 6)), NU),
        r"log_mu found of shape \(3, 6\), expected \(2, 6\) for scores of \(2, 6, 3\)",
    ),
    "epsilons": (
        lambda: solve(jnp.zeros((6, 3)), MU, NU, epsilon=jnp.ones(3)),
        r"epsilon found of shape \(3,\), expected \(\)",
    ),
    "newton, relaxed rows": (
        lambda: solve(jnp.zeros((6, 3)), MU, NU, row_tau=0.5, config=SinkhornConfig("newton")),
        "step newton: found row_tau 0.5 and column_tau 1.0, expected 1",
    ),
    "row_tau": (
        lambda: solve(jnp.zeros((6, 3)), MU, NU, row_tau=0.0),
        "row_tau found 0.0, expected more than 0 and at most 1",
    ),
    "column_tau": (
        lambda: assign_with_dustbin(jnp.zeros((6, 3)), 1.0, column_tau=1.1),
        "column_tau found 1.1, expected more than 0 and at most 1",
    ),
    "dustbin": (
        lambda: assign_with_dustbin(jnp.zeros((6, 3)), 1.0, "row"),
        "^dustbin: found 'row', expected one of column, mass, none, row and column,",
    ),
    "no columns": (
        lambda: solve(jnp.zeros((6, 0)), MU, MU[:0]),
        r"found scores of shape \(6, 0\), expected",
    ),
    "a step's tuple": (
        lambda: solve(jnp.zeros((6, 3)), MU, NU, config=SinkhornConfig("test-input-tuple")),
        r"^step test-input-tuple, step: found to return \(\(float32.*, expected \(Potentials\(row",
    ),
    "a step's state": (
        lambda: solve(jnp.zeros((6, 3)), MU, NU, config=SinkhornConfig("test-input-state")),
        "^step test-input-state, step: found to return .*, float32.*, expected .*, int32",
    ),
    "a step without a state": (
        lambda: solve(jnp.zeros((6, 3)), MU, NU, config=SinkhornConfig("test-input-alone")),
        r"^step test-input-alone, step: found to return P.*expected \(Potentials.*, None\)",
    ),
    "assign": (
        lambda: assign_with_dustbin(jnp.zeros(6), jnp.float32(1)),
        r"assign_with_dustbin: found scores of shape \(6,",
    ),
    "no mass": (
        lambda: assign_with_dustbin(jnp.zeros((6, 6)), jnp.float32(1)),
        "6 patches for 6 clusters",
    ),
    "token, one": (
        lambda: assign_with_dustbin(jnp.zeros((6, 3)), jnp.float32(1), "token"),
        r"dustbin: found parameters of shape \(\), expected \(6,\)",
    ),
}


@pytest.mark.usefixtures("_unchecked")
@pytest.mark.parametrize("traced", [False, True], ids=["eager", "traced"])
@pytest.mark.parametrize("name", BAD_CALLS)
def test_bad_shapes_and_pairs_raise(name: str, traced: bool) -> None:
    call, message = BAD_CALLS[name]
    with pytest.raises(InputError, match=message) as raised:
        jax.eval_shape(call) if traced else call()
    assert "\n" not in str(raised.value)


@pytest.mark.usefixtures("_unchecked")
@pytest.mark.parametrize(
    ("scores", "log_mu", "log_nu", "epsilon", "message"),
    [
        (jnp.nan, MU, NU, 1.0, "scores found with NaN or infinity"),
        (jnp.inf, MU, NU, 1.0, "scores found with NaN or infinity"),
        (0.0, MU.at[1].set(-jnp.inf), NU, 1.0, "found to sum to 5 and 6, expected the same"),
        (0.0, MU, NU, 0.0, "epsilon found 0.0, expected at least 1.2e-38"),
        (0.0, MU, NU, 1e-300, "epsilon found 1e-300, expected at least"),
        (0.0, MU, NU, jnp.float32(jnp.nan), "epsilon found nan, expected at least"),
        (1e10, MU, NU, 1e-35, "scores overflow, expected numbers that float32 can hold"),
        (0.0, MU, NU + 1e-3, 1.0, "found to sum to 6 and 6.006, expected the same"),
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
    plan = jnp.exp(
        solve(jnp.zeros((6, 3)), MU, NU - 1, config=SinkhornConfig(step="softmax")).log_plan
    )
    np.testing.assert_allclose(plan, 1 / 3, rtol=1e-6)  # a quotient of exponentials in float32


def test_totals_need_not_agree_to_the_last_digits() -> None:
    """Sums of logarithms in float32 do not."""
    assert solve(jnp.zeros((6, 3)), MU, NU + 1e-5).finite


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16])
@pytest.mark.parametrize("scores_dtype", [None, jnp.float32], ids=["half", "float32"])
@pytest.mark.parametrize("coarse", ["both", "rows", "columns"])
def test_half_precision_marginals_have_the_totals_of_their_rounding(
    coarse: str, scores_dtype: Any, dtype: Any
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
    scores = jax.random.normal(jax.random.key(0), (256, 65)).astype(scores_dtype or dtype)
    config = implicit(iterations=300)
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


def test_totals_need_not_agree_where_marginals_are_relaxed() -> None:
    assert solve(jnp.zeros((6, 3)), MU, NU + 1, column_tau=0.5).finite


@pytest.mark.usefixtures("_unchecked")
@pytest.mark.parametrize(
    ("kind", "fields", "message"),
    [
        (
            SinkhornConfig,
            {"step": "simplex"},
            "^SinkhornConfig.step: found 'simplex', expected one of dual-softmax, newton, "
            "sinkhorn, softmax.*is a plug-in missing",
        ),
        (SinkhornConfig, {"step": 3}, "SinkhornConfig.step: found 3, expected a step or its name"),
        (SinkhornConfig, {"domain": "kernel"}, "SinkhornConfig.domain: found 'kernel'"),
        (
            SinkhornConfig,
            {"gradient": "exact"},
            "SinkhornConfig.gradient: found 'exact', expected one of implicit, optim",
        ),
        (
            SinkhornConfig,
            {"tolerance": 0.0, "gradient": "stop"},
            "SinkhornConfig.tolerance: found 0.0",
        ),
        (SinkhornConfig, {"anderson_memory": 1}, "SinkhornConfig.anderson_memory: found 1"),
        (SinkhornConfig, {"anderson_memory": -2}, "SinkhornConfig.anderson_memory: found -2"),
        (
            SinkhornConfig,
            {"gradient": "implicit"},
            "found Implicit.*expected a tolerance",
        ),
        (SinkhornConfig, {"tolerance": 1e-3}, "expected a fixed number of iterations"),
        (SinkhornConfig, {"throw": True}, "throw: found True, expected a tolerance"),
        (
            SinkhornConfig,
            {"gradient": "optimistix", "tolerance": 1e-3, "anderson_memory": 3},
            "anderson_memory: found 3, expected 0; or a whole number from 2, with",
        ),
        (
            SinkhornConfig,
            {"step": "softmax", "gradient": "implicit", "tolerance": 1e-3},
            "expected a step that says it solves the entropic problem, not 'softmax'",
        ),
        (
            SinkhornConfig,
            {"step": "test-input-tuple", "gradient": "implicit", "tolerance": 1e-3},
            "expected a step that says it solves the entropic problem, not 'test-input-tuple'",
        ),
        (SinkhornStep, {"relaxation": 2.0}, "SinkhornStep.relaxation: found 2.0"),
        (SinkhornStep, {"relaxation": 0.9}, "SinkhornStep.relaxation: found 0.9"),
        (SinkhornStep, {"relaxation": float("nan")}, "SinkhornStep.relaxation: found nan"),
        (
            SaladConfig,
            {"dustbin": "row"},
            "SaladConfig.dustbin: found 'row', expected one of column, mass, none",
        ),
        (SaladConfig, {"epsilon": float("inf")}, "SaladConfig.epsilon: found inf"),
        (SaladConfig, {"row_tau": 0.0}, "SaladConfig.row_tau: found 0.0"),
        (SaladConfig, {"column_tau": 1.1}, "SaladConfig.column_tau: found 1.1"),
    ],
)
def test_bad_settings_raise(kind: type, fields: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as raised:
        kind(**fields)
    assert "\n" not in str(raised.value)


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


def test_a_part_and_its_name_are_one_configuration() -> None:
    assert SinkhornConfig(step="sinkhorn") == SinkhornConfig(step=SinkhornStep())
    assert hash(SinkhornConfig(step="sinkhorn")) == hash(SinkhornConfig())
    assert SinkhornConfig(step=SinkhornStep(1.5)) != SinkhornConfig()
    assert SinkhornConfig().step.part_name == "sinkhorn"
    # A part whose fields are alike is another part.
    assert SinkhornConfig("softmax") != SinkhornConfig("dual-softmax")


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


@pytest.mark.usefixtures("_unchecked")
@pytest.mark.parametrize(
    ("init", "words"),
    [
        (
            Potentials(jnp.zeros(5), jnp.zeros(3)),
            r"init.row .* \(5,\), expected \(6,\)",
        ),
        ((jnp.zeros(6), jnp.zeros(6)), r"init.column found of shape \(6,\), expected \(3,\)"),
    ],
)
def test_potentials_to_start_from_that_do_not_fit_are_refused(init, words):
    with pytest.raises(InputError, match=f"^sinkhorn: {words}"):
        solve(jnp.zeros((6, 3)), MU, NU, init=init)
