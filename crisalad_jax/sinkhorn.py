"""Entropic optimal transport for aggregation: every variant behind one function.

The problem is that of Cuturi (NeurIPS 2013), in the form that SALAD (Izquierdo and Civera, CVPR
2024) took from SuperGlue (Sarlin et al., CVPR 2020). Arrays are laid out (..., N, K): N rows
(patches), K columns (clusters, and the dustbin last), which runs faster than the published (K, N).
`docs/sinkhorn.md` has the equations, the variants and how they compare.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from crisalad_jax.config import SinkhornConfig
from crisalad_jax.errors import InputError
from crisalad_jax.pytree import params

SCALING_RANGE = 60
"""Where scores in a row are further apart, over epsilon, the scaling domain does not do.

Within it no sum is below exp(-60), whatever the potentials, and what float32 flushes to zero, below
exp(-87), is no part of such a sum's last place."""
FALLBACK_BATCH = 4
"""So many problems at a time are solved again where the scaling domain would not do and a gradient
through the iterations is asked for: memory for it is set aside whether or not it is taken."""
UNROLLED = 8
"""Up to so many iterations are written out for the compiler; more are a scan."""


class Potentials(NamedTuple):
    """The dual variables over epsilon: the plan is exp(kernel + row + column)."""

    row: Float[Array, "*batch rows"]
    column: Float[Array, "*batch columns"]


class SinkhornResult(NamedTuple):
    """A transport plan and how well it meets its marginals."""

    log_plan: Float[Array, "*batch rows columns"]
    potentials: Potentials
    """Those of balanced transport are known up to a constant: the columns' mean is 0."""
    row_error: Float[Array, "*batch"]
    """Largest difference between a row's mass and its marginal, relative to the marginal."""
    column_error: Float[Array, "*batch"]
    """The same for columns. Rows are updated last, so this is the error that iterations lower."""
    iterations: Int[Array, "*batch"]
    converged: Bool[Array, "*batch"]
    """Whether the tolerance was met, and of balanced transport both errors are within it. Without a
    tolerance: whether the potentials are finite."""


@params
class Problem:
    """What a step sees: the scores over epsilon and the marginals; sums in the log domain."""

    kernel: Float[Array, "*batch rows columns"]
    log_mu: Float[Array, "*batch rows"]
    log_nu: Float[Array, "*batch columns"]

    def over_columns(self, column: Float[Array, "*batch columns"]) -> Float[Array, "*batch rows"]:
        """Logarithm of each row's sum of exp(kernel + column)."""
        return _log_sum(self.kernel, column, -1)

    def over_rows(self, row: Float[Array, "*batch rows"]) -> Float[Array, "*batch columns"]:
        """Logarithm of each column's sum of exp(kernel + row)."""
        return _log_sum(self.kernel, row, -2)


@params
class _ScalingProblem(Problem):
    """In the scaling domain: exponentials once, then products of a matrix with vectors.

    The last column is apart. Mostly it is a dustbin that was appended: what is cut off there again
    the compiler need not write out, and powers of two are left.
    """

    fits: Bool[Array, ""]
    """Where False, what comes out is finite and of no use."""
    row_max: Float[Array, "*batch rows"]
    gibbs: Float[Array, "*batch rows columns-1"]
    """exp(kernel - row_max)."""
    last: Float[Array, "*batch rows"]

    def over_columns(self, column: Float[Array, "*batch columns"]) -> Float[Array, "*batch rows"]:
        scaled, top = _exponentials(column)
        sums = _product("...nk,...k->...n", self.gibbs, scaled[..., :-1])
        return self.row_max + self._log(sums + self.last * scaled[..., -1:]) + top

    def over_rows(self, row: Float[Array, "*batch rows"]) -> Float[Array, "*batch columns"]:
        scaled, top = _exponentials(row + self.row_max)
        sums = _product("...nk,...n->...k", self.gibbs, scaled)
        last = (self.last * scaled).sum(axis=-1, keepdims=True)
        return self._log(jnp.concatenate([sums, last], axis=-1)) + top

    def _log(self, sums: Array) -> Array:
        return jnp.log(jnp.where(self.fits, sums, 1))


@params
class _PlainProblem(Problem):
    """In the log domain, by functions that forward mode can differentiate too."""

    def over_columns(self, column: Float[Array, "*batch columns"]) -> Float[Array, "*batch rows"]:
        return jax.nn.logsumexp(self.kernel + column[..., None, :], axis=-1)

    def over_rows(self, row: Float[Array, "*batch rows"]) -> Float[Array, "*batch columns"]:
        return jax.nn.logsumexp(self.kernel + row[..., :, None], axis=-2)


Step = Callable[[Problem, Potentials], Potentials]


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def _log_sum(kernel: Array, potential: Array, axis: int) -> Any:
    """Logarithm of the sums of exp(kernel + potential) over the axis that the potential has.

    Differentiating keeps what goes in and comes out, where `logsumexp` would keep a matrix.
    """
    return jax.nn.logsumexp(kernel + _along(potential, axis), axis=axis)


def _log_sum_forward(kernel: Array, potential: Array, axis: int) -> tuple[Any, Any]:
    # Not through the rule itself: JAX mixes up what is kept when a scan is differentiated twice.
    out = jax.nn.logsumexp(kernel + _along(potential, axis), axis=axis)
    return out, (kernel, potential, out)


def _log_sum_backward(axis: int, kept: Any, towards: Array) -> tuple[Array, Array]:
    kernel, potential, out = kept
    shares = jnp.exp(kernel + _along(potential, axis) - jnp.expand_dims(out, axis))
    shares = shares * jnp.expand_dims(towards, axis)
    return shares, shares.sum(axis=-3 - axis)


_log_sum.defvjp(_log_sum_forward, _log_sum_backward)


def _along(potential: Array, axis: int) -> Array:
    return jnp.expand_dims(potential, -3 - axis)


