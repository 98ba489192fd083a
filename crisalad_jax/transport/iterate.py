"""Iterate a fixed number of steps, or until the step's error is within the tolerance."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from crisalad_jax.transport.accelerate import Memory, accelerate, empty_memory
from crisalad_jax.transport.config import SinkhornConfig, Solution
from crisalad_jax.transport.problem import (
    Potentials,
    Problem,
    ScalingProblem,
    zero_potentials,
)
from crisalad_jax.utils.target import target

UNROLLED = 8
"""Largest number of iterations that are unrolled for an accelerator's compiler; more are a scan, as
all are on a CPU, which is as fast and compiles less."""


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
    """Iterate a step on a problem, without a gradient rule of its own.

    A problem that has converged no longer changes, so the result does not depend on its batch.

    Args:
        problem: scores and marginals.
        config: the step, the number of iterations, and when to stop.
        params: what the step learns.
        init: potentials to start from; None starts from zeros.

    Returns:
        The potentials, how many iterations it took, and whether the tolerance was met.

    Raises:
        InputError: while tracing, for a step that returns other potentials than it was given.

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
            # Out of its range the scaling domain is not waited for: the log domain solves again.
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
