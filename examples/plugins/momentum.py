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
    """Add a share of the last move, `weight` less 1, to Sinkhorn's own; 1 is plain Sinkhorn."""

    entropic: ClassVar[bool] = True
    """At rest there is no move to add: its fixed point is Sinkhorn's."""
    weight: float = 1.5

    def init(self, problem, params):
        """Remember no move."""
        return problem.zeros().column

    def step(self, problem, potentials, state, iteration):
        """Move the columns further than their marginals ask for, then meet the rows'."""
        column = problem.column_tau * (problem.log_nu - problem.lse_rows(potentials.row))
        column = column + (self.weight - 1) * state
        row = problem.row_tau * (problem.log_mu - problem.lse_columns(column))
        return cj.sinkhorn.Potentials(row, column), column - potentials.column
