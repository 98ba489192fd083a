"""Transport to columns that take at most their marginals (Benamou et al., 2015)."""

from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from crisalad_jax.nn.transport.problem import Potentials, Problem
from crisalad_jax.nn.transport.steps import STEPS, Moved, Step


@STEPS.register("capacities")
class CapacityStep(Step):
    """Sinkhorn's step with the columns' marginals as capacities, which columns need not fill.

    For scores S, the plan P maximises <P, S> + epsilon * entropy(P) over plans that meet the rows'
    marginals and exceed no column's (Benamou et al., SIAM J. Sci. Comput. 2015). A column's
    potential is at most 0, and is 0 if the column is not full. The rows' marginals are met last.

    Example:
        >>> from crisalad_jax.sinkhorn import SinkhornConfig, assign_with_dustbin
        >>> config = SinkhornConfig(step="capacities", iterations=20)
        >>> result = assign_with_dustbin(jnp.eye(8, 2), 9.0, config=config)
        >>> [round(float(mass), 2) for mass in jnp.exp(result.log_plan).sum(axis=0)]
        [0.0, 0.0, 8.0]
    """

    capacities: ClassVar[bool] = True
    free_last: bool = True
    """Whether the last column, the dustbin, takes all that is left, without a capacity."""

    def step(self, problem: Problem, potentials: Potentials, state: Any, iteration: Array) -> Moved:
        """Lower the columns that are above their marginals, then meet the rows'."""
        column = problem.log_nu - problem.lse_rows(potentials.row)
        column = jnp.where(column < 0, column, 0)
        if self.free_last:
            column = column.at[..., -1].set(0)
        return Potentials(problem.log_mu - problem.lse_columns(column), column), state
