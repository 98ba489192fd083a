"""Steps of a transport solver: the interface, the built-in steps and their registry."""

import abc
import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from crisalad_jax.config.checks import require, require_field
from crisalad_jax.config.part import Part
from crisalad_jax.config.registry import Registry, count_arguments
from crisalad_jax.nn.transport.problem import (
    Columns,
    Matrix,
    Potentials,
    Problem,
    ScalingProblem,
    product,
)

Moved = tuple[Potentials, Any]
"""The potentials and the state after a step."""


class Step(Part, abc.ABC):
    """One iteration of a transport solver: a frozen dataclass whose fields are its settings.

    A subclass need only define `step`. Stopping, acceleration and gradients use the methods and
    attributes of a step, never its name.

    Example:
        >>> from crisalad_jax.sinkhorn import SinkhornConfig, register_step, solve
        >>> @register_step("columns-alone")
        ... def columns_alone(problem, potentials):
        ...     column = problem.log_nu - problem.lse_rows(potentials.row)
        ...     return Potentials(potentials.row, column)
        >>> zeros = jnp.zeros(2)
        >>> config = SinkhornConfig(step="columns-alone", iterations=1)
        >>> float(solve(jnp.eye(2), zeros, zeros, config=config).column_error)
        0.0
    """

    entropic: ClassVar[bool] = False
    """Whether the fixed point is the entropic plan of the problem. The gradient "implicit" requires
    it, and such a step counts as converged only if the plan meets its marginals."""
    capacities: ClassVar[bool] = False
    """Whether columns may take less than their marginals. The potentials then have no free
    constant, and a result's `column_error` is the largest relative excess."""

    def init_params(self, key: PRNGKeyArray) -> Any:
        """Return the step's initial parameters, a pytree of arrays; by default None."""
        return None

    def prepare(self, problem: Problem, params: Any) -> Problem:
        """Return the problem to solve, of the same shapes; by default the given one.

        Apply learnt changes to the problem itself, such as a learnt epsilon, here: every gradient
        and the plan then depend on them.
        """
        return problem

    def init(self, problem: Problem, params: Any) -> Any:
        """Return the state before the first iteration, a pytree; by default `params`."""
        return params

    @abc.abstractmethod
    def step(
        self, problem: Problem, potentials: Potentials, state: Any, iteration: Int[Array, ""]
    ) -> tuple[Potentials, Any]:
        """Return the next potentials and state; `iteration` counts from 0."""

    def error(self, problem: Problem, new: Potentials, old: Potentials) -> Float[Array, "*batch"]:
        """Return the error that `tolerance` limits: by default the largest change of a potential.

        In a balanced problem a constant moved from row to column potentials does not count. What
        remains is, to first order, the relative marginal error that the step corrected.
        """
        row, column = new.row - old.row, new.column - old.column
        if problem.balanced and not self.capacities:
            # Weight by masses: where the rows are met, this constant is 0 to first order.
            shift = (jax.nn.softmax(problem.log_nu) * column).sum(axis=-1, keepdims=True)
            row, column = row + shift, column - shift
        return jnp.maximum(jnp.abs(row).max(axis=-1), jnp.abs(column).max(axis=-1))

    def finish(self, problem: Problem, potentials: Potentials) -> Potentials:
        """Return the potentials of the plan, after the last iteration; by default unchanged."""
        return potentials

    def log_plan(self, problem: Problem, potentials: Potentials) -> Matrix:
        """Return the logarithm of the plan; by default kernel + row + column."""
        return problem.log_plan(potentials)


def _of_function(function: Callable[..., Any]) -> Mapping[str, Any]:
    """Return the methods of a step that is a function of (problem, potentials[, iteration])."""
    count = count_arguments(function, "problem", "potentials", "iteration")

    def step(
        self: Step, problem: Problem, potentials: Potentials, state: Any, iteration: Array
    ) -> tuple[Potentials, Any]:
        arguments = (problem, potentials, iteration)[:count]
        return function(*arguments), state

    return {"step": step}


STEPS = Registry("step", Step, of_function=_of_function)


