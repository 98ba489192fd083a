"""Solve a transport problem, or assign patches to clusters by solving one."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from crisalad_jax.config.checks import require
from crisalad_jax.config.short_repr import brief
from crisalad_jax.nn.transport.checks import (
    check_inputs,
    check_start,
    check_step,
    equal_totals,
    per_problem,
    wide_dtype,
)
from crisalad_jax.nn.transport.config import SinkhornConfig, Solution
from crisalad_jax.nn.transport.differentiate import centred
from crisalad_jax.nn.transport.dustbin import DUSTBINS, Dustbin, Marginals
from crisalad_jax.nn.transport.problem import (
    Matrix,
    Potentials,
    Problem,
    marginal_error,
    zero_potentials,
)
from crisalad_jax.utils.pytree import expect_like


@brief
class SinkhornResult(NamedTuple):
    """A transport plan and how well it meets its marginals."""

    log_plan: Matrix
    potentials: Potentials
    """Dual variables divided by epsilon. In balanced entropic transport (both taus 1) they are
    unique up to a constant, so the columns' mean is set to 0. Pass them as `init` to start the next
    solve. Those of rows and columns of mass 0 are very low, and do not count in the mean."""
    row_error: Float[Array, "*batch"]
    """Largest relative error of a row's mass: |mass / marginal - 1|, or 0 for a marginal of 0."""
    column_error: Float[Array, "*batch"]
    """Largest relative error of a column's mass. Rows are updated last, so iterations reduce
    this error. If the step has capacities, only a mass above its marginal is an error."""
    iterations: Int[Array, "*batch"]
    """Number of iterations taken."""
    converged: Bool[Array, "*batch"]
    """Whether a tolerance was set and met; False without one, as convergence is then unknown. If a
    balanced entropic problem has converged, both errors above are within the tolerance too."""
    finite: Bool[Array, "*batch"]
    """Whether all potentials are finite."""


