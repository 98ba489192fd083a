"""Sinkhorn with momentum (Polyak's heavy ball): a step that remembers its last move.

crisalad train ... --plugin examples/plugins/momentum.py
    --model.aggregator.sinkhorn.step momentum
"""

import dataclasses
from typing import ClassVar

import crisalad_jax as cj


@cj.register_step("momentum")
@dataclasses.dataclass(frozen=True)
class Momentum(cj.sinkhorn.Step):
    """Adds `weight` - 1 times the last move to Sinkhorn's own; a weight of 1 is plain Sinkhorn."""

    entropic: ClassVar[bool] = True
    """At a fixed point there is no move to add, so its fixed point is Sinkhorn's."""
    weight: float = 1.5

    def init(self, problem, params):
        """Start without a last move."""
        return problem.zeros().column

    def step(self, problem, potentials, state, iteration):
        """Move the columns further than their marginals ask for, then meet the rows'."""
        column = problem.column_tau * (problem.log_nu - problem.lse_rows(potentials.row))
        column = column + (self.weight - 1) * state
        row = problem.row_tau * (problem.log_mu - problem.lse_columns(column))
        return cj.sinkhorn.Potentials(row, column), column - potentials.column
