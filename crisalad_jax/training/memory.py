"""Memory of a training step, compared with the devices' before the first step."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax

from crisalad_jax.training.config import TrainConfig
from crisalad_jax.utils import distributed
from crisalad_jax.utils.errors import InputError

_KIB, _MOST = 2**10, 2**32 - 1
"""Unit of limits and their largest number, 4 TiB: processes tell each other 32 bits."""


def memory_limit(devices: Sequence[Any]) -> int | None:
    """Return the bytes that a program may take of each device; None where a platform tells none.

    Args:
        devices: this process's.
    """
    limits = [(device.memory_stats() or {}).get("bytes_limit", 0) for device in devices]
    return min(limits, default=0) or None


def check_memory(
    compiled_size: Callable[[int | None], int],
    config: TrainConfig,
    limit: int | None,
    devices: int,
) -> None:
    """Check that a step fits the devices' memory, by the compiler's analysis of its program.

    A step that fits is compiled once: its first call finds the program. Where it does not, smaller
    micro-batches are compiled as well, to name the largest that fits. Memory grows in a straight
    line with their size, so that three programs are enough as a rule. All processes call it
    together, and take the same way.

    Args:
        compiled_size: compiles the step for a `TrainConfig.micro_batch`, and returns the bytes that
            it takes of each device (`memory_of`).
        config: the run's.
        limit: bytes of each of this process's devices; None checks nothing.
        devices: number of devices that share the batch.

    Raises:
        InputError: it does not fit.
    """
    if limit is None:
        return
    limit = (_MOST - distributed.all_max(_MOST - min(limit // _KIB, _MOST))[0]) * _KIB

    @functools.cache
    def needed(micro_batch: int | None) -> float:
        try:
            return float(compiled_size(micro_batch))
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            return math.inf  # a TPU's compiler knows the limit itself

    if needed(config.micro_batch) <= limit:
        return
    batch = config.places_per_batch * config.images_per_place
    whole = config.micro_batch or batch
    own = batch // devices
    sizes = [n * devices for n in range(1, own) if own % n == 0 and n * devices < whole]
    found = needed(config.micro_batch)
    words = "more than there is" if math.isinf(found) else f"{found / 1e9:.1f} GB"
    fault = f"training: found a step that takes {words} of each device, expected at most "
    fault += f"{limit / 1e9:.1f} GB"
    if not sizes or needed(sizes[0]) > limit:
        raise InputError(
            f"{fault}; no --micro-batch is small enough: take --model.compute-dtype bfloat16, "
            "--model.remat full, --shard-state, a smaller image or model, or more devices"
        )
    fitting = _largest(sizes, needed, limit, (whole, found))
    raise InputError(f"{fault}; --micro-batch {fitting} takes {needed(fitting) / 1e9:.1f} GB")


def _largest(
    sizes: Sequence[int],
    needed: Callable[[int | None], float],
    limit: int,
    largest: tuple[int, float],
) -> int:
    """Find the largest size that fits, of which the first does, by the straight line of two."""
    first, last = 0, len(sizes) - 1  # of those that may be the answer
    whole, most = largest
    while first < last:
        place = (first + last + 1) // 2
        if not math.isinf(most):
            slope = (most - needed(sizes[first])) / (whole - sizes[first])
            expected = sizes[first] + (limit - needed(sizes[first])) / slope if slope > 0 else whole
            fit = [i for i in range(first + 1, last + 1) if sizes[i] <= expected]
            place = fit[-1] if fit else first + 1
        if needed(sizes[place]) <= limit:
            first = place
        else:
            last, (whole, most) = place - 1, (sizes[place], needed(sizes[place]))
    return sizes[first]


def memory_of(program: jax.stages.Compiled) -> int:
    """Return the bytes that a compiled program takes of each device: all that it reads and writes.

    Args:
        program: with a state that it may overwrite (`donate_argnames`).
    """
    sizes = program.memory_analysis()
    assert sizes is not None
    total = sizes.argument_size_in_bytes + sizes.output_size_in_bytes + sizes.temp_size_in_bytes
    return total + sizes.generated_code_size_in_bytes - sizes.alias_size_in_bytes
