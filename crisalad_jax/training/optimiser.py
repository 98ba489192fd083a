"""The optimiser and its learning rate, equal to torch's."""

import dataclasses
from typing import TypeVar

import jax.numpy as jnp
import optax
from jax.typing import ArrayLike
from jaxtyping import Array

from crisalad_jax.training.config import OptimiserConfig
from crisalad_jax.utils.output import warn

WARMUP_SHARE = 4
"""Divisor of a run's steps: a warm-up takes a quarter of them at most, as BoQ's 10 of 40 epochs."""


_Count = TypeVar("_Count", int, Array)


def count_steps(config: OptimiserConfig, batches: _Count, batches_per_epoch: int) -> _Count:
    """Count the optimiser's steps in so many batches from the start of a run.

    Args:
        config: the optimiser.
        batches: number of batches, which is also that of the one after them, from 0.
        batches_per_epoch: number of batches of an epoch, the last of which always steps.

    Example:
        >>> count_steps(OptimiserConfig(accumulate=4), 20, 10)
        6
    """
    if config.accumulate == 1:
        return batches
    per_epoch = -(-batches_per_epoch // config.accumulate)
    epochs, rest = batches // batches_per_epoch, batches % batches_per_epoch
    return epochs * per_epoch + rest // config.accumulate


def warmup_length(config: OptimiserConfig, steps_per_epoch: int) -> int:
    """Return the number of the optimiser's steps of a warm-up, which may be given in epochs.

    Args:
        config: the optimiser.
        steps_per_epoch: number of batches of an epoch.

    Example:
        >>> warmup_length(OptimiserConfig(warmup_epochs=2), 100)
        200
    """
    per_epoch = count_steps(config, steps_per_epoch, steps_per_epoch)
    return config.warmup_steps or config.warmup_epochs * per_epoch


def learning_rate_schedule(
    config: OptimiserConfig, steps: int, steps_per_epoch: int = 1
) -> optax.Schedule:
    """Make a linear warm-up, followed by the decay that `config.schedule` names.

    Linear decay reaches `end_lr_fraction` after `config.decay_steps`, or after the last of `steps`.
    Step decay multiplies by `step_gamma` every `step_epochs`, counted from the end of the warm-up.
    Milestones count from the start of the run. One that comes before the end of the warm-up is
    without effect, as in GSV-Cities' code, in which the warm-up sets the learning rate anew.

    Args:
        config: the optimiser.
        steps: number of batches of the run.
        steps_per_epoch: number of batches of an epoch.

    Returns:
        A function of the number of steps that the optimiser has taken (`count_steps`).
    """
    peak, end = config.learning_rate, config.learning_rate * config.end_lr_fraction
    warmup_steps = warmup_length(config, steps_per_epoch)
    steps, steps_per_epoch = (
        count_steps(config, batches, steps_per_epoch) for batches in (steps, steps_per_epoch)
    )
    if config.schedule == "linear":
        length = config.decay_steps or max(steps - warmup_steps, 1)
        decay = optax.linear_schedule(peak, end, length)
    elif config.schedule == "milestones":
        after = [epoch * steps_per_epoch - warmup_steps for epoch in config.milestones]
        decay = optax.piecewise_constant_schedule(
            peak, {step: config.step_gamma for step in after if step >= 0}
        )
    else:
        decay = optax.exponential_decay(
            peak, config.step_epochs * steps_per_epoch, config.step_gamma, staircase=True
        )
    if warmup_steps:
        # A warm-up of n steps starts at 1 / n of the peak: its first step would otherwise be 0.
        decay = optax.join_schedules(
            [lambda count: peak * (count + 1) / warmup_steps, decay], [warmup_steps]
        )
    # Optax divides its int32 count in float32, also in JAX's 64-bit mode: the count is cast here.
    return lambda count: decay(jnp.asarray(count, float))


def with_short_warmup(config: OptimiserConfig, steps: int, steps_per_epoch: int) -> OptimiserConfig:
    """Shorten a warm-up to its largest share of a run.

    Args:
        config: the optimiser.
        steps: number of batches of the run.
        steps_per_epoch: number of batches of an epoch.

    Returns:
        The optimiser, as it is where its warm-up is short enough. A shortened one is in steps.

    Example:
        >>> with_short_warmup(OptimiserConfig(warmup_epochs=5), 32, 4).warmup_steps
        8
    """
    longest = count_steps(config, steps, steps_per_epoch) // WARMUP_SHARE
    if warmup_length(config, steps_per_epoch) <= longest:
        return config
    return dataclasses.replace(config, warmup_steps=longest, warmup_epochs=0)


def warn_of_long_warmup(config: OptimiserConfig, steps: int, steps_per_epoch: int) -> None:
    """Warn if a warm-up takes more than its largest share of a run's steps."""
    warmup = warmup_length(config, steps_per_epoch)
    steps = count_steps(config, steps, steps_per_epoch)
    longest = steps // WARMUP_SHARE
    if warmup <= longest:
        return
    flag = "epochs" if config.warmup_epochs else "steps"
    warn(
        f"--optimiser.warmup-{flag}: found {warmup} steps for a run of {steps}, which leaves "
        f"{max(steps - warmup, 0)} at the learning rate and its decay; at most {longest} would be "
        "a quarter"
    )


def make_optimiser(
    config: OptimiserConfig, steps: int, steps_per_epoch: int = 1
) -> optax.GradientTransformation:
    """Make torch's AdamW (Loshchilov and Hutter 2019), Adam (Kingma and Ba 2015) or SGD.

    All decay every parameter: AdamW the parameter itself, the others through its gradient. SGD has
    torch's momentum, without dampening. With `config.clip_norm` or `config.clip_value` the gradient
    is clipped first, where several batches share a step the mean of theirs.

    Args:
        config: the optimiser.
        steps: number of batches of the run.
        steps_per_epoch: number of batches of an epoch.
    """
    schedule = learning_rate_schedule(config, steps, steps_per_epoch)
    b1, b2, parts = config.b1, config.b2, []
    if config.clip_norm is not None:
        parts.append(optax.clip_by_global_norm(config.clip_norm))
    if config.clip_value is not None:
        parts.append(optax.clip(config.clip_value))
    if config.kind == "adamw":
        parts.append(optax.adamw(schedule, b1, b2, weight_decay=config.weight_decay))
    else:
        parts.append(optax.add_decayed_weights(config.weight_decay))
        is_adam = config.kind == "adam"
        descent = optax.adam(schedule, b1, b2) if is_adam else optax.sgd(schedule, config.momentum)
        parts.append(descent)
    optimiser = optax.chain(*parts)
    if config.accumulate == 1:
        return optimiser
    return _accumulated(optimiser, config.accumulate, steps_per_epoch)


def _accumulated(
    optimiser: optax.GradientTransformation, accumulate: int, batches_per_epoch: int
) -> optax.GradientTransformation:
    """Step once for several batches, and at the last of an epoch."""
    per_epoch = -(-batches_per_epoch // accumulate)

    def count_batches(step: ArrayLike) -> Array:
        return jnp.minimum(
            accumulate, batches_per_epoch - jnp.asarray(step) % per_epoch * accumulate
        )

    of_mean = optax.chain(optax.scale(1 / accumulate), optimiser)
    several = optax.MultiSteps(
        of_mean, count_batches, use_grad_mean=False, accumulator_dtype=jnp.dtype(float)
    )
    return several.gradient_transformation()