# HIGHEST: in the tensor cores' default of 10 bits the iteration does not converge.
_product = functools.partial(jnp.einsum, precision=jax.lax.Precision.HIGHEST)


def _exponentials(potential: Array) -> tuple[Array, Array]:
    """Those of the potential less its largest entry, and that entry."""
    top = jax.lax.stop_gradient(potential.max(axis=-1, keepdims=True))
    return jnp.exp(potential - top), top


def sinkhorn_step(
    problem: Problem,
    potentials: Potentials,
    *,
    relaxation: float = 1.0,
    row_tau: float = 1.0,
    column_tau: float = 1.0,
) -> Potentials:
    """Meet the columns' marginals, then the rows': one published iteration (paper Eq. 5).

    `relaxation` of w goes w times as far, in every entry where the dual does not lose by it
    (Thibault et al., Algorithms 2021, with one w for all entries). A `tau` below 1 relaxes the
    marginals of a side to a Kullback-Leibler penalty of weight epsilon * tau / (1 - tau) (Chizat
    et al., Math. Comp. 2018).
    """
    column = column_tau * (problem.log_nu - problem.over_rows(potentials.row))
    column = _further(potentials.column, column, relaxation, column_tau)
    row = row_tau * (problem.log_mu - problem.over_columns(column))
    return Potentials(_further(potentials.row, row, relaxation, row_tau), column)


def _further(old: Array, new: Array, relaxation: float, tau: float) -> Array:
    if relaxation == 1:
        return new
    change = new - old
    beyond = (relaxation - 1) * change
    # What the dual gains by this entry, over its mass at `new`.
    gain = jnp.exp(-change) - jnp.exp(beyond)
    if tau == 1:
        gain += relaxation * change
    else:
        penalty = tau / (1 - tau)
        gain += penalty * (jnp.exp(change / penalty) - jnp.exp(-beyond / penalty))
    # Infinity less infinity is no gain either.
    return jnp.where(gain >= 0, new + beyond, new)


def newton_step(problem: Problem, potentials: Potentials) -> Potentials:
    """Newton's method on the semi-dual, a concave function of the column potentials alone.

    With the rows' marginals always met (Brauer et al., 2017), the Hessian is a weighted graph
    Laplacian between columns. Of full and shortened steps, and of Sinkhorn's own, the one that
    leaves the smallest relative marginal error is taken, so that the error never grows.
    """
    column = potentials.column
    row = problem.log_mu - problem.over_columns(column)
    log_plan = _log_plan(problem.kernel, Potentials(row, column))
    over_rows = problem.over_rows(row)
    gradient = jnp.exp(problem.log_nu) - jnp.exp(over_rows + column)
    shares = jnp.exp(log_plan - problem.log_mu[..., None])
    step = _solve_columns(jnp.exp(log_plan), shares, gradient, 1.0, 1.0)
    lengths = jnp.array([1.0, 0.5, 0.25, 0.0625], step.dtype)
    tries = column + lengths.reshape(-1, *[1] * step.ndim) * step
    tries = jnp.concatenate([tries, (problem.log_nu - over_rows)[None]])

    def left(one: Array) -> Array:
        return _column_error(problem, problem.log_mu - problem.over_columns(one), one)

    errors = jax.lax.map(left, tries)
    best = jnp.argmin(jnp.where(jnp.isnan(errors), jnp.inf, errors), axis=0)
    column = jnp.take_along_axis(tries, best[None, ..., None], axis=0)[0]
    return Potentials(problem.log_mu - problem.over_columns(column), column)


def _column_error(problem: Problem, row: Array, column: Array) -> Float[Array, "*batch"]:
    """Largest difference of the logarithms of a column's mass and of its marginal."""
    return jnp.abs(problem.over_rows(row) + column - problem.log_nu).max(axis=-1)


def _solve_columns(
    plan: Array, shares: Array, target: Array, row_tau: float, column_tau: float
) -> Array:
    """The columns' part of the linear system of the optimality conditions.

    `plan` has the masses and `shares` each row's masses over their sum. The matrix is
    diag(masses / column_tau) - row_tau * shares^T plan, written as a Laplacian, which loses no
    digits to cancellation. Where both sides are balanced the last column's unknown is 0.
    """
    # The floor is for columns so far from all rows that their masses are 0.
    masses = jnp.maximum(plan.sum(axis=-2), jnp.finfo(plan.dtype).tiny ** 0.5)
    weights = _product("...nk,...nl->...kl", shares, plan)
    weights = row_tau * weights * (1 - jnp.eye(masses.shape[-1], dtype=plan.dtype))
    slack = 1 / column_tau - row_tau
    # What keeps clusters that share no row from dividing by zero.
    slack += 8 * jnp.finfo(plan.dtype).eps
    diagonal = weights.sum(axis=-1) + masses * slack
    if row_tau == column_tau == 1:
        diagonal = diagonal.at[..., -1].add(masses[..., -1])
    matrix = diagonal[..., None] * jnp.eye(masses.shape[-1], dtype=plan.dtype) - weights
    factor = jax.scipy.linalg.cho_factor(matrix)
    return jax.scipy.linalg.cho_solve(factor, target[..., None])[..., 0]


def _log_plan(kernel: Array, potentials: Potentials) -> Array:
    return kernel + potentials.row[..., :, None] + potentials.column[..., None, :]


class _Progress(NamedTuple):
    """An iteration in flight, for every problem of the batch."""

    potentials: Potentials
    memory: "_Memory | None"
    iterations: Int[Array, "*batch"]
    change: Float[Array, "*batch"]


class _Memory(NamedTuple):
    """What Anderson acceleration keeps: the last images of the step, and how far they moved."""

    start: Potentials
    images: Float[Array, "*batch memory size"]
    moves: Float[Array, "*batch memory size"]