def solve(
    scores: Matrix,
    log_mu: Float[Array, "*#batch rows"],
    log_nu: Float[Array, "*#batch columns"],
    *,
    epsilon: float | Float[Array, "*#batch"] = 1.0,
    row_tau: float | Float[Array, "*#batch"] = 1.0,
    column_tau: float | Float[Array, "*#batch"] = 1.0,
    config: SinkhornConfig = SinkhornConfig(),
    init: Potentials | None = None,
    step_params: Any = None,
    start_params: Any = None,
    solver: Any = None,
) -> SinkhornResult:
    """Solve the entropic transport problem.

    The plan maximises <plan, scores> + epsilon * entropy for the given marginals (Eq. 5 of the
    CriSALAD paper). By default the algorithm is the published one: three iterations from zero
    potentials, each of which meets first the columns' marginals and then the rows'. Scores of half
    precision are widened to float32. For finite scores the result is finite and does not depend on
    `config.domain`: scores too far apart for the scaling domain are solved again in the log domain.

    Rows and columns may have a mass of 0. Their entries of the plan and their gradients are then 0,
    and the rest is as if they were left out. The logarithm of such an entry is finite, and so low
    that its exponential is 0.

    Every `config.gradient` but "optimistix" has forward-mode, reverse-mode and higher derivatives.
    Under `vmap` every problem is solved in both domains: put a batch in the leading axes instead.

    Args:
        scores: the gain of moving mass from a row to a column; finite.
        log_mu: logarithms of the rows' masses (required sums); -inf or below -1e5 for a mass of 0.
        log_nu: logarithms of the columns' masses. If the step is `entropic` and both taus are 1,
            they must have the same total as the rows' masses. Totals of half-precision masses may
            differ by rounding: the columns' masses are then scaled to the rows' total.
        epsilon: entropic regularisation, above 0: one value for all problems of the batch, or one
            for each. It may be traced or learnt.
        row_tau: 1 for rows that meet their marginals exactly; below 1 a Kullback-Leibler penalty of
            weight epsilon * row_tau / (1 - row_tau) pulls their sums to the marginals. An array, of
            one value or one for each problem, may be traced or learnt, and must stay below 1.
        column_tau: the same for columns.
        config: step, stopping rule and gradient; a static argument.
        init: potentials to start from, such as those of an earlier result; by default those of
            `config.start`. Values for rows and columns of mass 0 are not used.
        step_params: learnt parameters of the step (`Step.init_params`).
        start_params: learnt parameters of the start (`Start.init_params`).
        solver: a solver for the gradient "optimistix"; None is its plain fixed-point iteration.

    Returns:
        The plan's logarithm, the potentials, and how well the plan meets its marginals.

    Raises:
        InputError: scores are complex; shapes do not fit; or the step or start lacks parameters or
            returns other shapes. If values are known (outside of `jit` and `grad`): scores are not
            finite; `init` has a NaN; masses are NaN, infinite or all 0; totals differ; a tau is out
            of range; or epsilon is not positive or too small. With `config.throw`: the tolerance is
            not met. Inside of `jit` this is instead a RuntimeError of the compiled program, raised
            only if the program uses a value of the result.

    Example:
        >>> import jax.numpy as jnp
        >>> log_mu, log_nu = jnp.log(jnp.array([0.5, 0.5])), jnp.log(jnp.array([0.7, 0.3]))
        >>> result = solve(jnp.eye(2), log_mu, log_nu, epsilon=0.5)
        >>> jnp.exp(result.log_plan).sum(axis=1).round(3).tolist()
        [0.5, 0.5]
    """
    scores, log_mu, log_nu = jnp.asarray(scores), jnp.asarray(log_mu), jnp.asarray(log_nu)
    row, column = (
        None if isinstance(tau, (int, float)) and tau == 1 else tau for tau in (row_tau, column_tau)
    )
    taus: tuple[Any, Any] = row, column
    # Totals may differ if the step solves another problem, such as one with column capacities.
    equal = _balanced(taus) and config.step.entropic
    check_inputs(scores, log_mu, log_nu, (epsilon, *taus), init, equal_totals=equal)
    arguments = scores, log_mu, log_nu, epsilon, init, step_params, start_params, taus, config
    # A solver need not be hashable, so it cannot be a static argument.
    result = _compiled(*arguments) if solver is None else _solve(*arguments, solver)
    if not config.throw:
        return result
    message = (
        f"sinkhorn: found no convergence to {config.tolerance} in {config.iterations} iterations"
    )
    if isinstance(result.converged, Tracer):
        import equinox

        return equinox.error_if(result, ~result.converged.all(), message)
    missed = int((~result.converged).sum())
    require(not missed, f"{message} for {missed} of {result.converged.size} problems")
    return result


def _balanced(taus: tuple[Any, Any]) -> bool:
    return all(tau is None for tau in taus)


