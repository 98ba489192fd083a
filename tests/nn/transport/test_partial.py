"""Partial transport against Python Optimal Transport's partial solvers."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import ot
import pytest

from crisalad_jax.sinkhorn import PartialDustbin, SinkhornConfig, assign_with_dustbin, solve
from crisalad_jax.utils.errors import InputError
from tests.nn.conftest import slow_unless
from tests.nn.transport.problems import assert_three_ways, implicit

ROWS, CLUSTERS = 12, 5
CONFIG = SinkhornConfig(step="partial", iterations=200)


class Inputs(NamedTuple):
    scores: Any
    log_mu: Any
    log_nu: Any


def inputs(share: float = 0.4, room: float = 2.0, std: float = 2.0, seed: int = 0) -> Inputs:
    """Uneven masses; clusters hold `room` times what moves."""
    generator = np.random.default_rng(seed)
    mu, nu = generator.uniform(0.5, 2, ROWS), generator.uniform(0.5, 3, CLUSTERS)
    nu *= room * share * mu.sum() / nu.sum()
    scores = np.append(std * generator.standard_normal((ROWS, CLUSTERS)), np.ones((ROWS, 1)), 1)
    log_nu = np.log(np.append(nu, (1 - share) * mu.sum()))
    return Inputs(*map(jnp.asarray, (scores, np.log(mu), log_nu)))


def masses(at: Inputs) -> tuple[np.ndarray, np.ndarray, float]:
    mu, nu = np.exp(at.log_mu), np.exp(at.log_nu)
    return mu, nu[:-1], float(mu.sum() - nu[-1])


def pot_plan(at: Inputs, epsilon: float) -> np.ndarray:
    mu, nu, moved = masses(at)
    limits = {"numItermax": 100000, "stopThr": 1e-14}
    costs = -np.asarray(at.scores)[:, :-1]
    most = min(moved, nu.sum())
    return np.asarray(
        ot.partial.entropic_partial_wasserstein(mu, nu, costs, epsilon, m=most, **limits)
    )


# Little and much mass; clusters of which none, some and all are full.
CASES = {"free": (0.2, 20.0), "some full": (0.4, 1.3), "all full": (0.6, 1.0), "much": (0.95, 1.5)}


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("domain", slow_unless({"scaling"}, ("scaling", "log")))
def test_plans_are_pots(domain: Any) -> None:
    """As a batch of problems; what patches keep is the rest of their mass."""
    each = [inputs(*case, seed=seed) for seed, case in enumerate(CASES.values())]
    config = SinkhornConfig(step="partial", iterations=2000, domain=domain)
    result = solve(*map(jnp.stack, zip(*each, strict=True)), epsilon=0.7, config=config)
    plans, kinds = np.exp(np.asarray(result.log_plan)), set()
    for at, plan in zip(each, plans, strict=True):
        mu, nu, moved = masses(at)
        # Both came to rest: rounding.
        np.testing.assert_allclose(plan[:, :-1], pot_plan(at, 0.7), atol=1e-10)
        np.testing.assert_allclose(plan.sum(axis=1), mu, rtol=1e-12)
        np.testing.assert_allclose(plan[:, :-1].sum(), moved, rtol=1e-12)
        full = int((plan.sum(axis=0)[:-1] > (1 - 1e-9) * nu).sum())
        kinds.add("none" if full == 0 else "all" if full == CLUSTERS else "some")
    assert kinds == {"none", "some", "all"}
    assert (result.column_error < 1e-10).all()
    assert (result.row_error < 1e-10).all()


@pytest.mark.usefixtures("float64")
def test_plan_nears_the_partial_linear_programme() -> None:
    at = inputs(0.5, 1.3)
    mu, nu, moved = masses(at)
    best = ot.partial.partial_wasserstein(mu, nu, -np.asarray(at.scores)[:, :-1], m=moved)
    config = implicit(step="partial", tolerance=1e-9, iterations=20000, gradient="stop")
    for epsilon in (0.5, 0.05, 0.01):
        result = solve(*at, epsilon=epsilon, config=config)
        assert result.converged
        plan = np.exp(np.asarray(result.log_plan))[:, :-1]
        lost = ((best - plan) * at.scores[:, :-1]).sum()
        # Entropy is worth no more than epsilon times its range.
        assert -1e-6 < lost < epsilon * moved * np.log(plan.size)


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("name", slow_unless({"some full"}, ("free", "some full")))
def test_gradients_three_ways(name: str) -> None:
    """By scores and masses, through the plan and through the mass that moves."""
    at = inputs(*CASES[name])
    weights = np.random.default_rng(3).standard_normal(at.scores.shape)

    def loss(at: Inputs, config: SinkhornConfig) -> Any:
        return (weights * jnp.exp(solve(*at, epsilon=0.7, config=config).log_plan)).sum()

    assert_three_ways(loss, at, "partial", count=200)


@pytest.mark.usefixtures("float64")
def test_a_learnt_share() -> None:
    scores = inputs().scores[:, :-1]
    dustbin = PartialDustbin(0.3, learn=True, room=1.5)
    logit = dustbin.init(jax.random.key(0), 8)
    assert logit is not None
    np.testing.assert_allclose(jax.nn.sigmoid(logit), 0.3, rtol=1e-6)  # float32

    def plan(logit: Any) -> Any:
        return jnp.exp(assign_with_dustbin(scores, logit, dustbin, config=CONFIG).log_plan)

    moved = plan(jnp.float64(0.2))[:, :-1].sum()
    np.testing.assert_allclose(moved, ROWS / (1 + np.exp(-0.2)), rtol=1e-9)  # at rest
    expected = pot_plan(
        Inputs(
            np.append(scores, np.zeros((ROWS, 1)), 1),
            np.zeros(ROWS),
            np.log([*[1.5 * float(moved) / CLUSTERS] * CLUSTERS, ROWS - float(moved)]),
        ),
        1.0,
    )
    np.testing.assert_allclose(plan(jnp.float64(0.2))[:, :-1], expected, atol=1e-9)  # at rest
    fixed = assign_with_dustbin(scores, None, PartialDustbin(0.3, room=1.5), config=CONFIG)
    np.testing.assert_allclose(np.exp(fixed.log_plan), plan(jnp.log(3 / 7)), atol=1e-12)


@pytest.mark.slow
@pytest.mark.usefixtures("float64")
def test_a_learnt_shares_gradient_three_ways() -> None:
    scores, dustbin = inputs().scores[:, :-1], PartialDustbin(0.3, learn=True, room=1.5)
    weights = np.random.default_rng(3).standard_normal((ROWS, CLUSTERS + 1))

    def loss(logit: Any, config: SinkhornConfig) -> Any:
        plan = jnp.exp(assign_with_dustbin(scores, logit, dustbin, config=config).log_plan)
        return (weights * plan).sum()

    assert_three_ways(loss, jnp.float64(0.2), "partial", count=200)


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("gradient", slow_unless({"unrolled"}, ("unrolled", "optimistix")))
def test_no_mass_is_the_problem_without(gradient: str) -> None:
    at = inputs(0.4, 1.3)
    at = at._replace(log_mu=at.log_mu.at[3].set(-jnp.inf), log_nu=at.log_nu.at[1].set(-jnp.inf))
    less = Inputs(
        jnp.delete(jnp.delete(at.scores, 3, axis=0), 1, axis=1),
        jnp.delete(at.log_mu, 3),
        jnp.delete(at.log_nu, 1),
    )
    weights = jnp.asarray(np.random.default_rng(3).standard_normal(at.scores.shape))
    config = CONFIG
    if gradient == "optimistix":
        config = implicit(step="partial", tolerance=1e-12, iterations=500, gradient=gradient)

    def of(at: Inputs, weights: Any) -> Any:
        result = solve(*at, config=config)
        return (weights * jnp.exp(result.log_plan)).sum(), result

    both = jax.jit(jax.grad(of, has_aux=True))
    found, result = both(at, weights)
    expected, wanted = both(less, jnp.delete(jnp.delete(weights, 3, axis=0), 1, axis=1))
    plan = jnp.exp(result.log_plan)
    assert not plan[3].any()
    assert not plan[:, 1].any()
    assert not found.scores[3].any()
    assert all(np.isfinite(x).all() for x in (*found, result.log_plan))
    # At rest to 1e-12, in another order of sums.
    close: dict[str, Any] = {"rtol": 1e-8, "atol": 1e-9}
    kept = jnp.delete(jnp.delete(plan, 3, axis=0), 1, axis=1)
    np.testing.assert_allclose(kept, jnp.exp(wanted.log_plan), **close)
    slope = jnp.delete(jnp.delete(found.scores, 3, axis=0), 1, axis=1)
    np.testing.assert_allclose(slope, expected.scores, **close)
    np.testing.assert_allclose(jnp.delete(found.log_mu, 3), expected.log_mu, **close)


def test_float32_is_finite_for_any_scores() -> None:
    """Few patches and many, flat and sharp scores; with half-precision scores the same."""
    scores = jax.random.normal(jax.random.key(0), (4, 20, 5))
    scores = scores * jnp.array([0.0, 1.0, 100.0, 1e4])[:, None, None]

    @jax.jit
    def of(scores: Any, logit: Any) -> Any:
        config = SinkhornConfig(step="partial", iterations=5)
        dustbin = PartialDustbin(learn=True)
        result = assign_with_dustbin(scores, logit, dustbin, config=config)
        return jnp.sin(jnp.exp(result.log_plan)).sum() + 1e-3 * result.log_plan[..., 0].sum(), (
            result
        )

    slopes, result = jax.grad(of, argnums=(0, 1), has_aux=True)(scores, jnp.float32(-1))
    assert all(np.isfinite(x).all() for x in (*slopes, *result[:1]))
    # Patches give at most what they have, to float32's rounding of logarithms of 1e4.
    np.testing.assert_allclose(jnp.exp(result.log_plan).sum(axis=-1), 1, rtol=2e-3)
    half = scores[1].astype(jnp.bfloat16)
    (_, narrow), (_, wide) = of(half, -1.0), of(half.astype(jnp.float32), -1.0)
    assert narrow.log_plan.dtype == jnp.float32
    np.testing.assert_array_equal(narrow.log_plan, wide.log_plan)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"share": 1.0}, "share: found 1.0, expected more than 0 and less than 1"),
        ({"room": 0.5}, "room: found 0.5, expected at least 1"),
    ],
)
def test_bad_settings_raise(fields: Any, message: str) -> None:
    with pytest.raises(InputError, match=f"^PartialDustbin.{message}$"):
        PartialDustbin(**fields)


def test_a_step_without_capacities_is_refused() -> None:
    words = "dustbin partial: found step sinkhorn, expected one with capacities, such as partial"
    with pytest.raises(InputError, match=words):
        assign_with_dustbin(jnp.zeros((6, 3)), None, "partial")


def test_bad_parameters_raise() -> None:
    with pytest.raises(InputError, match=r"^dustbin: found parameters of shape \(3,\), expected"):
        assign_with_dustbin(jnp.zeros((6, 3)), jnp.zeros(3), "partial", config=CONFIG)