def _iterate(problem: Problem, step: Step, config: SinkhornConfig) -> _Progress:
    """From zero potentials, a fixed number of steps or until none changes more than the tolerance.

    A problem that has converged stays as it is: what comes out owes nothing to its batch.
    """
    zeros = _zeros(problem.kernel)
    memory = None
    if config.anderson:
        empty = jnp.concatenate(zeros, axis=-1)[..., None, :].repeat(config.anderson, axis=-2)
        memory = _Memory(zeros, empty, empty)
    none = zeros.row[..., 0]
    at = _Progress(zeros, memory, none.astype(jnp.int32), none + jnp.inf)

    def advance(at: _Progress) -> _Progress:
        start = at.potentials if at.memory is None else at.memory.start
        moved = step(problem, start)
        change = _distance(problem, moved, start, config)
        memory = (
            None
            if at.memory is None
            else _accelerate(at.memory, moved, at.iterations.max(initial=0))
        )
        if config.tolerance is None:
            return _Progress(moved, memory, at.iterations + 1, change)
        active = at.change > config.tolerance
        kept = [
            jnp.where(active[..., None], new, old)
            for new, old in zip(moved, at.potentials, strict=True)
        ]
        return _Progress(
            Potentials(*kept), memory, at.iterations + active, jnp.where(active, change, at.change)
        )

    tolerance = config.tolerance
    if tolerance is not None:

        def unfinished(at: _Progress) -> Bool[Array, ""]:
            return ((at.change > tolerance) & (at.iterations < config.iterations)).any()

        return jax.lax.while_loop(unfinished, advance, at)
    if isinstance(problem, _ScalingProblem) and config.iterations <= UNROLLED:
        for _ in range(config.iterations):
            at = advance(at)
        return at
    return jax.lax.scan(lambda at, _: (advance(at), None), at, length=config.iterations)[0]


def _zeros(kernel: Array) -> Potentials:
    """Made of the kernel, so that under `shard_map` they vary as it does."""
    row = 0 * jax.lax.stop_gradient(kernel)[..., 0]
    return Potentials(row, jnp.repeat(row[..., :1], kernel.shape[-1], axis=-1))


def _distance(
    problem: Problem, new: Potentials, old: Potentials, config: SinkhornConfig
) -> Float[Array, "*batch"]:
    """Largest change of a potential: of a balanced step, the relative error that it mended.

    A step of Newton's may be small far from the solution: there it is the error that is left.
    """
    if config.method == "newton":
        return _column_error(problem, *new)
    row, column = new.row - old.row, new.column - old.column
    if config.balanced:
        # A constant that only goes from side to side. By masses: where the rows were met there is
        # none, to first order, and what is left is the error itself.
        shift = (jax.nn.softmax(problem.log_nu) * column).sum(axis=-1, keepdims=True)
        row, column = row + shift, column - shift
    return jnp.maximum(jnp.abs(row).max(axis=-1), jnp.abs(column).max(axis=-1))


def _centre(potentials: Potentials) -> Potentials:
    shift = potentials.column.mean(axis=-1, keepdims=True)
    return Potentials(potentials.row + shift, potentials.column - shift)


def _accelerate(memory: _Memory, moved: Potentials, count: Int[Array, ""]) -> _Memory:
    """Anderson's (J. ACM 1965) next start: the mixture of past images whose moves cancel best."""
    flat = functools.partial(jnp.concatenate, axis=-1)
    image = flat(moved)
    slots = memory.images.shape[-2]
    here = (jnp.arange(slots) == count % slots)[:, None]
    images = jnp.where(here, image[..., None, :], memory.images)
    moves = jnp.where(here, (image - flat(memory.start))[..., None, :], memory.moves)
    gram = jnp.einsum("...ik,...jk->...ij", moves, moves, precision=jax.lax.Precision.HIGHEST)
    filled = (jnp.arange(slots) <= count).astype(gram.dtype)
    scale = jnp.trace(gram, axis1=-2, axis2=-1)[..., None, None]
    # A constant to the gradient: the weights do not depend on it, and at rest its square is 0.
    scale = jax.lax.stop_gradient(jnp.maximum(scale, jnp.finfo(gram.dtype).tiny))
    # Empty slots get a weight of 0: their rows and columns are those of the identity.
    ridge = jnp.finfo(gram.dtype).eps * jnp.eye(slots, dtype=gram.dtype)
    gram = gram / scale + ridge + jnp.diag(1 - filled)
    weights = jnp.linalg.solve(
        gram, jnp.broadcast_to(filled, (*image.shape[:-1], slots))[..., None]
    )
    weights = weights[..., 0] * filled
    weights = weights / weights.sum(axis=-1, keepdims=True)
    mixed = _product("...i,...ik->...k", weights, images)
    mixed = jnp.where(jnp.isfinite(mixed).all(axis=-1, keepdims=True), mixed, image)
    rows = moved.row.shape[-1]
    return _Memory(Potentials(mixed[..., :rows], mixed[..., rows:]), images, moves)


class _Solution(NamedTuple):
    """All floats: of a custom rule's whole numbers and flags JAX still asks for derivatives."""

    potentials: Potentials
    iterations: Float[Array, "*batch"]
    converged: Float[Array, "*batch"]


class _Scaled(NamedTuple):
    """The scores of the scaling domain."""

    row_max: Float[Array, "*batch rows"]
    gibbs: Float[Array, "*batch rows columns-1"]
    """exp(kernel - row_max); where that does not do, the kernel: one matrix for both."""
    last: Float[Array, "*batch rows"]


