"""The optimiser of a run: warm-up, schedule, clipping, accumulation, and an average of weights."""

import dataclasses
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import optax
from jax.typing import ArrayLike
from jaxtyping import Array, PyTree

from crisalad_jax.config.checks import require
from crisalad_jax.training.config import OptimiserConfig
from crisalad_jax.training.schedules import RunSteps
from crisalad_jax.utils.output import warn

WARMUP_SHARE = 4
"""A warm-up is at most a run's steps divided by this, as in BoQ (10 of 40 epochs)."""


_Count = TypeVar("_Count", int, Array)


def count_steps(config: OptimiserConfig, batches: _Count, batches_per_epoch: int) -> _Count:
    """Count the optimiser's steps in the first `batches` batches of a run.

    Args:
        config: the optimiser's configuration.
        batches: number of batches so far, which is also the index of the next one; may be traced.
        batches_per_epoch: number of batches of an epoch, the last of which always ends a step.

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
    """Return the length of a warm-up in optimiser steps, even if it is given in epochs.

    Args:
        config: the optimiser's configuration.
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
    """Make the learning-rate function: a linear warm-up, followed by `config.schedule`.

    Args:
        config: the optimiser's configuration.
        steps: number of batches of the run.
        steps_per_epoch: number of batches of an epoch.

    Returns:
        A function of the number of steps that the optimiser has taken (see `count_steps`).

    Raises:
        InputError: when the function is called, if `config.schedule` does not return a scalar.
    """
    peak = config.learning_rate
    warmup_steps = warmup_length(config, steps_per_epoch)
    steps, steps_per_epoch = (
        count_steps(config, batches, steps_per_epoch) for batches in (steps, steps_per_epoch)
    )
    run = RunSteps(max(steps - warmup_steps, 1), steps_per_epoch, warmup_steps)

    def decay(step: ArrayLike) -> Array:
        rate = jnp.asarray(config.schedule.apply(step, peak, run), float)
        name, shape = config.schedule.part_name, rate.shape
        require(not shape, f"schedule {name}: found to return shape {shape}, expected a number")
        return rate

    if warmup_steps:
        # A warm-up of n steps starts at 1 / n of the peak: its first step would otherwise be 0.
        schedule = optax.join_schedules(
            [lambda count: peak * (count + 1) / warmup_steps, decay], [warmup_steps]
        )
    else:
        schedule = decay
    # Optax divides its int32 count in float32, even in JAX's 64-bit mode: the count is cast here.
    return lambda count: schedule(jnp.asarray(count, float))


def with_short_warmup(config: OptimiserConfig, steps: int, steps_per_epoch: int) -> OptimiserConfig:
    """Shorten a warm-up to at most a quarter of a run's steps.

    Args:
        config: the optimiser's configuration.
        steps: number of batches of the run.
        steps_per_epoch: number of batches of an epoch.

    Returns:
        The configuration, unchanged if the warm-up is short enough; else with `warmup_steps` set.

    Example:
        >>> with_short_warmup(OptimiserConfig(warmup_epochs=5), 32, 4).warmup_steps
        8
    """
    longest = count_steps(config, steps, steps_per_epoch) // WARMUP_SHARE
    if warmup_length(config, steps_per_epoch) <= longest:
        return config
    return dataclasses.replace(config, warmup_steps=longest, warmup_epochs=0)


def warn_of_long_warmup(config: OptimiserConfig, steps: int, steps_per_epoch: int) -> None:
    """Warn if a warm-up takes more than a quarter of a run of `steps` batches."""
    short = with_short_warmup(config, steps, steps_per_epoch)
    if short is config:
        return
    warmup = warmup_length(config, steps_per_epoch)
    steps = count_steps(config, steps, steps_per_epoch)
    flag = "epochs" if config.warmup_epochs else "steps"
    warn(
        f"--optimiser.warmup-{flag}: found {warmup} steps for a run of {steps}, which leaves "
        f"{max(steps - warmup, 0)} after the warm-up; expected at most {short.warmup_steps}, "
        "a quarter"
    )


