"""Learning-rate schedules: the interface of custom ones, and the built-in ones.

The warm-up comes before them and is the same for all (`optimiser.learning_rate_schedule`).
"""

import abc
import dataclasses
from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

from crisalad_jax.config.checks import (
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    require_field,
)
from crisalad_jax.config.part import Part
from crisalad_jax.config.registry import Registry, count_arguments
from crisalad_jax.config.short_repr import brief


@brief
class RunSteps(NamedTuple):
    """Numbers of optimiser steps, from which a schedule is computed."""

    after_warmup: int
    """Steps of the run after the warm-up, at least 1."""
    per_epoch: int
    """Steps of an epoch."""
    warmup: int
    """Steps of the warm-up."""


class Schedule(Part, abc.ABC):
    """A learning-rate schedule: a frozen dataclass whose fields are its settings.

    A plain function of (step, steps) that returns a share of the learning rate is a schedule
    without settings. `step` counts from 0 after the warm-up; `steps` is the number of these steps.

    Example:
        >>> from crisalad_jax import OptimiserConfig, register_schedule
        >>> @register_schedule("quadratic")
        ... def quadratic(step, steps):
        ...     return (1 - step / steps) ** 2
        >>> OptimiserConfig(schedule="quadratic").schedule.part_name
        'quadratic'
    """

    spans_run: ClassVar[bool] = True
    """Whether the learning rate of a step depends on the length of the run."""

    @abc.abstractmethod
    def apply(self, step: Any, learning_rate: float, run: RunSteps) -> Any:
        """Return the learning rate of a step, a scalar, which may be traced.

        Args:
            step: number of optimiser steps after the warm-up, from 0; a traced float.
            learning_rate: the peak learning rate, at which the warm-up ends.
            run: the run's numbers of optimiser steps.
        """


def _of_function(function: Callable[..., Any]) -> Mapping[str, Any]:
    """Return the methods of a schedule that is a plain function of (step, steps)."""
    count = count_arguments(function, "step", "steps")

    def apply(self: Any, step: Any, learning_rate: float, run: RunSteps) -> Any:
        return learning_rate * function(*(step, run.after_warmup)[:count])

    return {"apply": apply}


SCHEDULES = Registry("schedule", Schedule, of_function=_of_function)
register_schedule = SCHEDULES.register


@SCHEDULES.register("constant")
class ConstantSchedule(Schedule):
    """The same learning rate for the whole run."""

    spans_run: ClassVar[bool] = False

    def apply(self, step: Any, learning_rate: float, run: RunSteps) -> Any:
        """Return the learning rate itself."""
        return learning_rate


@dataclasses.dataclass(frozen=True)
class _Decay(Schedule):
    """A decay to a share of the learning rate."""

    end_fraction: NonNegativeFloat = 0.0
    """Share of the learning rate that is left after the decay."""
    decay_steps: PositiveInt | None = None
    """Steps of the decay, after which the learning rate is constant; None is the whole run."""

    @property
    def spans_run(self) -> bool:
        """Return whether the decay is as long as the run."""
        return self.decay_steps is None


@SCHEDULES.register("linear")
class LinearSchedule(_Decay):
    """Linear decay, step by step (SALAD's code, torch's `LinearLR`)."""

    def apply(self, step: Any, learning_rate: float, run: RunSteps) -> Any:
        """Return the linearly decayed learning rate."""
        import optax  # only to train: a configuration does not need it

        end, length = learning_rate * self.end_fraction, self.decay_steps or run.after_warmup
        return optax.linear_schedule(learning_rate, end, length)(step)


@SCHEDULES.register("cosine")
class CosineSchedule(_Decay):
    """Cosine decay over half a period (Loshchilov and Hutter 2017, without restarts)."""

    def apply(self, step: Any, learning_rate: float, run: RunSteps) -> Any:
        """Return the learning rate after the cosine decay so far."""
        import optax

        length = self.decay_steps or run.after_warmup
        return optax.cosine_decay_schedule(learning_rate, length, alpha=self.end_fraction)(step)


@SCHEDULES.register("step")
class StepSchedule(Schedule):
    """A step down every few epochs after the warm-up; the defaults are CricaVPR's."""

    spans_run: ClassVar[bool] = False
    epochs: PositiveInt = 3
    """Epochs from one step down to the next."""
    gamma: PositiveFloat = 0.5
    """Factor by which a step down multiplies the learning rate."""

    def apply(self, step: Any, learning_rate: float, run: RunSteps) -> Any:
        """Return the learning rate after the steps down so far."""
        import optax

        length = self.epochs * run.per_epoch
        return optax.exponential_decay(learning_rate, length, self.gamma, staircase=True)(step)


@SCHEDULES.register("milestones")
class MilestonesSchedule(Schedule):
    """A step down after each of the given epochs of the run; the defaults are MixVPR's.

    A milestone before the end of the warm-up has no effect, as in GSV-Cities' code, where the
    warm-up overwrites the learning rate.
    """

    spans_run: ClassVar[bool] = False
    epochs: tuple[int, ...] = (5, 10, 15, 25, 45)
    """Epochs after which the learning rate steps down."""
    gamma: PositiveFloat = 0.3
    """Factor by which a step down multiplies the learning rate."""

    def __post_init__(self) -> None:
        """Check that the epochs increase."""
        rises = bool(self.epochs) and all(a < b for a, b in pairwise((0, *self.epochs)))
        require_field(self, "epochs", rises, "increasing numbers of epochs")

    def apply(self, step: Any, learning_rate: float, run: RunSteps) -> Any:
        """Return the learning rate after the steps down so far."""
        import optax

        after = [epoch * run.per_epoch - run.warmup for epoch in self.epochs]
        downs = {count: self.gamma for count in after if count >= 0}
        return optax.piecewise_constant_schedule(learning_rate, downs)(step)
