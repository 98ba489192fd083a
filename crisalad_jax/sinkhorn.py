"""Entropic optimal transport for aggregation: the public API of `crisalad_jax.nn.transport`.

The problem is that of Cuturi (NeurIPS 2013), in the form that SALAD (Izquierdo and Civera, CVPR
2024) took from SuperGlue (Sarlin et al., CVPR 2020). Arrays have shape (..., N, K): N rows
(patches), K columns (clusters, and the dustbin last), which runs faster than the published (K, N).
`docs/sinkhorn.md` has the equations, and says when to use which variant.

Register a custom step (iteration), dustbin, gradient or start (initial potentials) as follows:

    @register_step("capacity")
    def capacity(problem, potentials):
        column = jnp.minimum(problem.log_nu - problem.lse_rows(potentials.row), 0)
        return Potentials(problem.log_mu - problem.lse_columns(column), column)

    solve(scores, log_mu, log_nu, config=SinkhornConfig(step="capacity"))
"""

from crisalad_jax.nn.transport.annealing import AnnealingStep as AnnealingStep
from crisalad_jax.nn.transport.capacities import CapacityStep as CapacityStep
from crisalad_jax.nn.transport.config import GRADIENTS as GRADIENTS
from crisalad_jax.nn.transport.config import Gradient as Gradient
from crisalad_jax.nn.transport.config import SinkhornConfig as SinkhornConfig
from crisalad_jax.nn.transport.config import Solution as Solution
from crisalad_jax.nn.transport.differentiate import Implicit as Implicit
from crisalad_jax.nn.transport.differentiate import Optimistix as Optimistix
from crisalad_jax.nn.transport.differentiate import Stop as Stop
from crisalad_jax.nn.transport.differentiate import Unrolled as Unrolled
from crisalad_jax.nn.transport.divergence import sinkhorn_divergence as sinkhorn_divergence
from crisalad_jax.nn.transport.dustbin import DUSTBINS as DUSTBINS
from crisalad_jax.nn.transport.dustbin import ColumnDustbin as ColumnDustbin
from crisalad_jax.nn.transport.dustbin import Dustbin as Dustbin
from crisalad_jax.nn.transport.dustbin import Marginals as Marginals
from crisalad_jax.nn.transport.dustbin import MassDustbin as MassDustbin
from crisalad_jax.nn.transport.dustbin import NoDustbin as NoDustbin
from crisalad_jax.nn.transport.dustbin import RowAndColumnDustbin as RowAndColumnDustbin
from crisalad_jax.nn.transport.dustbin import TokenDustbin as TokenDustbin
from crisalad_jax.nn.transport.dustbin import append_dustbin as append_dustbin
from crisalad_jax.nn.transport.dustbin import log_marginals as log_marginals
from crisalad_jax.nn.transport.iterate import iterate as iterate
from crisalad_jax.nn.transport.nesterov import NesterovStep as NesterovStep
from crisalad_jax.nn.transport.partial import PartialDustbin as PartialDustbin
from crisalad_jax.nn.transport.partial import PartialStep as PartialStep
from crisalad_jax.nn.transport.problem import SCALING_RANGE as SCALING_RANGE
from crisalad_jax.nn.transport.problem import Potentials as Potentials
from crisalad_jax.nn.transport.problem import Problem as Problem
from crisalad_jax.nn.transport.problem import marginal_error as marginal_error
from crisalad_jax.nn.transport.solve import SinkhornResult as SinkhornResult
from crisalad_jax.nn.transport.solve import assign_with_dustbin as assign_with_dustbin
from crisalad_jax.nn.transport.solve import solve as solve
from crisalad_jax.nn.transport.sparse import QuadraticStep as QuadraticStep
from crisalad_jax.nn.transport.sparse import TopKStep as TopKStep
from crisalad_jax.nn.transport.start import STARTS as STARTS
from crisalad_jax.nn.transport.start import GaussianStart as GaussianStart
from crisalad_jax.nn.transport.start import NetworkStart as NetworkStart
from crisalad_jax.nn.transport.start import Start as Start
from crisalad_jax.nn.transport.start import ZeroStart as ZeroStart
from crisalad_jax.nn.transport.start import from_columns as from_columns
from crisalad_jax.nn.transport.steps import STEPS as STEPS
from crisalad_jax.nn.transport.steps import DualSoftmaxStep as DualSoftmaxStep
from crisalad_jax.nn.transport.steps import NewtonStep as NewtonStep
from crisalad_jax.nn.transport.steps import SinkhornStep as SinkhornStep
from crisalad_jax.nn.transport.steps import SoftmaxStep as SoftmaxStep
from crisalad_jax.nn.transport.steps import Step as Step

register_step = STEPS.register
register_dustbin = DUSTBINS.register
register_gradient = GRADIENTS.register
register_start = STARTS.register
