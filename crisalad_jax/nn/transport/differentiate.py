"""Gradients of a solution: through the iterations, by the optimality conditions, or none."""

import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

from crisalad_jax.nn.transport.config import GRADIENTS, Gradient, SinkhornConfig, Solution
from crisalad_jax.nn.transport.iterate import iterate
from crisalad_jax.nn.transport.problem import Potentials, Problem, ScalingProblem, product
from crisalad_jax.nn.transport.steps import solve_columns
from crisalad_jax.utils.target import target


def solve_in_domain(
    problem: Problem, config: SinkhornConfig, params: Any, init: Potentials
) -> Solution:
    """Iterate in the configured domain, or in "log" if any scores are too far apart for it."""
    # Leaving the scaling domain takes a branch.
    if config.domain == "log" or not target().branches:
        return iterate(problem, config, params, init)
    scaled = ScalingProblem.scaled(problem)
    solution = iterate(scaled, config, params, init)
    batch = solution.met.shape
    count = math.prod(batch)

    def solve_in_log(problem: Problem, init: Potentials, params: Any, _: Solution) -> Solution:
        # Solve the problems one by one, so that this branch needs little memory.
        @jax.checkpoint
        def solve_one(inputs: tuple[Problem, Potentials]) -> Solution:
            return iterate(inputs[0], config, params, inputs[1])

        flat = jax.tree.map(lambda x: x.reshape(count, *x.shape[len(batch) :]), (problem, init))
        found = jax.lax.map(solve_one, flat)
        return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), found)

    # Keep the scaling domain's iterations outside of `cond`: a branch would copy out all residuals
    # of its gradient, and zeros for those of the other branch.
    @jax.checkpoint
    def choose(*inputs: Any) -> Solution:
        return jax.lax.cond(scaled.in_range, lambda *inputs: inputs[-1], solve_in_log, *inputs)

    return choose(problem, init, params, solution)


@GRADIENTS.register("unrolled")
class Unrolled(Gradient):
    """The gradient through the iterations, exact for the number of iterations that is run."""

    at_convergence: ClassVar[bool | None] = False

    def solve(
        self, problem: Problem, config: SinkhornConfig, params: Any, init: Potentials
    ) -> Solution:
        """Solve with plain JAX operations, which have all derivatives in every mode."""
        return solve_in_domain(problem, config, params, init)


@GRADIENTS.register("stop")
class Stop(Gradient):
    """No gradient: the potentials are constants."""

    def solve(
        self, problem: Problem, config: SinkhornConfig, params: Any, init: Potentials
    ) -> Solution:
        """Solve without a gradient."""
        problem, params, init = jax.lax.stop_gradient((problem, params, init))
        return solve_in_domain(problem, config, params, init)


@GRADIENTS.register("implicit")
class Implicit(Stop):
    """The gradient of the optimality conditions in closed form, without storing iterations."""

    at_convergence: ClassVar[bool | None] = True
    needs_entropic: ClassVar[bool] = True

    def solve(
        self, problem: Problem, config: SinkhornConfig, params: Any, init: Potentials
    ) -> Solution:
        """Solve, and attach the derivative of the converged solution."""
        solution = super().solve(problem, config, params, init)
        return solution._replace(potentials=_at_solution(problem, solution.potentials))


@jax.custom_jvp
def _at_solution(problem: Problem, potentials: Potentials) -> Potentials:
    """Return the given potentials, which are a solution, with the derivative of that solution."""
    return potentials


@_at_solution.defjvp
def _at_solution_jvp(primals: Any, tangents: Any) -> tuple[Potentials, Potentials]:
    """Solve the linearised conditions (see docs/sinkhorn-methods.md, "Implicit gradient")."""
    problem, potentials = primals
    change = tangents[0]
    # Use the rule itself, so that the derivative can be differentiated again.
    potentials = _at_solution(problem, potentials)
    log_plan = problem.log_plan(potentials)
    # Divide all masses by the largest, which cancels in the result: relaxed masses may overflow.
    top = jax.lax.stop_gradient(log_plan.max(axis=(-2, -1), keepdims=True))
    plan, shares = jnp.exp(log_plan - top), jax.nn.softmax(log_plan, axis=-1)
    masses = plan.sum(axis=-2)

    def row_change(column: Array) -> Array:
        moved = (shares * change.kernel).sum(axis=-1) + product("...nk,...k->...n", shares, column)
        changed = problem.row_tau * (change.log_mu - moved)
        if problem.taus[0] is not None:
            changed += change.taus[0] * potentials.row / problem.row_tau
        return changed

    still = row_change(jnp.zeros_like(potentials.column))
    target = masses * change.log_nu - (plan * (change.kernel + still[..., None])).sum(axis=-2)
    if problem.taus[1] is not None:
        target += masses * potentials.column * change.taus[1] / problem.column_tau**2
    if problem.balanced:
        # Where only the masses' totals change, rows are met and columns follow, as in iterations.
        total = target.sum(axis=-1, keepdims=True) / masses.sum(axis=-1, keepdims=True)
        target = target - masses * total
    column = solve_columns(plan, shares, target, problem.row_tau, problem.column_tau)
    return potentials, Potentials(row_change(column), column)


@GRADIENTS.register("optimistix")
class Optimistix(Gradient):
    """The fixed point found by a solver of optimistix, differentiated by an implicit adjoint.

    Every step gets the state of `Step.init` and the iteration number 0. `Step.finish` is not
    called.
    """

    at_convergence: ClassVar[bool | None] = True
    takes_solver: ClassVar[bool] = True

    def solve(
        self,
        problem: Problem,
        config: SinkhornConfig,
        params: Any,
        init: Potentials,
        solver: Any = None,
    ) -> Solution:
        """Solve with `solver`; None is optimistix's plain fixed-point iteration."""
        import lineax
        import optimistix

        if solver is None:
            solver = optimistix.FixedPointIteration(rtol=0.0, atol=config.tolerance or 0.0)

        def solve_one(problem: Problem, init: Potentials) -> Solution:
            def again(at: Potentials, inputs: tuple[Problem, Any]) -> Potentials:
                problem, params = inputs
                at = problem.masked(at)
                moved, _ = config.step.step(
                    problem, at, config.step.init(problem, params), jnp.zeros((), jnp.int32)
                )
                # Centre the potentials to make the fixed point unique.
                if problem.balanced and not config.step.capacities:
                    moved = centred(problem, moved)
                # 0 where there is no mass: a solver may multiply, and `EMPTY` would overflow.
                return problem.masked(moved, 0.0)

            fixed_point = optimistix.fixed_point(
                again,
                solver,
                problem.masked(init, 0.0),
                args=(problem, params),
                max_steps=config.iterations,
                adjoint=optimistix.ImplicitAdjoint(lineax.AutoLinearSolver(well_posed=True)),
                throw=False,
            )
            return Solution(
                problem.masked(fixed_point.value),
                jnp.asarray(fixed_point.stats["num_steps"], jnp.int32),
                fixed_point.result == optimistix.RESULTS.successful,
            )

        for _ in problem.kernel.shape[:-2]:
            solve_one = jax.vmap(solve_one)
        return solve_one(problem, init)


def centred(problem: Problem, potentials: Potentials) -> Potentials:
    """Shift the potentials of columns with mass to a mean of 0, which leaves the plan the same."""
    _, empty = problem.empty
    total = jnp.where(empty, 0, potentials.column).sum(axis=-1, keepdims=True)
    shift = total / jnp.maximum((~empty).sum(axis=-1, keepdims=True), 1)
    return problem.masked(Potentials(potentials.row + shift, potentials.column - shift))