def _scale(kernel: Array) -> tuple[Bool[Array, ""], _Scaled]:
    """Whether the scores are close enough to one another for the scaling domain, and its own."""
    clusters, last = _split(kernel)
    fixed = jax.lax.stop_gradient((clusters, last))
    row_max = jnp.maximum(fixed[0].max(axis=-1, initial=-jnp.inf), fixed[1])
    row_min = jnp.minimum(fixed[0].min(axis=-1, initial=jnp.inf), fixed[1])
    fits = (row_max - row_min).max(initial=0) < SCALING_RANGE

    gibbs = jnp.where(fits, jnp.exp(clusters - row_max[..., None]), clusters)
    return fits, _Scaled(row_max, gibbs, jnp.where(fits, jnp.exp(last - row_max), last))


def _scaling(problem: Problem, fits: Bool[Array, ""], scaled: _Scaled) -> Problem:
    return _ScalingProblem(problem.kernel, problem.log_mu, problem.log_nu, fits, *scaled)


def _unscaled(scaled: _Scaled, log_mu: Array, log_nu: Array) -> Problem:
    """In the log domain, where the scores do not fit."""
    return Problem(_join(scaled.gibbs, scaled.last), log_mu, log_nu)


def _split(kernel: Array) -> tuple[Array, Array]:
    """All columns but the last, and the last."""
    return kernel[..., :-1], kernel[..., -1]


def _join(clusters: Array, last: Array) -> Array:
    return jnp.concatenate([clusters, last[..., None]], axis=-1)


def _solve(problem: Problem, step: Step, config: SinkhornConfig) -> _Solution:
    """Iterate in the configured domain; scaling falls back where the scores are too far apart."""
    if config.domain == "log":
        return _run(problem, step, config)
    fits, scaled = _scale(problem.kernel)
    return jax.lax.cond(
        fits,
        lambda: _run(_scaling(problem, fits, scaled), step, config),
        lambda: _run(problem, step, config),
    )


def _run(problem: Problem, step: Step, config: SinkhornConfig) -> _Solution:
    at = _iterate(problem, step, config)
    finite = jnp.isfinite(at.change)
    met = finite if config.tolerance is None else at.change <= config.tolerance
    potentials = at.potentials
    if config.relaxation != 1:
        # Left too far by the last step, rows could have more mass than a float can hold.
        row = config.row_tau * (problem.log_mu - problem.over_columns(potentials.column))
        potentials = Potentials(row, potentials.column)
    dtype = potentials.row.dtype
    return _Solution(potentials, at.iterations.astype(dtype), met.astype(dtype))


class _Towards(NamedTuple):
    """Gradients of what comes out."""

    log_plan: Float[Array, "*batch rows columns"]
    potentials: Potentials


@functools.partial(jax.custom_vjp, nondiff_argnums=(1, 2))
def _unrolled(problem: Problem, step: Step, config: SinkhornConfig) -> Any:
    """The plan's logarithm and the `_Solution`, differentiated through the iterations.

    By itself JAX would keep what either domain needs for its gradient: many matrices. Here it is
    one, as the plan is part of the rule: its gradient is added to where it comes in.
    """
    solution = _solve(problem, step, config)
    return _log_plan(problem.kernel, solution.potentials), solution


def _unrolled_forward(
    problem: Problem, step: Step, config: SinkhornConfig
) -> tuple[tuple[Array, _Solution], Any]:
    differentiable, problem = problem, jax.lax.stop_gradient(problem)

    def out(log_plan: Array, solution: _Solution, *kept: Any) -> tuple[Any, Any]:
        return _replayed(differentiable, log_plan, solution, step, config), (differentiable, *kept)

    if config.domain == "log":
        solution, pull = _pull(step, config, problem)
        return out(_log_plan(problem.kernel, solution.potentials), solution, None, pull)
    fits, scaled = _scale(problem.kernel)

    def start(problem: Problem, gibbs: Array, last: Array) -> Problem:
        return _scaling(problem, fits, scaled._replace(gibbs=gibbs, last=last))

    # The kernel as well: a step of the user's own may read it.
    found, pull = _pull(step, config, problem, scaled.gibbs, scaled.last, start=start)

    def again() -> _Solution:
        def one(at: tuple[_Scaled, Array, Array]) -> _Solution:
            return _run(_unscaled(*at), step, config)

        batch = found.converged.shape
        at = _flat((scaled, problem.log_mu, problem.log_nu), batch)
        out = jax.lax.map(one, at, batch_size=FALLBACK_BATCH)
        return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), out)

    solution = jax.lax.cond(fits, lambda: found, again)
    clusters, last = _split(problem.kernel)
    row, column = solution.potentials
    clusters = clusters + row[..., None] + column[..., None, :-1]
    log_plan = _join(clusters, last + row + column[..., -1:])
    return out(log_plan, solution, (fits, scaled), pull)


def _flat(tree: Any, batch: tuple[int, ...]) -> Any:
    """With one axis for all of the batch."""
    count = math.prod(batch)
    return jax.tree.map(lambda x: x.reshape(count, *x.shape[len(batch) :]), tree)


def _pull(
    step: Step,
    config: SinkhornConfig,
    *inputs: Any,
    start: Callable[..., Problem] = lambda problem: problem,
) -> tuple[_Solution, Any]:
    """The iterations, and the function that takes their gradient back to the inputs.

    `start` makes the problem of the inputs.
    """

    def solve(*inputs: Any) -> tuple[Potentials, _Solution]:
        solution = _run(start(*inputs), step, config)
        return solution.potentials, solution

    _, pull, solution = jax.vjp(solve, *inputs, has_aux=True)
    return solution, pull


def _unrolled_backward(
    step: Step, config: SinkhornConfig, kept: Any, towards: tuple[Array, _Solution]
) -> tuple[Problem]:
    problem, scaled, pull = kept
    log_plan, solution = towards
    both = _Towards(log_plan, solution.potentials)
    return (_pull_back(problem, both, scaled, pull, step, config),)


_unrolled.defvjp(_unrolled_forward, _unrolled_backward)