def _solve(
    scores: Array,
    log_mu: Array,
    log_nu: Array,
    epsilon: float | Array,
    init: Potentials | None,
    step_params: Any,
    start_params: Any,
    taus: tuple[Array | None, Array | None],
    config: SinkhornConfig,
    solver: Any = None,
) -> SinkhornResult:
    step, wide = config.step, wide_dtype(scores)
    kernel = scores.astype(wide) / per_problem(jnp.asarray(epsilon, wide), 2)
    zeros = zero_potentials(kernel)
    meets_both = _balanced(taus) and step.entropic
    if meets_both:
        log_mu, log_nu = equal_totals(log_mu, log_nu, wide)
    # Broadcast by the kernel, they vary over devices as it does.
    log_mu, log_nu = log_mu.astype(wide) + zeros.row, log_nu.astype(wide) + zeros.column
    relaxed = (1.0 if x is None else per_problem(jnp.asarray(x, wide), 1) for x in taus)
    problem = Problem.of(kernel, log_mu, log_nu, *relaxed)
    check_step(config, problem, step_params)
    problem = step.prepare(problem, step_params)
    if init is None:
        check_start(config, problem, start_params)
        start = config.start.potentials(problem, start_params)
    else:
        start = jax.tree.map(lambda x, zero: jnp.asarray(x, wide) + zero, Potentials(*init), zeros)
    options = {} if solver is None else {"solver": solver}
    solution = config.gradient.solve(problem, config, step_params, start, **options)
    count = jnp.zeros(kernel.shape[:-2], jnp.int32)
    wanted = Solution(zeros, count, count.astype(bool))
    expect_like(f"gradient {config.gradient.part_name}", solution, wanted)
    potentials = problem.masked(solution.potentials)
    log_plan = step.log_plan(problem, potentials)
    errors = marginal_error(log_plan, problem.log_mu, problem.log_nu, capacities=step.capacities)
    finite = jnp.isfinite(jnp.concatenate(potentials, axis=-1)).all(axis=-1)
    converged = jax.lax.stop_gradient(solution.met) & finite
    if meets_both and config.tolerance is not None:
        # The tolerance is on logarithms, whose rounding error is a few machine epsilons.
        most = math.expm1(config.tolerance) + 16 * jnp.finfo(wide).eps
        converged &= jnp.maximum(*errors) <= most
    if meets_both:
        potentials = centred(problem, potentials)
    return SinkhornResult(log_plan, potentials, *errors, solution.iterations, converged, finite)


_compiled = jax.jit(_solve, static_argnames="config")


def assign_with_dustbin(
    scores: Float[Array, "*batch patches clusters"],
    params: Any,
    dustbin: Dustbin | str = "column",
    *,
    patches: Float[Array, "*batch patches dim"] | None = None,
    **options: Any,
) -> SinkhornResult:
    """Assign patches to clusters by transport, with a dustbin for patches that fit no cluster.

    Args:
        scores: scores of each patch for each cluster.
        params: learnt parameters of the dustbin. For "column" and "row and column": its one score;
            "token": a score per patch; "mass": the logit of the dustbin's share of all mass, where
            the clusters share the rest equally; "partial": the logit of the share that moves, or
            None; "none": None.
        dustbin: a registered dustbin, or its name.
        patches: features of the patches, for a custom dustbin that uses them.
        **options: keyword arguments of `solve`, from `epsilon` on.

    Returns:
        The result of `solve`. Rows of the plan are the patches; columns are the clusters and then
        the dustbin. A row of the dustbin is left out of the plan.

    Raises:
        InputError: the dustbin's mass is the number of patches minus that of clusters, which is not
            positive; `params` have another shape than the dustbin needs; the dustbin has
            capacities, but the step does not support them; or `solve` raises it.

    Example:
        >>> import jax.numpy as jnp
        >>> result = assign_with_dustbin(jnp.zeros((3, 2)), 1.0)
        >>> result.log_plan.shape
        (3, 3)
    """
    scores = jnp.asarray(scores)
    require(
        scores.ndim >= 2 and 0 not in scores.shape[-2:],
        f"assign_with_dustbin: found scores of shape {scores.shape}, expected (..., patches, "
        "clusters)",
    )
    scores = scores.astype(wide_dtype(scores))
    if isinstance(dustbin, str):
        dustbin = DUSTBINS.make(dustbin)
    step = options.get("config", SinkhornConfig()).step
    require(
        step.capacities or not dustbin.capacities,
        f"dustbin {dustbin.part_name}: found step {step.part_name}, expected one with capacities, "
        "such as partial",
    )
    marginals = dustbin.marginals(params, scores, patches)
    require(
        isinstance(marginals, Marginals),
        f"dustbin {dustbin.part_name}: found {type(marginals).__name__}, expected Marginals",
    )
    result = solve(*marginals, **options)
    # Drop the dustbin's own row.
    return result._replace(log_plan=result.log_plan[..., : scores.shape[-2], :])
