"""Sinkhorn whose epsilon falls from iteration to iteration: a step that asks for the number.

crisalad train ... --plugin examples/plugins/annealing.py
    --model.aggregator.sinkhorn.step annealing
"""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp

import crisalad_jax as cj


@cj.register_step("annealing")
@dataclasses.dataclass(frozen=True)
class Annealing(cj.sinkhorn.Step):
    """Begin at `start` times epsilon, and be at epsilon itself after so many iterations."""

    entropic: ClassVar[bool] = True
    start: float = 8.0
    iterations: int = 3

    def step(self, problem, potentials, state, iteration):
        """Take Sinkhorn's step of a smoother problem; potentials stay over the last epsilon."""
        if not problem.balanced:  # what tau stands for changes with epsilon
            raise cj.InputError("step annealing: found a tau below 1, expected 1")
        left = jnp.maximum(1 - iteration / self.iterations, 0)
        times = jnp.asarray(self.start**left, problem.kernel.dtype)
        smooth = cj.sinkhorn.Problem.of(problem.kernel / times, problem.log_mu, problem.log_nu)
        column = times * (problem.log_nu - smooth.lse_rows(potentials.row / times))
        row = times * (problem.log_mu - smooth.lse_columns(column / times))
        return cj.sinkhorn.Potentials(row, column), state

    def finish(self, problem, potentials):
        """Meet the rows' marginals at epsilon itself, wherever the schedule was left."""
        row = problem.log_mu - problem.lse_columns(potentials.column)
        return potentials._replace(row=row)
