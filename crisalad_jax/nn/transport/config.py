"""Configure how a transport problem is solved: the step, the stopping rule and the gradient."""

import dataclasses
from typing import Any, ClassVar, Literal, NamedTuple

from jaxtyping import Array, Bool, Int

from crisalad_jax.config.checks import NonNegativeInt, PositiveFloat, PositiveInt, require_field
from crisalad_jax.config.part import OrName, Part
from crisalad_jax.config.registry import Registry, part_field, resolve_names
from crisalad_jax.config.short_repr import short_repr
from crisalad_jax.nn.transport.problem import Potentials, Problem
from crisalad_jax.nn.transport.start import STARTS, Start
from crisalad_jax.nn.transport.steps import STEPS, Step


class Solution(NamedTuple):
    """The potentials after the iterations, and the number of iterations."""

    potentials: Potentials
    iterations: Int[Array, "*batch"]
    met: Bool[Array, "*batch"]
    """Whether the tolerance was met; False without a tolerance."""


class Gradient(Part):
    """A rule for the gradient of the potentials, through which JAX differentiates the plan."""

    at_convergence: ClassVar[bool | None] = None
    """True: gradient of the converged plan, which needs a tolerance. False: gradient of a fixed
    number of iterations, without a tolerance. None: either."""
    needs_entropic: ClassVar[bool] = False
    """Whether the step must solve the entropic problem (`Step.entropic`)."""
    takes_solver: ClassVar[bool] = False
    """Whether `solve` takes the `solver` of `sinkhorn.solve`, which then replaces Anderson's
    method."""

    def solve(
        self, problem: Problem, config: "SinkhornConfig", params: Any, init: Potentials
    ) -> Solution:
        """Solve from `init`, so that JAX differentiates by this rule; `params` are the step's."""
        raise NotImplementedError


GRADIENTS = Registry("gradient", Gradient)


@short_repr()
@dataclasses.dataclass(frozen=True)
class SinkhornConfig:
    """The solver of transport problems, by default SALAD's published one. See `docs/sinkhorn.md`.

    Example:
        >>> config = SinkhornConfig(tolerance=1e-4, iterations=100, gradient="implicit")
        >>> config.gradient.part_name
        'implicit'
    """

    step: OrName[Step] = part_field(STEPS, "sinkhorn")
    """One iteration; a registered step, or its name."""
    iterations: PositiveInt = 3
    """Number of iterations; with a tolerance, at most this number."""
    tolerance: PositiveFloat | None = None
    """Largest `Step.error` at which iterations stop; None runs all. For "sinkhorn" it is, to first
    order, the relative marginal error before the step. float32 may never get below 1e-5."""
    throw: bool = False
    """Whether to raise if the tolerance is not met; otherwise the result reports it."""
    domain: Literal["scaling", "log"] = "scaling"
    """Domain of the sums. "scaling" computes exponentials once; a batch with scores too far apart
    for it is solved again in the "log" domain."""
    anderson_memory: NonNegativeInt = 0
    """Number of past iterations that Anderson acceleration uses, at least 2; 0 disables it."""
    gradient: OrName[Gradient] = part_field(GRADIENTS, "unrolled")
    """Gradient of the potentials: unrolled (through the iterations), implicit (closed form of the
    optimality conditions), optimistix (fixed point and adjoint of that library), or stop
    (potentials are constants)."""
    start: OrName[Start] = part_field(STARTS, "zeros")
    """Potentials to start from if no `init` is given; a registered start, or its name."""

    def __post_init__(self) -> None:
        """Check the ranges, and that the parts are compatible."""
        resolve_names(self)
        gradient, converges = self.gradient, self.tolerance is not None
        remembers = self.anderson_memory > 1 and not gradient.takes_solver
        memory = "0; or a whole number from 2, with a gradient without its own solver"
        mode = "a fixed number of iterations, without a tolerance" if converges else "a tolerance"
        step = f"a step that says it solves the entropic problem, not {self.step.part_name!r}"
        for name, fits, expected in (
            ("anderson_memory", self.anderson_memory == 0 or remembers, memory),
            ("throw", converges or not self.throw, "a tolerance to converge to"),
            ("gradient", gradient.at_convergence in (None, converges), f"{mode} with it"),
            ("gradient", self.step.entropic or not gradient.needs_entropic, step),
        ):
            require_field(self, name, fits, expected)