@functools.partial(jax.custom_vjp, nondiff_argnums=(4, 5))
def _pull_back(
    problem: Problem,
    towards: _Towards,
    scaled: tuple[Bool[Array, ""], _Scaled] | None,
    pull: Any,
    step: Step,
    config: SinkhornConfig,
) -> Any:
    """The gradients of the problem, in its form."""
    row, column = towards.potentials
    clusters, last = _split(towards.log_plan)
    row = row + clusters.sum(axis=-1) + last
    column = column + _join(clusters.sum(axis=-2), last.sum(axis=-1))
    into = Potentials(row, column)
    if scaled is None:
        (bars,) = pull(into)
        return dataclasses.replace(bars, kernel=towards.log_plan + bars.kernel)
    fits, parts = scaled
    of_problem, of_gibbs, of_last = pull(into)
    bars = _apart(of_problem)
    bars[0] += parts.gibbs * of_gibbs
    bars[1] += parts.last * of_last
    bars = [jnp.where(fits, bar, 0) for bar in bars]
    bars[:2] = clusters + bars[0], last + bars[1]
    batch = row.shape[:-1]
    at, flat = _flat((parts, problem.log_mu, problem.log_nu, into), batch), _flat(bars, batch)

    def mend(state: tuple[Array, Any]) -> tuple[Array, Any]:
        index, bars = state
        *one, into = jax.tree.map(lambda x: x[index], at)
        _, pull = _pull(step, config, _unscaled(*one))
        new = _apart(*pull(into))
        return index + 1, jax.tree.map(lambda x, y: x.at[index].add(y), bars, new)

    # In place and one by one, where a branch would have memory of its own.
    problems = math.prod(batch)
    index = jnp.where(fits, problems, 0)
    if problems:
        _, flat = jax.lax.while_loop(lambda state: state[0] < problems, mend, (index, flat))
    clusters, last, log_mu, log_nu = (x.reshape(y.shape) for x, y in zip(flat, bars, strict=True))
    return Problem(_join(clusters, last), log_mu, log_nu)


def _apart(problem: Problem) -> list[Array]:
    """All columns but the last, the last, and the marginals."""
    return [*_split(problem.kernel), problem.log_mu, problem.log_nu]


def _pull_back_forward(
    problem: Problem,
    towards: _Towards,
    scaled: tuple[Bool[Array, ""], _Scaled] | None,
    pull: Any,
    step: Step,
    config: SinkhornConfig,
) -> tuple[Any, tuple[Problem, _Towards]]:
    return _pull_back(problem, towards, scaled, pull, step, config), (problem, towards)


def _pull_back_backward(
    step: Step, config: SinkhornConfig, kept: tuple[Problem, _Towards], towards: Problem
) -> tuple[Problem, _Towards, None, None]:
    def plain(problem: Problem, towards: _Towards) -> Problem:
        return _replay(problem, step, config)(towards)[0]

    return *jax.vjp(plain, *kept)[1](towards), None, None


def _replay(problem: Problem, step: Step, config: SinkhornConfig) -> Any:
    """What takes gradients back to the problem by JAX alone, in the log domain.

    It is for gradients of gradients. By JAX's own rules those of scans kept in `pull` go wrong, and
    what the scaling domain makes of scores that do not fit would be in them.
    """

    def solve(problem: Problem) -> _Towards:
        potentials = _run(problem, step, config).potentials
        return _Towards(_log_plan(problem.kernel, potentials), potentials)

    return jax.vjp(solve, problem)[1]


_pull_back.defvjp(_pull_back_forward, _pull_back_backward)


@functools.partial(jax.custom_vjp, nondiff_argnums=(3, 4))
def _replayed(
    problem: Problem, log_plan: Array, solution: _Solution, step: Step, config: SinkhornConfig
) -> Any:
    """The plan and the solution, of this problem, as they are."""
    return log_plan, solution


def _replayed_forward(
    problem: Problem, log_plan: Array, solution: _Solution, step: Step, config: SinkhornConfig
) -> tuple[Any, Problem]:
    return (log_plan, solution), problem


def _replayed_backward(
    step: Step, config: SinkhornConfig, problem: Problem, towards: tuple[Array, _Solution]
) -> tuple[Problem, None, None]:
    log_plan, solution = towards
    (bars,) = _replay(problem, step, config)(_Towards(log_plan, solution.potentials))
    return bars, None, None


_replayed.defvjp(_replayed_forward, _replayed_backward)


@functools.partial(jax.custom_vjp, nondiff_argnums=(3, 4))
def _implicit(
    kernel: Array, log_mu: Array, log_nu: Array, step: Step, config: SinkhornConfig
) -> Any:
    """The `_Solution`, differentiated by the optimality conditions: no iteration is remembered."""
    return _solve(Problem(kernel, log_mu, log_nu), step, config)


def _implicit_forward(
    kernel: Array, log_mu: Array, log_nu: Array, step: Step, config: SinkhornConfig
) -> tuple[_Solution, tuple[Array, Potentials]]:
    # Through the rule itself, so that it may be differentiated again.
    solution: Any = _implicit(kernel, log_mu, log_nu, step, config)
    return solution, (kernel, solution.potentials)


def _implicit_backward(
    step: Step, config: SinkhornConfig, kept: tuple[Array, Potentials], towards: _Solution
) -> tuple[Array, Array, Array]:
    """Solve the transposed linearised conditions (see docs/sinkhorn.md, "Implicit gradient")."""
    kernel, potentials = kept
    log_plan = _log_plan(kernel, potentials)
    # All masses over the largest, which changes nothing of what comes out: relaxed ones may be more
    # than a float can hold.
    top = jax.lax.stop_gradient(log_plan.max(axis=(-2, -1), keepdims=True))
    plan = jnp.exp(log_plan - top)
    shares = jax.nn.softmax(log_plan, axis=-1)
    row, column = towards.potentials
    target = column - config.row_tau * _product("...nk,...n->...k", shares, row)
    along_column = _solve_columns(plan, shares, target, config.row_tau, config.column_tau)
    masses = plan.sum(axis=-2)
    if config.balanced:
        # Where the masses' totals change alone, rows are met and columns follow, as in iterations.
        shift = (masses * along_column).sum(axis=-1) / masses.sum(axis=-1)
        along_column = along_column - shift[..., None]
    along_row = config.row_tau * (row - _product("...nk,...k->...n", plan, along_column))
    kernel_bar = -(shares * along_row[..., :, None] + plan * along_column[..., None, :])
    return kernel_bar, along_row, masses * along_column


