"""Numbers that problems of a batch have for themselves, or learn: epsilon and both taus."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.backbones.base import Features
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.sinkhorn import SinkhornConfig, SinkhornStep, solve
from crisalad_jax.utils.errors import InputError
from tests.nn.conftest import slow_unless
from tests.nn.transport.problems import assert_three_ways, implicit, pot_plan

ROWS, COLUMNS = 10, 4
EPSILON, TAUS = np.array([0.5, 0.8, 2.0]), (np.array([0.9, 0.6, 0.8]), np.array([0.7, 0.95, 0.5]))


def inputs() -> tuple[Any, Any, Any]:
    generator = np.random.default_rng(0)
    scores = 2 * generator.standard_normal((3, ROWS, COLUMNS))
    mu, nu = generator.uniform(0.5, 2, ROWS), generator.uniform(0.5, 3, COLUMNS)
    return tuple(map(jnp.asarray, (scores, np.log(mu), np.log(nu * mu.sum() / nu.sum()))))


WAYS: dict[str, SinkhornConfig] = {
    "implicit": implicit(tolerance=1e-12, iterations=2000),
    "log": implicit(tolerance=1e-12, iterations=2000, domain="log"),
    "optimistix": implicit(tolerance=1e-12, iterations=2000, gradient="optimistix"),
    "relaxation": implicit(tolerance=1e-12, iterations=2000, step=SinkhornStep(1.3)),
}


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("name", slow_unless({"implicit"}, WAYS))
def test_each_problem_has_its_own(name: str) -> None:
    """POT's plans of every problem by itself; and balanced ones, of each epsilon."""
    scores, log_mu, log_nu = inputs()
    epsilon, rows, columns = map(jnp.asarray, (EPSILON, *TAUS))
    options: dict[str, Any] = {"epsilon": epsilon, "config": WAYS[name]}
    found = solve(scores, log_mu, log_nu, row_tau=rows, column_tau=columns, **options)
    balanced = solve(scores, log_mu, log_nu, **options)
    for result in (found, balanced):
        assert result.converged.all()
    for i in range(3):
        taus = float(rows[i]), float(columns[i])
        # Relative: what POT stops at is relative to its largest scaling.
        expected = pot_plan(scores[i], log_mu, log_nu, float(epsilon[i]), *taus)
        np.testing.assert_allclose(np.exp(found.log_plan[i]), expected, rtol=1e-8)
        expected = pot_plan(scores[i], log_mu, log_nu, float(epsilon[i]), 1, 1)
        np.testing.assert_allclose(np.exp(balanced.log_plan[i]), expected, rtol=1e-8)


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("each", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_gradients_three_ways(each: bool) -> None:
    """By epsilon and both taus, of each problem or of all."""
    scores, log_mu, log_nu = inputs()
    weights = np.random.default_rng(3).standard_normal(scores.shape)

    def loss(at: Any, config: SinkhornConfig) -> Any:
        epsilon, rows, columns = at
        result = solve(
            scores, log_mu, log_nu, epsilon=epsilon, row_tau=rows, column_tau=columns, config=config
        )
        return (weights * jnp.exp(result.log_plan)).sum() + jnp.sin(result.potentials.row).sum()

    at = tuple(jnp.asarray(x if each else x[0]) for x in (EPSILON, *TAUS))
    assert_three_ways(loss, at, "sinkhorn", count=300, gradient="implicit")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"epsilon": jnp.ones(2)}, r"epsilon found of shape \(2,\), expected \(3,\)"),
        ({"epsilon": jnp.array([1.0, 0.0, 1.0])}, r"epsilon found \[1. 0. 1.\], expected at least"),
        ({"row_tau": jnp.ones((3, 1))}, r"row_tau found of shape \(3, 1\), expected \(3,\)"),
        ({"column_tau": jnp.array([0.5, 0.5, 1.5])}, r"column_tau found \[0.5 0.5 1.5\], expected"),
    ],
)
@pytest.mark.usefixtures("_unchecked")
def test_bad_numbers_raise(options: Any, message: str) -> None:
    zeros = jnp.zeros(4)
    with pytest.raises(InputError, match=f"^sinkhorn: {message}") as raised:
        solve(jnp.zeros((3, 4, 4)), zeros, zeros, **options)
    assert "\n" not in str(raised.value)


@pytest.mark.slow
def test_salad_learns_its_taus() -> None:
    """From the ones that are below 1; the plan is that of fixed ones, and has a gradient."""
    fields: dict[str, Any] = {"clusters": 3, "cluster_dim": 4, "token_dim": 4, "hidden": 8}
    fixed = SaladConfig(column_tau=0.7, **fields)
    learning = SaladConfig(column_tau=0.7, learn_tau=True, **fields)
    params = learning.init(jax.random.key(0), ViTConfig(dim=12), (3, 3))
    assert params.logit_tau is not None
    ((name, logit),) = params.logit_tau.items()
    assert name == "column_tau"
    np.testing.assert_allclose(jax.nn.sigmoid(logit), 0.7, rtol=1e-6)  # float32
    features = Features(jnp.ones((2, 12)), jax.random.normal(jax.random.key(1), (2, 9, 12)))
    plain = fixed.init(jax.random.key(0), ViTConfig(dim=12), (3, 3))
    # Another order of products in float32.
    np.testing.assert_allclose(
        learning.plan(params, features), fixed.plan(plain, features), rtol=1e-4
    )
    slope = jax.grad(lambda x: (learning.plan(x, features) ** 2).sum())(params)
    assert abs(slope.logit_tau["column_tau"]) > 1e-3
    with pytest.raises(InputError, match=r"^SaladConfig.learn_tau: found True, expected a row_tau"):
        SaladConfig(learn_tau=True)
