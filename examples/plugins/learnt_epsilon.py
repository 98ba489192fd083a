"""Sinkhorn with a learnt entropic regularisation: a step that changes the problem.

crisalad train ... --plugin examples/plugins/learnt_epsilon.py
    --model.aggregator.sinkhorn.step learnt-epsilon
"""

import dataclasses

import jax.numpy as jnp

import crisalad_jax as cj


@cj.register_step("learnt-epsilon")
@dataclasses.dataclass(frozen=True)
class LearntEpsilon(cj.sinkhorn.SinkhornStep):
    """Sinkhorn's step on scores over exp(log_epsilon)."""

    start: float = 1.0

    def init_params(self, key):
        """Return the logarithm, so that epsilon stays above 0."""
        return {"log_epsilon": jnp.log(jnp.full((), self.start))}

    def prepare(self, problem, params):
        """Divide the scores before solving, so that every gradient includes it."""
        kernel = problem.kernel / jnp.exp(params["log_epsilon"])
        return cj.sinkhorn.Problem.of(
            kernel, problem.log_mu, problem.log_nu, problem.row_tau, problem.column_tau
        )
