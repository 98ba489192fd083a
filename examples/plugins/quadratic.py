"""Quadratic transport (Blondel et al., AISTATS 2018): a step with a plan of its own, a sparse one.

crisalad train ... --plugin examples/plugins/quadratic.py
    --model.aggregator.sinkhorn.step quadratic
"""

import dataclasses

import jax.numpy as jnp

import crisalad_jax as cj


def offset(scores, mass):
    """Return what to add to each row so that its positive parts sum to its mass: sparsemax."""
    falling = -jnp.sort(-scores, axis=-1)
    beyond = jnp.cumsum(falling, axis=-1) - mass[..., None]
    support = (falling * jnp.arange(1, 1 + scores.shape[-1]) > beyond).sum(axis=-1, keepdims=True)
    return -(jnp.take_along_axis(beyond, support - 1, axis=-1) / support)[..., 0]


@cj.register_step("quadratic")
@dataclasses.dataclass(frozen=True)
class Quadratic(cj.sinkhorn.Step):
    """Maximise <plan, scores> - |plan|^2 / 2, for balanced marginals."""

    def step(self, problem, potentials, state, iteration):
        """Meet the columns' marginals, then the rows', as Sinkhorn does."""
        if not problem.balanced:
            raise cj.InputError("step quadratic: found a tau below 1, expected 1")
        over = problem.kernel + potentials.row[..., None]
        column = offset(over.swapaxes(-1, -2), jnp.exp(problem.log_nu))
        row = offset(problem.kernel + column[..., None, :], jnp.exp(problem.log_mu))
        return cj.sinkhorn.Potentials(row, column), state

    def log_plan(self, problem, potentials):
        """Take the positive part; its logarithm is minus infinity, without a gradient, at 0."""
        plan = problem.log_plan(potentials)  # kernel + row + column
        return jnp.where(plan > 0, jnp.log(jnp.where(plan > 0, plan, 1)), -jnp.inf)