_implicit.defvjp(_implicit_forward, _implicit_backward)


def _by_optimistix(
    kernel: Array, log_mu: Array, log_nu: Array, step: Step, config: SinkhornConfig, solver: Any
) -> _Solution:
    """A fixed point by any solver of optimistix, differentiated by its implicit adjoint."""
    import lineax
    import optimistix

    if solver is None:
        tolerance = config.tolerance or 0.0  # never None: see SinkhornConfig
        solver = optimistix.FixedPointIteration(rtol=0.0, atol=tolerance)

    def one(kernel: Array, log_mu: Array, log_nu: Array) -> _Solution:
        def again(potentials: Potentials, problem: Problem) -> Potentials:
            moved = step(problem, potentials)
            # Centred, for a fixed point that is unique.
            return _centre(moved) if config.balanced else moved

        start = _zeros(kernel)
        found = optimistix.fixed_point(
            again,
            solver,
            start,
            args=_PlainProblem(kernel, log_mu, log_nu),
            max_steps=config.iterations,
            adjoint=optimistix.ImplicitAdjoint(lineax.AutoLinearSolver(well_posed=True)),
            throw=False,
        )
        return _Solution(
            found.value,
            jnp.asarray(found.stats["num_steps"], kernel.dtype),
            (found.result == optimistix.RESULTS.successful).astype(kernel.dtype),
        )

    for _ in kernel.shape[:-2]:
        one = jax.vmap(one)
    return one(kernel, log_mu, log_nu)


def sinkhorn(
    scores: Float[Array, "*batch rows columns"],
    log_mu: Float[Array, "*#batch rows"],
    log_nu: Float[Array, "*#batch columns"],
    *,
    epsilon: float | Float[Array, ""] = 1.0,
    config: SinkhornConfig = SinkhornConfig(),
    step: Step | None = None,
    solver: Any = None,
) -> SinkhornResult:
    """Transport plan of largest <plan, scores> + epsilon * entropy for the given marginals (Eq. 5).

    By default the published algorithm: three times the two projections, columns first and rows
    last, from zero potentials. `epsilon` is an argument of its own, not read from `config`, so that
    it may be traced or learnt. Scores of half precision are widened to float32.

    Args:
        scores: finite; what a row gains by going to a column.
        log_mu: logarithms of the rows' masses.
        log_nu: logarithms of the columns' masses; for balanced transport they sum to the same.
        epsilon: entropic regularisation, above 0.
        config: the variant, static.
        step: in place of the built-in step. Iteration, tolerance, acceleration and diagnostics
            work as before; its gradient is "unrolled", "optimistix" or "stop". Static: another
            function object is compiled anew. Values that are to be differentiated may be closed
            over with "optimistix" alone. One that does not meet the marginals needs a `row_tau` or
            `column_tau` below 1, to say so.
        solver: an optimistix solver, where `config.gradient` is "optimistix".

    Raises:
        InputError: shapes that do not fit, numbers that are not real, a step or solver that the
            configuration has no use for, a step that returns anything but such potentials;
            and where values are known (outside of `jit` and `grad`): scores that are not finite,
            masses that sum to different totals, an epsilon of 0 or less or too small.
        RuntimeError: `config.must_converge`, and a tolerance was not met. Inside of `jit` it is
            raised while the compiled program runs, among lines of JAX's own, and only if it uses
            a value of the result.
    """
    scores, log_mu, log_nu = jnp.asarray(scores), jnp.asarray(log_mu), jnp.asarray(log_nu)
    _check(scores, log_mu, log_nu, epsilon, config, step, solver)
    # Not to compile anew for an epsilon that is not read from there.
    config = dataclasses.replace(config, epsilon=1.0)
    if solver is None:
        result = _compiled(scores, log_mu, log_nu, epsilon, config, step)
    else:
        # A solver need not be hashable.
        result = _solved(scores, log_mu, log_nu, epsilon, config, step, solver)
    return _require_converged(result, config) if config.must_converge else result


def _solved(
    scores: Array,
    log_mu: Array,
    log_nu: Array,
    epsilon: float | Array,
    config: SinkhornConfig,
    step: Step | None,
    solver: Any = None,
) -> SinkhornResult:
    wide = _wide(scores)
    kernel = scores.astype(wide) / jnp.asarray(epsilon, wide)
    # Broadcast so, they vary over devices as the kernel does.
    zeros = _zeros(kernel)
    log_mu, log_nu = log_mu.astype(wide) + zeros.row, log_nu.astype(wide) + zeros.column
    if config.method in ("softmax", "dual-softmax"):
        return _softmax(kernel, log_mu, log_nu, config)
    if step is not None:
        _check_step(step, Problem(kernel, log_mu, log_nu))
    elif config.method == "newton":
        step = newton_step
    else:
        step = functools.partial(
            sinkhorn_step,
            relaxation=config.relaxation,
            row_tau=config.row_tau,
            column_tau=config.column_tau,
        )
    solution: Any  # what custom_vjp returns has no type for the checker
    if config.gradient == "unrolled":
        both: Any = _unrolled(Problem(kernel, log_mu, log_nu), step, config)
        log_plan, solution = both
    else:
        if config.gradient == "implicit":
            solution = _implicit(kernel, log_mu, log_nu, step, config)
        elif config.gradient == "optimistix":
            solution = _by_optimistix(kernel, log_mu, log_nu, step, config, solver)
        else:
            fixed = jax.lax.stop_gradient((kernel, log_mu, log_nu))
            solution = _solve(Problem(*fixed), step, config)
        log_plan = _log_plan(kernel, solution.potentials)
    potentials = solution.potentials
    iterations = jax.lax.stop_gradient(solution.iterations).astype(jnp.int32)
    converged = jax.lax.stop_gradient(solution.converged) > 0
    if config.balanced:
        potentials = _centre(potentials)
    errors = marginal_error(log_plan, log_mu, log_nu)
    if config.balanced and config.tolerance is not None:
        # The tolerance is one of logarithms, whose last places are a few epsilon.
        most = math.expm1(config.tolerance) + 16 * jnp.finfo(wide).eps
        converged &= jnp.maximum(*errors) <= most
    return SinkhornResult(log_plan, potentials, *errors, iterations, converged)


