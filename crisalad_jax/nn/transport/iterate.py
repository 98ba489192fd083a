"""Iterate a fixed number of steps, or until the step's error is within the tolerance.

Optionally, accelerate the potentials by Anderson's method (J. ACM 1965).
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from crisalad_jax.nn.transport.config import SinkhornConfig, Solution
from crisalad_jax.nn.transport.problem import (
    Potentials,
    Problem,
    ScalingProblem,
    product,
    zero_potentials,
)
from crisalad_jax.utils.target import target

UNROLLED = 8
"""Largest number of iterations that are unrolled on an accelerator; more become a scan. On a
CPU all are a scan, which is as fast and compiles faster."""


_flat = functools.partial(jnp.concatenate, axis=-1)


class Memory(NamedTuple):
    """The results of the last steps (`images`), and these minus their starts (`moves`)."""

    start: Potentials
    """Potentials from which the next step starts."""
    images: Float[Array, "*batch memory size"]
    moves: Float[Array, "*batch memory size"]


def empty_memory(start: Potentials, size: int) -> Memory:
    """Return an empty memory with room for `size` iterations."""
    images = _flat(start)[..., None, :].repeat(size, axis=-2)
    # Moves of 0: a start that is not 0 would otherwise count in the weights of the first steps.
    return Memory(start, images, 0 * images)


def accelerate(memory: Memory, moved: Potentials, count: Int[Array, ""]) -> Memory:
    """Store a step, and start the next from the mixture of past results with the least residual.

    Args:
        memory: the previous steps.
        moved: the potentials that the step returned for `memory.start`.
        count: number of steps before this one.
    """
    image = _flat(moved)
    slots = memory.images.shape[-2]
    here = (jnp.arange(slots) == count % slots)[:, None]
    images = jnp.where(here, image[..., None, :], memory.images)
    moves = jnp.where(here, (image - _flat(memory.start))[..., None, :], memory.moves)
    gram = product("...ik,...jk->...ij", moves, moves)
    filled = (jnp.arange(slots) <= count).astype(gram.dtype)
    scale = jnp.trace(gram, axis1=-2, axis2=-1)[..., None, None]
    # Stop its gradient: the weights do not depend on it, and at convergence its square is 0.
    scale = jax.lax.stop_gradient(jnp.maximum(scale, jnp.finfo(gram.dtype).tiny))
    # Rows and columns of the identity give empty slots a weight of 0.
    ridge = jnp.finfo(gram.dtype).eps * jnp.eye(slots, dtype=gram.dtype)
    gram = gram / scale + ridge + jnp.diag(1 - filled)
    ones = jnp.broadcast_to(filled, (*image.shape[:-1], slots))[..., None]
    weights = jnp.linalg.solve(gram, ones)[..., 0] * filled
    weights = weights / weights.sum(axis=-1, keepdims=True)
    mixed = product("...i,...ik->...k", weights, images)
    mixed = jnp.where(jnp.isfinite(mixed).all(axis=-1, keepdims=True), mixed, image)
    rows = moved.row.shape[-1]
    return Memory(Potentials(mixed[..., :rows], mixed[..., rows:]), images, moves)


class _Progress(NamedTuple):
    """The state of the iteration, for every problem of the batch."""

    potentials: Potentials
    state: Any
    memory: Memory | None
    count: Int[Array, ""]
    iterations: Int[Array, "*batch"]
    error: Float[Array, "*batch"]


def iterate(
    problem: Problem, config: SinkhornConfig, params: Any = None, init: Potentials | None = None
) -> Solution:
    """Iterate a step on a problem, without a custom gradient rule.

    A problem that has converged no longer changes, so the result does not depend on its batch.

    Args:
        problem: scores and marginals.
        config: the step, the number of iterations, and when to stop.
        params: learnt parameters of the step; None if it has none.
        init: potentials to start from; None starts from zeros.

    Returns:
        The potentials, how many iterations it took, and whether the tolerance was met.

    Example:
        >>> import jax.numpy as jnp
        >>> from crisalad_jax.sinkhorn import Problem, SinkhornConfig
        >>> problem = Problem.of(jnp.eye(2), jnp.zeros(2), jnp.zeros(2))
        >>> int(iterate(problem, SinkhornConfig(iterations=5)).iterations)
        5
    """
    step, tolerance = config.step, config.tolerance
    start = problem.zeros() if init is None else problem.masked(init)
    none = zero_potentials(problem.kernel).row[..., 0]
    progress = _Progress(
        potentials=start,
        state=step.init(problem, params),
        memory=empty_memory(start, config.anderson_memory) if config.anderson_memory else None,
        count=jnp.zeros((), jnp.int32),
        iterations=none.astype(jnp.int32),
        error=none + jnp.inf,
    )

    def advance(at: _Progress) -> _Progress:
        old = at.potentials if at.memory is None else at.memory.start
        new, state = step.step(problem, old, at.state, at.count)
        new = problem.masked(new)
        error = step.error(problem, new, old)
        memory = None
        if at.memory is not None:
            memory = accelerate(at.memory, new, at.count)
            memory = memory._replace(start=problem.masked(memory.start))
        active = jnp.ones_like(none, bool) if tolerance is None else at.error > tolerance
        if tolerance is not None:
            new = jax.tree.map(lambda a, b: jnp.where(active[..., None], a, b), new, at.potentials)
            error = jnp.where(active, error, at.error)
        return _Progress(new, state, memory, at.count + 1, at.iterations + active, error)

    if tolerance is not None:

        def unfinished(at: _Progress) -> Bool[Array, ""]:
            active = (at.error > tolerance) & (at.iterations < config.iterations)
            # Out of range, the scaling domain stops early: the log domain solves again.
            return active.any() & (not isinstance(problem, ScalingProblem) or problem.in_range)

        progress = jax.lax.while_loop(unfinished, advance, progress)
    elif (
        isinstance(problem, ScalingProblem)
        and config.iterations <= UNROLLED
        and target().platform != "cpu"
    ):
        for _ in range(config.iterations):
            progress = advance(progress)
    else:
        # In the log domain a step stores matrices for its gradient: recompute them (remat).
        again = advance if isinstance(problem, ScalingProblem) else jax.checkpoint(advance)
        progress, _ = jax.lax.scan(
            lambda at, _: (again(at), None), progress, length=config.iterations
        )
    met = progress.error <= (-jnp.inf if tolerance is None else tolerance)
    return Solution(step.finish(problem, progress.potentials), progress.iterations, met)