@STEPS.register("sinkhorn")
class SinkhornStep(Step):
    """Meet the columns' marginals, then the rows' (Eq. 5 of the CriSALAD paper).

    A `relaxation` of w makes each half step w times as long, in every entry where that does not
    lower the dual objective (Thibault et al., Algorithms 2021, use one w for all entries).
    """

    entropic: ClassVar[bool] = True
    relaxation: float = 1.0
    """Factor on the length of each half step, from 1 (plain Sinkhorn) to less than 2."""

    def __post_init__(self) -> None:
        """Check the range."""
        fits = 1 <= self.relaxation < 2
        require_field(self, "relaxation", fits, "from 1 to less than 2")

    def step(self, problem: Problem, potentials: Potentials, state: Any, iteration: Array) -> Moved:
        """Update the column potentials, then the row potentials."""
        column = problem.column_tau * (problem.log_nu - problem.lse_rows(potentials.row))
        column = self._further(potentials.column, column, problem.column_tau)
        row = problem.row_tau * (problem.log_mu - problem.lse_columns(column))
        return Potentials(self._further(potentials.row, row, problem.row_tau), column), state

    def _further(self, old: Array, new: Array, tau: float | Array) -> Array:
        if self.relaxation == 1:
            return new
        change = new - old
        beyond = (self.relaxation - 1) * change
        # The dual's gain by this entry, divided by its mass at `new`.
        gain = jnp.exp(-change) - jnp.exp(beyond)
        if isinstance(tau, float):  # 1: no penalty
            gain += self.relaxation * change
        else:
            penalty = tau / (1 - tau)
            gain += penalty * (jnp.exp(change / penalty) - jnp.exp(-beyond / penalty))
        # Infinity minus infinity counts as no gain, too.
        return jnp.where(gain >= 0, new + beyond, new)

    def finish(self, problem: Problem, potentials: Potentials) -> Potentials:
        """Meet the rows' marginals again, as an over-relaxed step may miss them.

        Otherwise the rows' masses could overflow.
        """
        if self.relaxation == 1:
            return potentials
        row = problem.row_tau * (problem.log_mu - problem.lse_columns(potentials.column))
        return Potentials(row, potentials.column)


LONGEST = (8.0, 2.0, 0.5)
"""Limits on the change of a potential that Newton's step tries, in multiples of the temperature."""
COOLING = 1.5
"""Factor between successive temperatures of Newton's step."""
FAR = 3.0
"""Largest error of a column's log mass at the temperature at which Newton's step starts."""
HOTTEST = 1e12
"""Temperature at which the search for a first temperature ends, if scores are not finite."""


@STEPS.register("newton")
class NewtonStep(Step):
    """Newton's method on the semi-dual, a concave function of only the column potentials.

    The rows' marginals are always met (Brauer et al., 2017), and the Hessian is the Laplacian of a
    weighted graph of the columns. A step tries Newton's change of potentials, clipped to several
    lengths, and Sinkhorn's. It takes the one with the largest semi-dual, which never falls.

    If scores differ by too many epsilons, epsilon is at first multiplied by a temperature, which
    falls to 1 as the errors fall. The step's state is the next temperature. Both taus must be 1.
    """

    entropic: ClassVar[bool] = True

    def init(self, problem: Problem, params: Any) -> Float[Array, "*batch"]:
        """Return a temperature of 1, which the first step replaces to suit the potentials."""
        return 0 * problem.log_mu[..., 0] + 1

    def step(self, problem: Problem, potentials: Potentials, state: Any, iteration: Array) -> Moved:
        """Take the best of four changes of the potentials, at the temperature in `state`.

        Raises:
            InputError: `row_tau` or `column_tau` is below 1.
        """
        check_balanced(problem, "newton")
        temperature = jax.lax.stop_gradient(state)
        temperature = _temperature(problem, potentials.column, temperature, iteration == 0)
        smooth = tempered(problem, temperature)
        column = _scaled(problem, potentials.column, temperature)
        row = problem.log_mu - smooth.lse_columns(column)
        log_plan = smooth.log_plan(Potentials(row, column))
        log_masses = smooth.lse_rows(row) + column
        shares = jnp.exp(log_plan - problem.log_mu[..., None])
        newton = _newton_change(problem, jnp.exp(log_plan), shares, log_masses)
        change = _best_change(problem, shares, newton, problem.log_nu - log_masses)
        column = potentials.column + temperature[..., None] * change
        row = problem.log_mu - problem.lse_columns(column)
        lower = _cooled(temperature, newton, jnp.abs(log_masses - problem.log_nu).max(axis=-1))
        return Potentials(row, column), lower

    def error(self, problem: Problem, new: Potentials, old: Potentials) -> Float[Array, "*batch"]:
        """Return the remaining marginal error: a change may be small even far from the solution."""
        return _marginal_error(problem, new)


