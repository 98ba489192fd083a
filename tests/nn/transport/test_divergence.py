"""The Sinkhorn divergence against ott-jax, linear programming and differences, in float64."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import ot
import pytest
from ott.geometry.pointcloud import PointCloud
from ott.tools.sinkhorn_divergence import sinkhorn_divergence as ott_divergence

from crisalad_jax.sinkhorn import SinkhornConfig, sinkhorn_divergence
from crisalad_jax.utils.errors import InputError

REST = SinkhornConfig(tolerance=1e-11, iterations=20000, gradient="stop")


def sets(seed: int = 0) -> tuple[Any, ...]:
    generator = np.random.default_rng(seed)
    x, y = generator.standard_normal((7, 3)), generator.standard_normal((9, 3)) + 0.5
    masses = (generator.uniform(0.5, 2, size) for size in (7, 9))
    return tuple(map(jnp.asarray, (x, y, *(np.log(m / m.sum()) for m in masses))))


def ours(x: Any, y: Any, log_mu: Any, log_nu: Any, epsilon: Any = 0.5) -> Any:
    options = {"epsilon": epsilon, "config": REST}
    return sinkhorn_divergence(x, y, log_mu=log_mu, log_nu=log_nu, **options)


@pytest.mark.usefixtures("float64")
def test_values_and_gradients_are_otts() -> None:
    """And the gradient by tokens, masses and epsilon that of differences."""
    at = sets()

    def theirs(x: Any) -> Any:
        limits = {"threshold": 1e-11, "max_iterations": 20000, "inner_iterations": 1}
        masses = {"a": jnp.exp(at[2]), "b": jnp.exp(at[3]), "scale_cost": 1.0}
        return ott_divergence(PointCloud, x, at[1], epsilon=0.5, solve_kwargs=limits, **masses)[0]

    value, gradient = jax.jit(jax.value_and_grad(ours, argnums=(0, 1, 2, 3, 4)))(*at, 0.5)
    expected, by_x = jax.jit(jax.value_and_grad(theirs))(at[0])
    # Both came to rest.
    np.testing.assert_allclose(value, expected, rtol=1e-8)
    np.testing.assert_allclose(gradient[0], by_x, atol=1e-7)
    point, value_at, generator = (*at, jnp.float64(0.5)), jax.jit(ours), np.random.default_rng(1)
    for i, slope in enumerate(gradient):
        towards = 1e-5 * generator.standard_normal(np.shape(point[i]))
        pair = [
            value_at(*point[:i], point[i] + sign * towards, *point[i + 1 :]) for sign in (1, -1)
        ]
        # Relative to 1e-5: third derivatives of order 10 times 1e-10, and 1e-11 not at rest.
        np.testing.assert_allclose((slope * towards).sum(), (pair[0] - pair[1]) / 2, atol=1e-10)


@pytest.mark.usefixtures("float64")
def test_it_nears_the_linear_programme_as_epsilon_falls() -> None:
    x, y, log_mu, log_nu = sets()
    costs: Any = ot.dist(np.asarray(x), np.asarray(y))
    exact: Any = ot.emd2(np.exp(log_mu), np.exp(log_nu), costs)
    errors = [abs(float(ours(*sets(), epsilon=epsilon)) - exact) for epsilon in (2.0, 0.2)]
    assert errors[1] < 0.05 * exact
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.slow
@pytest.mark.usefixtures("float64")
def test_batches_symmetry_zero_masses_and_equal_sets() -> None:
    each = [sets(seed) for seed in range(3)]
    x, y, log_mu, log_nu = (jnp.stack(part) for part in zip(*each, strict=True))
    epsilon = jnp.array([0.3, 0.5, 1.0])
    found = ours(x, y, log_mu, log_nu, epsilon)
    alone = [ours(*at, epsilon=epsilon[i]) for i, at in enumerate(each)]
    # Rest.
    np.testing.assert_allclose(found, alone, rtol=1e-8)
    np.testing.assert_allclose(ours(y, x, log_nu, log_mu, epsilon), found, rtol=1e-8)
    assert (found > 0.01).all()
    np.testing.assert_allclose(ours(x, x, log_mu, log_mu, epsilon), 0, atol=1e-9)
    gone = log_mu[0].at[2].set(-jnp.inf)
    less = jnp.delete(x[0], 2, axis=0), y[0], jnp.delete(log_mu[0], 2), log_nu[0]
    slope = jax.grad(ours)(x[0], y[0], gone, log_nu[0])
    np.testing.assert_allclose(ours(x[0], y[0], gone, log_nu[0]), ours(*less), rtol=1e-8)
    np.testing.assert_allclose(jnp.delete(slope, 2, axis=0), jax.grad(ours)(*less), atol=1e-8)
    np.testing.assert_array_equal(slope[2], 0)


@pytest.mark.slow
def test_half_precision_is_widened_and_default_masses_are_equal() -> None:
    x, y = (each.astype(jnp.bfloat16) for each in sets()[:2])
    found = sinkhorn_divergence(x, y)
    assert found.dtype == jnp.float32
    zeros = jnp.zeros(7), jnp.zeros(9)
    wide = [each.astype(jnp.float32) for each in (x, y)]
    expected = sinkhorn_divergence(*wide, log_mu=zeros[0], log_nu=zeros[1])
    np.testing.assert_allclose(found, expected, rtol=1e-5)  # rounding


@pytest.mark.usefixtures("_unchecked")
@pytest.mark.parametrize("shape", [(9, 4), (2, 9, 3), (3,)])
def test_sets_that_do_not_fit_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match=r"^sinkhorn_divergence: found tokens of shapes \(7, 3\)"):
        sinkhorn_divergence(jnp.zeros((7, 3)), jnp.zeros(shape))
