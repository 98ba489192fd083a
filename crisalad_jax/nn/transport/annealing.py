"""Sinkhorn's iteration with a falling epsilon (Schmitzer, SIAM J. Sci. Comput. 2019)."""

import math
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from crisalad_jax.config.checks import PositiveInt, require_field
from crisalad_jax.nn.transport.problem import Potentials, Problem
from crisalad_jax.nn.transport.steps import STEPS, Moved, Step, check_balanced, tempered


@STEPS.register("annealing")
class AnnealingStep(Step):
    """Sinkhorn's step at `start` times epsilon first, and at epsilon after `cooling` iterations.

    In between, epsilon falls by the same factor each time. Problems must be balanced (both taus 1).
    Epsilon depends on the number of the iteration: it also starts high after a warm start, and
    never falls with the gradient "optimistix", whose iterations all have number 0.
    """

    entropic: ClassVar[bool] = True
    start: float = 8.0
    """Multiple of epsilon in the first iteration, at least 1."""
    cooling: PositiveInt = 3
    """Number of iterations until epsilon is reached; give the solver at least one more."""

    def __post_init__(self) -> None:
        """Check the range."""
        require_field(self, "start", 1 <= self.start < math.inf, "at least 1")

    def step(self, problem: Problem, potentials: Potentials, state: Any, iteration: Array) -> Moved:
        """Take both half steps at the larger epsilon of this iteration.

        Raises:
            InputError: `row_tau` or `column_tau` is below 1.
        """
        check_balanced(problem, "annealing")  # the meaning of tau changes with epsilon
        left = jnp.maximum(1 - iteration / self.cooling, 0)
        times = jnp.asarray(self.start**left, problem.log_mu.dtype)
        smooth = tempered(problem, jnp.broadcast_to(times, problem.log_mu.shape[:-1]))
        column = times * (problem.log_nu - smooth.lse_rows(potentials.row / times))
        row = times * (problem.log_mu - smooth.lse_columns(column / times))
        return Potentials(row, column), state

    def finish(self, problem: Problem, potentials: Potentials) -> Potentials:
        """Meet the rows' marginals at epsilon itself, whatever the last iteration's epsilon was."""
        return potentials._replace(row=problem.log_mu - problem.lse_columns(potentials.column))