def _newton_change(problem: Problem, plan: Array, shares: Array, log_masses: Array) -> Array:
    """Compute Newton's change of the columns' potentials."""
    gradient = jnp.exp(problem.log_nu) - jnp.exp(log_masses)
    newton = solve_columns(plan, shares, gradient)
    # A constant does not change the plan. Take the median: a few columns may have far to go.
    return newton - jnp.median(newton, axis=-1, keepdims=True)


def _best_change(problem: Problem, shares: Array, newton: Array, sinkhorn: Array) -> Array:
    """Return the change with the largest semi-dual: Newton's, at several lengths, or Sinkhorn's.

    Changes are clipped entry by entry, so that far columns do not hold up the others.
    """
    clipped = [jnp.clip(newton, -most, most) for most in LONGEST]
    tries = jnp.stack([*clipped, jnp.clip(sinkhorn, -LONGEST[0], LONGEST[0])], axis=-1)
    weights = jax.nn.softmax(problem.log_nu)[..., None]
    tries = tries - (weights * tries).sum(axis=-2, keepdims=True)
    # The semi-dual's gain, from the current plan, without new exponentials of matrices.
    mixed = product("...nk,...kt->...nt", shares, jnp.expm1(tries))
    least = math.expm1(-2 * LONGEST[0])  # up to rounding
    gains = product("...k,...kt->...t", jnp.exp(problem.log_nu), tries) - product(
        "...n,...nt->...t", jnp.exp(problem.log_mu), jnp.log1p(jnp.maximum(mixed, least))
    )
    best = jnp.argmax(jnp.where(jnp.isnan(gains), -jnp.inf, gains), axis=-1)
    return jnp.take_along_axis(tries, best[..., None, None], axis=-1)[..., 0]


def _cooled(temperature: Array, newton: Array, error: Array) -> Array:
    """Lower the temperature if the plan is near the solution at this temperature."""
    short = jnp.abs(newton).max(axis=-1) <= LONGEST[1]
    # Later, when columns no longer share rows, errors hardly fall by themselves.
    near = (error <= 0.03) | ((error <= 1) & short)
    return jnp.where(near, jnp.maximum(temperature / COOLING, 1), temperature)


@STEPS.register("softmax")
class SoftmaxStep(Step):
    """Distribute the mass of every row by a softmax: a baseline without transport."""

    def step(self, problem: Problem, potentials: Potentials, state: Any, iteration: Array) -> Moved:
        """Meet the rows' marginals, and ignore the columns'."""
        column = problem.zeros().column
        return Potentials(problem.log_mu - problem.lse_columns(column), column), state


@STEPS.register("dual-softmax")
class DualSoftmaxStep(Step):
    """Multiply a softmax over each row by one over each column: a baseline without transport."""

    def step(self, problem: Problem, potentials: Potentials, state: Any, iteration: Array) -> Moved:
        """Normalise rows and columns, independently of each other."""
        row, column = problem.zeros()
        return Potentials(-problem.lse_columns(column), -problem.lse_rows(row)), state

    def log_plan(self, problem: Problem, potentials: Potentials) -> Matrix:
        """Return the sum of the log-softmaxes of rows and columns."""
        return problem.kernel + problem.log_plan(potentials)


