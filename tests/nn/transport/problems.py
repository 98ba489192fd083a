"""How the tests solve transport problems, and Python Optimal Transport's plans of the same."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np
import ot
from jax.flatten_util import ravel_pytree

from crisalad_jax.sinkhorn import SinkhornConfig


def implicit(**fields: Any) -> SinkhornConfig:
    """To a tolerance that float32 can be asked for, with the gradient of the solution."""
    standard: dict[str, Any] = {"gradient": "implicit", "tolerance": 1e-5, "iterations": 300}
    return SinkhornConfig(**standard | fields)


class Way(NamedTuple):
    """How a problem is solved, and which of its marginals are relaxed."""

    config: SinkhornConfig
    taus: Mapping[str, float] = MappingProxyType({})
    solver: Any = None


def relaxed(row_tau: float = 1.0, column_tau: float = 1.0) -> dict[str, float]:
    return {"row_tau": row_tau, "column_tau": column_tau}


def pot_plan(
    scores: Any, log_mu: Any, log_nu: Any, epsilon: float, row_tau: float, column_tau: float
) -> np.ndarray:
    """The plan of the library POT, whose marginals are penalised where a tau is below 1."""
    problem = np.exp(log_mu), np.exp(log_nu), -np.asarray(scores), epsilon
    if row_tau == column_tau == 1:
        return np.asarray(ot.sinkhorn(*problem, stopThr=1e-13, numItermax=20000))
    penalties = tuple(
        epsilon * tau / (1 - tau) if tau < 1 else np.inf for tau in (row_tau, column_tau)
    )
    # "entropy": that of the plan by itself, as here, not against mu nu^T.
    kind = {"reg_type": "entropy", "c": np.ones(np.shape(scores))}
    limits = {"stopThr": 1e-14, "numItermax": 20000}
    return np.asarray(ot.unbalanced.sinkhorn_unbalanced(*problem, penalties, **kind, **limits))


def assert_three_ways(
    loss: Callable[[Any, SinkhornConfig], Any],
    at: Any,
    step: Any,
    *,
    count: int = 1000,
    gradient: str = "optimistix",
) -> None:
    """Gradients of a converged plan: unrolled, by a fixed point's conditions, by differences.

    In float64. The conditions are those of the step's own fixed point, or the closed form.
    """
    unrolled = SinkhornConfig(step=step, iterations=count)
    converged = implicit(step=step, iterations=count, tolerance=1e-12, gradient=gradient)
    gradients = [
        ravel_pytree(jax.jit(jax.grad(lambda x, c=config: loss(x, c)))(at))[0]
        for config in (unrolled, converged)
    ]
    assert np.abs(gradients[0]).max() > 0.01
    # What is left of 1e-12 in systems of condition number 1e3 or so.
    np.testing.assert_allclose(gradients[1], gradients[0], rtol=1e-7, atol=1e-8)
    flat, back = ravel_pytree(at)
    value, by = jax.jit(lambda x: loss(back(x), unrolled)), 1e-5
    for direction in np.random.default_rng(9).standard_normal((3, flat.size)):
        slope = (value(flat + by * direction) - value(flat - by * direction)) / (2 * by)
        # Third derivatives of order 10 to 1e3 times 1e-10; rounding of 1e-15 over 1e-5.
        np.testing.assert_allclose(gradients[0] @ direction, slope, rtol=1e-6, atol=1e-7)