def make_optimiser(
    config: OptimiserConfig, steps: int, steps_per_epoch: int = 1
) -> optax.GradientTransformation:
    """Make the optimiser of a run, from `config.kind`.

    If `config.clip_norm` or `config.clip_value` is set, the gradient is clipped first; if a step
    accumulates several batches, their mean gradient is. The weight average (`config.ema`) is last.

    Args:
        config: the optimiser's configuration.
        steps: number of batches of the run.
        steps_per_epoch: number of batches of an epoch.

    Raises:
        InputError: the optimiser is not an optax transformation.
    """
    schedule, parts = learning_rate_schedule(config, steps, steps_per_epoch), []
    if config.clip_norm is not None:
        parts.append(optax.clip_by_global_norm(config.clip_norm))
    if config.clip_value is not None:
        parts.append(optax.clip(config.clip_value))
    made, name = config.kind.make(schedule, config.weight_decay), config.kind.part_name
    require(
        isinstance(made, optax.GradientTransformation),
        f"optimiser {name}: found to return {type(made).__name__}, expected a transformation of "
        "optax, such as optax.sgd(learning_rate)",
    )
    parts.append(_with_plain_keys(made))
    if config.ema is not None:
        parts.append(_averaging(config.ema))
    optimiser = optax.chain(*parts)
    if config.accumulate == 1:
        return optimiser
    return _accumulated(optimiser, config.accumulate, steps_per_epoch)


def _accumulated(
    optimiser: optax.GradientTransformation, accumulate: int, batches_per_epoch: int
) -> optax.GradientTransformation:
    """Step once every several batches, and at the last batch of an epoch."""
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


def _with_plain_keys(optimiser: optax.GradientTransformation) -> optax.GradientTransformation:
    """Store random keys in the state as numbers, which a checkpoint can hold."""

    def is_key(leaf: Any) -> bool:
        return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)

    def plain(state: PyTree) -> PyTree:
        return jax.tree.map(lambda leaf: jax.random.key_data(leaf) if is_key(leaf) else leaf, state)

    def init(params: PyTree) -> PyTree:
        return plain(optimiser.init(params))

    def update(updates: PyTree, state: PyTree, params: PyTree = None) -> tuple[PyTree, PyTree]:
        own = jax.tree.map(
            lambda like, leaf: jax.random.wrap_key_data(leaf) if is_key(like) else leaf,
            jax.eval_shape(optimiser.init, updates if params is None else params),
            state,
        )
        updates, state = optimiser.update(updates, own, params)
        return updates, plain(state)

    return optax.GradientTransformation(init, update)


class WeightAverage(NamedTuple):
    """The part of an optimiser's state that holds the average of the weights."""

    weights: PyTree


def _averaging(decay: float) -> optax.GradientTransformation:
    """Average the weights after each step, starting from the initial ones."""

    def init(params: PyTree) -> WeightAverage:
        return WeightAverage(jax.tree.map(jnp.copy, params))  # both are donated to a step

    def update(updates: PyTree, state: PyTree, params: PyTree = None) -> tuple[PyTree, PyTree]:
        after = optax.apply_updates(params, updates)
        average = optax.incremental_update(after, state.weights, step_size=1 - decay)
        return updates, WeightAverage(average)

    return optax.GradientTransformation(init, update)


def averaged_weights(state: PyTree, weights: PyTree) -> PyTree:
    """Return the weights to validate and save: an average, if the optimiser has one.

    The average is that of `OptimiserConfig.ema` or a schedule-free optimiser (Defazio et al. 2024).

    Args:
        state: the optimiser's state.
        weights: the weights after its last step.
    """
    from optax.contrib import ScheduleFreeState, schedule_free_eval_params

    for kind, average in (
        (WeightAverage, lambda found: found.weights),
        (ScheduleFreeState, lambda found: schedule_free_eval_params(found, weights)),
    ):
        leaves = jax.tree.leaves(state, is_leaf=lambda each, kind=kind: isinstance(each, kind))
        for found in leaves:
            if isinstance(found, kind):
                return average(found)
    return weights