def _temperature(problem: Problem, column: Array, current: Array, is_first: Array) -> Array:
    """Return the current temperature; find one before the first step.

    It is the least power of `COOLING` that leaves errors of at most `FAR`.
    """
    problem, column = jax.lax.stop_gradient((problem, column))

    def too_far(temperature: Array) -> Array:
        smooth, scaled = tempered(problem, temperature), _scaled(problem, column, temperature)
        row = problem.log_mu - smooth.lse_columns(scaled)
        error = _marginal_error(smooth, Potentials(row, scaled))
        return is_first & (error > FAR) & (temperature < HOTTEST)

    def hotter(temperature: Array) -> Array:
        return jnp.where(too_far(temperature), COOLING * temperature, temperature)

    return jax.lax.while_loop(lambda at: too_far(at).any(), hotter, current)


def check_balanced(problem: Problem, name: str) -> None:
    """Raise InputError if a tau of the problem is below 1, for the step with this name."""
    require(
        problem.balanced,
        f"step {name}: found relaxed marginals, expected row_tau 1 and column_tau 1: it is for "
        "balanced problems",
    )


def tempered(problem: Problem, temperature: Float[Array, "*batch"]) -> Problem:
    """Return a balanced problem with epsilon multiplied by `temperature`, in the same domain."""
    by = temperature[..., None]
    clusters, last = problem.clusters / by[..., None], problem.last / by
    smooth = Problem(clusters, last, problem.log_mu, problem.log_nu)
    return ScalingProblem.scaled(smooth) if isinstance(problem, ScalingProblem) else smooth


def _scaled(problem: Problem, column: Array, temperature: Array) -> Array:
    """Return potentials for a multiple of epsilon, measured from the columns' masses.

    In the limit of an infinite temperature the plan is the product of the marginals, which meets
    them.
    """
    return problem.log_nu + (column - problem.log_nu) / temperature[..., None]


def _marginal_error(problem: Problem, potentials: Potentials) -> Float[Array, "*batch"]:
    """Return the largest difference between the logarithms of a column's mass and marginal."""
    masses = problem.lse_rows(potentials.row) + potentials.column
    return jnp.abs(masses - problem.log_nu).max(axis=-1)


def solve_columns(
    plan: Matrix,
    shares: Matrix,
    target: Columns,
    row_tau: float | Array = 1.0,
    column_tau: float | Array = 1.0,
) -> Columns:
    """Solve the columns' part of the linearised optimality conditions.

    The matrix is diag(masses / column_tau) - row_tau * shares^T plan, with the plan's column sums
    as masses, written as a Laplacian to avoid cancellation. If both taus are 1, the unknown of the
    heaviest column is set to 0; fixing one without mass instead would leave the matrix singular.

    Args:
        plan: the plan's masses.
        shares: the plan with each row divided by its sum.
        target: the right-hand side.
        row_tau: see `Problem`.
        column_tau: see `Problem`.
    """
    # The floor handles columns so far from all rows that their masses are 0.
    masses = jnp.maximum(plan.sum(axis=-2), jnp.finfo(plan.dtype).tiny ** 0.5)
    identity = jnp.eye(masses.shape[-1], dtype=plan.dtype)
    weights = product("...nk,...nl->...kl", shares, plan) * (1 - identity)
    weights = weights if isinstance(row_tau, float) else jnp.asarray(row_tau)[..., None] * weights
    # The epsilons prevent a division by zero for clusters that share no row.
    slack = 1 / column_tau - row_tau + 8 * jnp.finfo(plan.dtype).eps
    diagonal = weights.sum(axis=-1) + masses * slack
    if isinstance(row_tau, float) and isinstance(column_tau, float):
        heaviest = jnp.arange(masses.shape[-1]) == masses.argmax(axis=-1, keepdims=True)
        diagonal += jnp.where(heaviest, masses, 0)
    factor = jax.scipy.linalg.cho_factor(diagonal[..., None] * identity - weights)
    return jax.scipy.linalg.cho_solve(factor, target[..., None])[..., 0]