_compiled = jax.jit(_solved, static_argnames=("config", "step"))


def _require_converged(result: SinkhornResult, config: SinkhornConfig) -> SinkhornResult:
    message = f"sinkhorn: no convergence to {config.tolerance} in {config.iterations} iterations"
    if isinstance(result.converged, Tracer):
        import equinox

        return equinox.error_if(result, ~result.converged.all(), message)
    missed = int((~result.converged).sum())
    if missed:
        raise RuntimeError(f"{message} for {missed} of {result.converged.size} problems")
    return result


def _softmax(kernel: Array, log_mu: Array, log_nu: Array, config: SinkhornConfig) -> SinkhornResult:
    """The baselines that transport nothing: rows shared out, or rows' times columns' shares."""
    row, column = -jax.nn.logsumexp(kernel, axis=-1), jnp.zeros_like(log_nu)
    log_plan = kernel + row[..., None] + log_mu[..., None]
    if config.method == "dual-softmax":
        column = -jax.nn.logsumexp(kernel, axis=-2)
        log_plan = 2 * kernel + row[..., None] + column[..., None, :]
    else:
        row = row + log_mu
    batch = kernel.shape[:-2]
    return SinkhornResult(
        log_plan,
        Potentials(row, column),
        *marginal_error(log_plan, log_mu, log_nu),
        jnp.zeros(batch, jnp.int32),
        jnp.isfinite(row).all(axis=-1),
    )


