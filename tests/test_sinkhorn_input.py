"""What `sinkhorn`, `assign` and `SinkhornConfig` refuse, and what they say."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jaxtyping
import optimistix
import pytest

from crisalad_jax.config import SinkhornConfig
from crisalad_jax.errors import InputError
from crisalad_jax.sinkhorn import (
    append_dustbin,
    assign,
    sinkhorn,
    sinkhorn_step,
)


def implicit(**fields: Any) -> SinkhornConfig:
    return SinkhornConfig(gradient="implicit", tolerance=1e-5, **fields)


@pytest.fixture
def _unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """As users run it: the shapes in annotations are checked in tests alone."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


MU, NU = jnp.zeros(6), jnp.log(jnp.array([1.0, 2.0, 3.0]))
BAD_CALLS: dict[str, tuple[Callable[[], Any], str]] = {
    "one axis": (lambda: sinkhorn(jnp.zeros(3), MU, NU), r"scores of shape \(3,\) and log_mu"),
    "rows": (lambda: sinkhorn(jnp.zeros((5, 3)), MU, NU), r"\(5, 3\) and log_mu of \(6,\)"),
    "columns": (lambda: sinkhorn(jnp.zeros((6, 4)), MU, NU), r"\(6, 4\) and log_nu of \(3,\)"),
    "no axis": (lambda: sinkhorn(jnp.zeros((6, 3)), MU, MU[0]), r"log_nu of \(\)"),
    "batches": (
        lambda: sinkhorn(jnp.zeros((2, 6, 3)), jnp.zeros((3, 6)), NU),
        r"\(2, 6, 3\) and log_mu of \(3, 6\)",
    ),
    "more axes": (
        lambda: sinkhorn(jnp.zeros((6, 3)), MU, jnp.zeros((2, 3))),
        r"\(6, 3\) and log_nu of \(2, 3\)",
    ),
    "epsilons": (
        lambda: sinkhorn(jnp.zeros((6, 3)), MU, NU, epsilon=jnp.ones(3)),
        r"epsilon found of shape \(3,\), expected a single number",
    ),
    "own step, implicit": (
        lambda: sinkhorn(jnp.zeros((6, 3)), MU, NU, config=implicit(), step=sinkhorn_step),
        "a step beside method 'sinkhorn' and gradient 'implicit'",
    ),
    "own step, newton": (
        lambda: sinkhorn(
            jnp.zeros((6, 3)),
            MU,
            NU,
            config=SinkhornConfig(method="newton", gradient="stop"),
            step=sinkhorn_step,
        ),
        "a step beside method 'newton'",
    ),
    "own step, relaxation": (
        lambda: sinkhorn(
            jnp.zeros((6, 3)), MU, NU, config=SinkhornConfig(relaxation=1.5), step=sinkhorn_step
        ),
        "a step beside relaxation 1.5",
    ),
    "solver": (
        lambda: sinkhorn(
            jnp.zeros((6, 3)), MU, NU, solver=optimistix.FixedPointIteration(rtol=0, atol=1)
        ),
        "a solver beside gradient 'unrolled', expected 'optimistix'",
    ),
    "no clusters": (
        lambda: assign(jnp.zeros((6, 0)), 1.0),
        r"assign: found scores of shape \(6, 0",
    ),
    "no columns": (
        lambda: sinkhorn(jnp.zeros((6, 0)), MU, MU[:0]),
        r"of shape \(6, 0\) and log_mu",
    ),
    "complex": (
        lambda: sinkhorn(jnp.zeros((6, 3), complex), MU, NU),
        "scores found of complex64, expected real numbers",
    ),
    "a step's tuple": (
        lambda: sinkhorn(jnp.zeros((6, 3)), MU, NU, step=lambda _, at: tuple(at)),
        "step found to return",
    ),
    "a step's shapes": (
        lambda: sinkhorn(jnp.zeros((6, 3)), MU, NU, step=lambda _, at: at._replace(row=at.row[:2])),
        r"step found to return Potentials\(row=.*shape=\(2,\)",
    ),
    "appended": (
        lambda: append_dustbin(jnp.zeros((6, 3)), jnp.ones(5)),
        r"dustbin: found shape \(5,\), expected \(\) or \(6,\)",
    ),
    "assign": (lambda: assign(jnp.zeros(6), jnp.float32(1)), r"assign: found scores of shape \(6,"),
    "no mass": (lambda: assign(jnp.zeros((6, 6)), jnp.float32(1)), "6 patches for 6 clusters"),
    "less mass": (lambda: assign(jnp.zeros((4, 6)), jnp.float32(1)), "4 patches for 6 clusters"),
    "token, one": (
        lambda: assign(jnp.zeros((6, 3)), jnp.float32(1), SinkhornConfig(dustbin="token")),
        r"dustbin: found shape \(\), expected \(6,\) for 'token'",
    ),
    "column, many": (
        lambda: assign(jnp.zeros((6, 3)), jnp.ones(6)),
        r"dustbin: found shape \(6,\), expected \(\) for 'column'",
    ),
    "mass, none": (
        lambda: assign(jnp.zeros((6, 3)), None, SinkhornConfig(dustbin="mass")),
        r"dustbin: found shape None, expected \(\) for 'mass'",
    ),
    "none, one": (
        lambda: assign(jnp.zeros((6, 3)), jnp.float32(1), SinkhornConfig(dustbin="none")),
        r"dustbin: found shape \(\), expected None for 'none'",
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
        (0.0, MU.at[1].set(-jnp.inf), NU, 1.0, "log_mu found with NaN or infinity"),
        (0.0, MU, NU.at[1].set(jnp.nan), 1.0, "log_nu found with NaN or infinity"),
        (0.0, MU, NU, 0.0, "epsilon found 0.0, expected more than 0"),
        (0.0, MU, NU, -1.0, "epsilon found -1.0, expected more than 0"),
        (0.0, MU, NU, jnp.float32(jnp.nan), "epsilon found nan, expected more than 0"),
        (1.0, MU, NU, 1e-40, r"up to 1\.0e\+40, expected numbers that float32 can hold"),
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
        sinkhorn(full, log_mu, log_nu, epsilon=epsilon)
    assert "\n" not in str(raised.value)
    known = jnp.isfinite(scores)
    if known and epsilon == 1:  # and where they are known while the scores are traced
        with pytest.raises(InputError, match=message):
            jax.jit(lambda scores: sinkhorn(scores, log_mu, log_nu))(full)


def test_totals_need_not_agree_to_the_last_digits() -> None:
    """Sums of logarithms in float32 do not."""
    assert sinkhorn(jnp.zeros((6, 3)), MU, NU + 1e-5).converged


def test_totals_need_not_agree_where_marginals_are_relaxed() -> None:
    config = SinkhornConfig(column_tau=0.5)
    assert sinkhorn(jnp.zeros((6, 3)), MU, NU + 1, config=config).converged


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"method": "simplex"}, "SinkhornConfig.method: found 'simplex'"),
        ({"dustbin": "row"}, "SinkhornConfig.dustbin: found 'row'"),
        ({"domain": "kernel"}, "SinkhornConfig.domain: found 'kernel'"),
        ({"gradient": "exact"}, "SinkhornConfig.gradient: found 'exact'"),
        ({"iterations": 0}, "SinkhornConfig.iterations: found 0"),
        ({"iterations": 2.5}, "SinkhornConfig.iterations: found 2.5, expected a whole number"),
        ({"epsilon": 0.0}, "SinkhornConfig.epsilon: found 0.0"),
        ({"epsilon": float("nan")}, "SinkhornConfig.epsilon: found nan"),
        ({"epsilon": float("inf")}, "SinkhornConfig.epsilon: found inf"),
        ({"tolerance": 0.0, "gradient": "stop"}, "SinkhornConfig.tolerance: found 0.0"),
        ({"row_tau": 0.0}, "SinkhornConfig.row_tau: found 0.0"),
        ({"column_tau": 1.1}, "SinkhornConfig.column_tau: found 1.1"),
        ({"relaxation": 2.0}, "SinkhornConfig.relaxation: found 2.0"),
        ({"relaxation": 0.9}, "SinkhornConfig.relaxation: found 0.9"),
        ({"anderson": 1}, "SinkhornConfig.anderson: found 1"),
        ({"anderson": 2.5}, "SinkhornConfig.anderson: found 2.5"),
        ({"anderson": -2}, "SinkhornConfig.anderson: found -2"),
        ({"gradient": "implicit"}, "found 'implicit' with a fixed number of iterations"),
        ({"gradient": "optimistix"}, "found 'optimistix' with a fixed number of iterations"),
        ({"tolerance": 1e-3}, "found 'unrolled' with a tolerance"),
        ({"must_converge": True}, "must_converge: found no tolerance"),
        ({"method": "newton"}, "method: found 'newton' with relaxation"),
        (
            {"method": "newton", "gradient": "stop", "relaxation": 1.5},
            "method: found 'newton' with relaxation",
        ),
        (
            {"method": "newton", "gradient": "stop", "row_tau": 0.5},
            "method: found 'newton' with relaxation",
        ),
        (
            {"method": "newton", "gradient": "optimistix", "tolerance": 1e-3},
            "gradient 'optimistix', expected none of these",
        ),
        ({"method": "softmax", "anderson": 3}, "method: found 'softmax' with relaxation"),
        (
            {"method": "dual-softmax", "gradient": "stop", "tolerance": 1e-3},
            "found 'dual-softmax' with .* or gradient 'stop', expected none of these",
        ),
        (
            {"gradient": "optimistix", "tolerance": 1e-3, "anderson": 3},
            "anderson: found with gradient 'optimistix'",
        ),
    ],
)
def test_bad_settings_raise(fields: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as raised:
        SinkhornConfig(**fields)
    assert "\n" not in str(raised.value)
