"""Nesterov's acceleration of Sinkhorn's iteration."""

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from crisalad_jax.nn.transport.problem import Columns, Potentials, Problem
from crisalad_jax.nn.transport.steps import STEPS, Step


class Momentum(NamedTuple):
    """The state of Nesterov's step."""

    column: Columns
    """Column potentials of the last iteration, before they were extrapolated."""
    count: Float[Array, "*batch"]
    """Number of iterations since the start or the last restart."""


@STEPS.register("nesterov")
class NesterovStep(Step):
    """Sinkhorn's step from extrapolated column potentials, with restarts.

    If rows meet their marginals, Sinkhorn's update of the columns is a mirror step of length 1 on
    the semi-dual, which Nesterov's method accelerates (Soviet Math. Dokl. 1983; Xu and Chen,
    arXiv:2605.30267, have such a method with a proven rate). Here each change of the columns is
    extended by t / (t + 3). The count of iterations t restarts when the last change was against the
    gradient (O'Donoghue and Candes, Found. Comput. Math. 2015). No gradient flows through t.
    """

    entropic: ClassVar[bool] = True

    def init(self, problem: Problem, params: Any) -> Momentum:
        """Return a state without a previous change."""
        zeros = problem.zeros().column
        return Momentum(zeros, 0 * zeros[..., 0])

    def step(
        self, problem: Problem, potentials: Potentials, state: Momentum, iteration: Int[Array, ""]
    ) -> tuple[Potentials, Momentum]:
        """Meet the columns' marginals, extrapolate, then meet the rows'."""
        column = problem.column_tau * (problem.log_nu - problem.lse_rows(potentials.row))
        column = problem.masked(Potentials(potentials.row, column)).column
        move = column - state.column
        ascent = jax.nn.softmax(problem.log_nu) * (column - potentials.column)
        forward = (ascent * move).sum(axis=-1) >= 0
        count = jax.lax.stop_gradient(jnp.where(forward, state.count, 0))
        ahead = column + (count / (count + 3))[..., None] * move
        row = problem.row_tau * (problem.log_mu - problem.lse_columns(ahead))
        return Potentials(row, ahead), Momentum(column, count + 1)
