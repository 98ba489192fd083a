"""Sparse plans: quadratic transport, or the k largest entries of each row of an entropic plan."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from crisalad_jax.config.checks import PositiveInt
from crisalad_jax.nn.transport.problem import EMPTY, Matrix, Potentials, Problem, Rows
from crisalad_jax.nn.transport.steps import STEPS, Moved, SinkhornStep, Step, check_balanced


@STEPS.register("quadratic")
class QuadraticStep(Step):
    """Quadratic transport: maximise <P, S> - epsilon / 2 * |P|^2 (Blondel et al., AISTATS 2018).

    The plan P is sparse: the positive part of S / epsilon + row + column, for scores S. Each half
    step projects onto simplices, to meet the marginals of one side exactly. Both taus must be 1.

    Example:
        >>> from crisalad_jax.sinkhorn import SinkhornConfig, solve
        >>> config, zeros = SinkhornConfig(step="quadratic"), jnp.zeros(2)
        >>> jnp.exp(solve(2 * jnp.eye(2), zeros, zeros, config=config).log_plan).tolist()
        [[1.0, 0.0], [0.0, 1.0]]
    """

    def step(self, problem: Problem, potentials: Potentials, state: Any, iteration: Array) -> Moved:
        """Meet the columns' marginals, then the rows'.

        Raises:
            InputError: `row_tau` or `column_tau` is below 1.
        """
        check_balanced(problem, "quadratic")
        over = problem.kernel + potentials.row[..., None]
        column = simplex_offset(over.swapaxes(-1, -2), jnp.exp(problem.log_nu))
        over = (
            problem.kernel + problem.masked(Potentials(potentials.row, column)).column[..., None, :]
        )
        return Potentials(simplex_offset(over, jnp.exp(problem.log_mu)), column), state

    def log_plan(self, problem: Problem, potentials: Potentials) -> Matrix:
        """Return the logarithm of the plan; for an entry of 0, `EMPTY` without a gradient."""
        plan = problem.log_plan(potentials)  # kernel + row + column
        return jnp.where(plan > 0, jnp.log(jnp.where(plan > 0, plan, 1)), EMPTY)


def simplex_offset(scores: Matrix, mass: Rows) -> Rows:
    """Return the number to add to each row so that its positive entries sum to the row's mass.

    The positive part is then the projection of the row onto the simplex of this mass, sparsemax
    (Martins and Astudillo, ICML 2016).

    Args:
        scores: rows of numbers.
        mass: the required sum of each row.

    Example:
        >>> simplex_offset(jnp.array([[1.0, 0.5, -3.0]]), jnp.ones(1)).tolist()
        [-0.25]
    """
    falling = -jnp.sort(-scores, axis=-1)
    beyond = jnp.cumsum(falling, axis=-1) - mass[..., None]
    support = (falling * jnp.arange(1, 1 + scores.shape[-1]) > beyond).sum(axis=-1, keepdims=True)
    support = jnp.maximum(support, 1)  # a mass of 0 has none
    return -(jnp.take_along_axis(beyond, support - 1, axis=-1) / support)[..., 0]


@STEPS.register("top-k")
class TopKStep(SinkhornStep):
    """Sinkhorn's step; each row of the plan keeps its k largest entries, scaled to the row's mass.

    Columns then miss their marginals, as `column_error` shows. The result is a rounded entropic
    plan, not the best plan with that many entries.
    """

    entropic = False
    k: PositiveInt = 4
    """Number of columns, the dustbin included, to which a row sends mass."""

    def log_plan(self, problem: Problem, potentials: Potentials) -> Matrix:
        """Return the logarithm of the plan, with rows cut to k entries and rescaled."""
        log_plan = problem.log_plan(potentials)
        order = jnp.argsort(-log_plan, axis=-1)
        kept = jnp.argsort(order, axis=-1) < self.k
        sums = jax.nn.logsumexp(jnp.where(kept, log_plan, EMPTY), axis=-1, keepdims=True)
        all_of = jax.nn.logsumexp(log_plan, axis=-1, keepdims=True)
        return jnp.where(kept, log_plan + (all_of - sums), EMPTY)