def marginal_error(
    log_plan: Float[Array, "*batch rows columns"],
    log_mu: Float[Array, "*#batch rows"],
    log_nu: Float[Array, "*#batch columns"],
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Largest relative error of the row masses and of the column masses of a plan."""
    rows = jnp.expm1(jax.nn.logsumexp(log_plan, axis=-1) - log_mu)
    columns = jnp.expm1(jax.nn.logsumexp(log_plan, axis=-2) - log_nu)
    return jnp.abs(rows).max(axis=-1), jnp.abs(columns).max(axis=-1)


def append_dustbin(
    scores: Float[Array, "*batch rows clusters"],
    dustbin: float | Float[Array, ""] | Float[Array, "*batch rows"],
) -> Float[Array, "*batch rows clusters+1"]:
    """Append a column of the dustbin's score, one for all rows (paper Eq. 4) or one a row.

    Raises:
        InputError: neither a number nor as many as there are rows.
    """
    column = jnp.asarray(dustbin).astype(scores.dtype)
    if column.shape not in ((), scores.shape[:-1]):
        raise InputError(f"dustbin: found shape {column.shape}, expected () or {scores.shape[:-1]}")
    column = jnp.broadcast_to(column[..., None] if column.ndim else column, (*scores.shape[:-1], 1))
    return jnp.concatenate([scores, column], axis=-1)


def log_marginals(
    rows: int, clusters: int, dtype: jnp.dtype | type = jnp.float32
) -> tuple[Float[Array, " {rows}"], Float[Array, " {clusters}+1"]]:
    """SALAD's marginals, as logarithms: each row has mass 1, each cluster 1, the dustbin the rest.

    Raises:
        InputError: the dustbin's mass, `rows - clusters`, is not positive.
    """
    if rows <= clusters:
        raise InputError(
            f"transport: found {rows} patches for {clusters} clusters, expected more patches than "
            "clusters: the dustbin's mass is their difference"
        )
    log_mu = jnp.zeros(rows, dtype)
    log_nu = jnp.zeros(clusters + 1, dtype).at[-1].set(math.log(rows - clusters))
    return log_mu, log_nu


def assign(
    scores: Float[Array, "*batch patches clusters"],
    dustbin: float | Float[Array, ""] | Float[Array, "*batch patches"] | None,
    config: SinkhornConfig = SinkhornConfig(),
) -> SinkhornResult:
    """Assignment of patches to clusters as `config.dustbin` says, a dustbin in the last column.

    Args:
        scores: of each patch for each cluster.
        dustbin: "column", "row and column": the score of one; "token": a score a patch; "mass": the
            logit of the dustbin's share of all mass, the rest being shared by the clusters alike;
            "none": None, and the patches' mass is shared by the clusters alike.
        config: the variant.

    Raises:
        InputError: no more patches than clusters, where the dustbin's mass is their difference;
            scores without two axes, or of none; or a dustbin of another shape than the variant's.
    """
    kind = config.dustbin
    if scores.ndim < 2 or 0 in scores.shape[-2:]:
        raise InputError(
            f"assign: found scores of shape {scores.shape}, expected (..., patches, clusters)"
        )
    rows, clusters = scores.shape[-2:]
    if dustbin is not None:
        dustbin = jnp.asarray(dustbin)
    wanted = {"none": None, "token": scores.shape[:-1]}.get(kind, ())
    found = None if dustbin is None else dustbin.shape
    if found != wanted:
        raise InputError(f"dustbin: found shape {found}, expected {wanted} for {kind!r}")
    full = scores.astype(_wide(scores))
    log_mu = jnp.zeros(rows, full.dtype)
    if dustbin is None:
        log_nu = jnp.full(clusters, math.log(rows / clusters), full.dtype)
    elif kind == "mass":
        share = jax.nn.log_sigmoid(jnp.stack([-dustbin, dustbin])).astype(full.dtype)
        share = share + math.log(rows)
        log_nu = jnp.append(jnp.broadcast_to(share[0] - math.log(clusters), clusters), share[1])
        full = append_dustbin(full, jnp.zeros_like(dustbin))
    elif kind == "row and column":
        full = append_dustbin(full, dustbin)
        last = jnp.broadcast_to(dustbin.astype(full.dtype), (*full.shape[:-2], 1, clusters + 1))
        full = jnp.concatenate([full, last], axis=-2)
        log_mu = jnp.append(log_mu, math.log(clusters))
        log_nu = jnp.zeros(clusters + 1, full.dtype).at[-1].set(math.log(rows))
    else:
        full = append_dustbin(full, dustbin)
        log_mu, log_nu = log_marginals(rows, clusters, full.dtype)
    result = sinkhorn(full, log_mu, log_nu, epsilon=config.epsilon, config=config)
    # All but the dustbin's own row.
    return result._replace(log_plan=result.log_plan[..., :rows, :])


def _check(
    scores: Array,
    log_mu: Array,
    log_nu: Array,
    epsilon: float | Array,
    config: SinkhornConfig,
    step: Step | None,
    solver: Any,
) -> None:
    marginals = (("log_mu", log_mu, -2, "rows"), ("log_nu", log_nu, -1, "columns"))
    for name, marginal, axis, side in marginals:
        target = (*scores.shape[:-2], *scores.shape[axis:][:1])
        if scores.ndim < 2 or 0 in scores.shape[-2:] or not _spreads(marginal.shape, target):
            raise InputError(
                f"sinkhorn: found scores of shape {scores.shape} and {name} of {marginal.shape}, "
                f"expected (..., rows, columns) and (..., {side})"
            )
    if jnp.ndim(epsilon):
        raise InputError(
            f"sinkhorn: epsilon found of shape {jnp.shape(epsilon)}, expected a single number"
        )
    if step is not None and (config.gradient == "implicit" or config.method != "sinkhorn"):
        raise InputError(
            f"sinkhorn: found a step beside method {config.method!r} and gradient "
            f"{config.gradient!r}, expected method 'sinkhorn' and gradient 'unrolled', "
            "'optimistix' or 'stop': the closed form is that of the built-in step"
        )
    if solver is not None and config.gradient != "optimistix":
        raise InputError(
            f"sinkhorn: found a solver beside gradient {config.gradient!r}, expected 'optimistix'"
        )
    if step is not None and config.relaxation != 1:
        raise InputError(
            f"sinkhorn: found a step beside relaxation {config.relaxation}, expected 1: it is the "
            "built-in step that relaxation belongs to"
        )
    arrays = {"scores": scores, "log_mu": log_mu, "log_nu": log_nu}
    for name, value in arrays.items():
        if jnp.iscomplexobj(value):
            raise InputError(f"sinkhorn: {name} found of {value.dtype}, expected real numbers")
    known = {
        name: np.asarray(value, np.float64)
        for name, value in arrays.items()
        if not isinstance(value, Tracer)
    }
    for name, value in known.items():
        if not np.isfinite(value).all():
            raise InputError(
                f"sinkhorn: {name} found with NaN or infinity, expected finite numbers"
            )
    if not isinstance(epsilon, Tracer):
        if not float(epsilon) > 0:
            raise InputError(f"sinkhorn: epsilon found {epsilon}, expected more than 0")
        largest = np.abs(known.get("scores", np.zeros(()))).max(initial=0) / float(epsilon)
        if largest > jnp.finfo(_wide(scores)).max:
            raise InputError(
                f"sinkhorn: epsilon found {epsilon}, with which scores over it are up to "
                f"{largest:.1e}, expected numbers that {_wide(scores)} can hold"
            )
    if config.balanced and {"log_mu", "log_nu"} <= known.keys():
        totals = [np.exp(known[name]).sum(axis=-1) for name in ("log_mu", "log_nu")]
        # Sums of float32 logarithms.
        unlike = ~np.isclose(*totals, rtol=1e-4)
        if unlike.any():
            worst = [np.broadcast_to(total, unlike.shape)[unlike][0] for total in totals]
            found = " and ".join(f"{total:.6g}" for total in worst)
            raise InputError(
                f"sinkhorn: masses exp(log_mu) and exp(log_nu) found to sum to {found}, "
                "expected the same"
            )


def _check_step(step: Step, problem: Problem) -> None:
    expected = jax.eval_shape(_zeros, problem.kernel)
    found = jax.eval_shape(step, problem, expected)
    kinds = [[(x.shape, x.dtype) for x in jax.tree.leaves(one)] for one in (found, expected)]
    if not isinstance(found, Potentials) or kinds[0] != kinds[1]:
        raise InputError(f"sinkhorn: step found to return {found}, expected {expected}")


def _wide(scores: Array) -> jnp.dtype:
    """What is computed in: float32, or the scores' own precision above it."""
    return jnp.promote_types(scores.dtype, jnp.float32)


def _spreads(shape: tuple[int, ...], target: tuple[int, ...]) -> bool:
    """Whether an array of `shape` broadcasts to `target`, its last axis being there already."""
    leading = zip(reversed(shape[:-1]), reversed(target[:-1]), strict=False)
    return (
        shape[-1:] == target[-1:]
        and len(shape) <= len(target)
        and all(size in (1, wanted) for size, wanted in leading)
    )
