"""How the tests solve transport problems, and Python Optimal Transport's plans of the same."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import ot

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
        return ot.sinkhorn(*problem, stopThr=1e-13, numItermax=20000)
    penalties = tuple(
        epsilon * tau / (1 - tau) if tau < 1 else np.inf for tau in (row_tau, column_tau)
    )
    # "entropy": that of the plan by itself, as here, not against mu nu^T.
    kind = {"reg_type": "entropy", "c": np.ones(np.shape(scores))}
    limits = {"stopThr": 1e-14, "numItermax": 20000}
    return ot.unbalanced.sinkhorn_unbalanced(*problem, penalties, **kind, **limits)
