"""Entropic optimal transport for aggregation: the public face of `crisalad_jax.nn.transport`.

The problem is that of Cuturi (NeurIPS 2013), in the form that SALAD (Izquierdo and Civera, CVPR
2024) took from SuperGlue (Sarlin et al., CVPR 2020). Arrays are laid out (..., N, K): N rows
(patches), K columns (clusters, and the dustbin last), which runs faster than the published (K, N).
`docs/sinkhorn.md` has the equations, the variants and how they compare.

A step, a dustbin or a gradient of your own is registered as the built-in ones are:

    @register_step("capacity")
    def capacity(problem, potentials):
        column = jnp.minimum(problem.log_nu - problem.lse_rows(potentials.row), 0)
        return Potentials(problem.log_mu - problem.lse_columns(column), column)

    solve(scores, log_mu, log_nu, config=SinkhornConfig(step="capacity"))
"""

from crisalad_jax.nn.transport.config import GRADIENTS, Gradient, SinkhornConfig, Solution
from crisalad_jax.nn.transport.differentiate import Implicit, Optimistix, Stop, Unrolled
from crisalad_jax.nn.transport.dustbin import (
    DUSTBINS,
    ColumnDustbin,
    Dustbin,
    Marginals,
    MassDustbin,
    NoDustbin,
    RowAndColumnDustbin,
    TokenDustbin,
    append_dustbin,
    log_marginals,
)
from crisalad_jax.nn.transport.iterate import iterate
from crisalad_jax.nn.transport.problem import SCALING_RANGE, Potentials, Problem, marginal_error
from crisalad_jax.nn.transport.solve import SinkhornResult, assign_with_dustbin, solve
from crisalad_jax.nn.transport.steps import (
    STEPS,
    DualSoftmaxStep,
    NewtonStep,
    SinkhornStep,
    SoftmaxStep,
    Step,
)

register_step = STEPS.register
register_dustbin = DUSTBINS.register
register_gradient = GRADIENTS.register

__all__ = [
    "DUSTBINS",
    "GRADIENTS",
    "SCALING_RANGE",
    "STEPS",
    "ColumnDustbin",
    "DualSoftmaxStep",
    "Dustbin",
    "Gradient",
    "Implicit",
    "Marginals",
    "MassDustbin",
    "NewtonStep",
    "NoDustbin",
    "Optimistix",
    "Potentials",
    "Problem",
    "RowAndColumnDustbin",
    "SinkhornConfig",
    "SinkhornResult",
    "SinkhornStep",
    "SoftmaxStep",
    "Solution",
    "Step",
    "Stop",
    "TokenDustbin",
    "Unrolled",
    "append_dustbin",
    "assign_with_dustbin",
    "iterate",
    "log_marginals",
    "marginal_error",
    "register_dustbin",
    "register_gradient",
    "register_step",
    "solve",
]
