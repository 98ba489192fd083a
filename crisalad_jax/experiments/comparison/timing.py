"""Timing of models that describe images, in turns, so that all meet the same load."""

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import (
    Crisalad,
    attend_across_images,
    cast_params,
    extract_tokens,
    self_mask,
)
from crisalad_jax.utils.devices import devices_for
from crisalad_jax.utils.host import usable_cores
from crisalad_jax.utils.progress import progress_bar
from crisalad_jax.utils.target import target

_CALLS = 3
"""Number of calls of each in a round; their median counts."""
_LONG = 3.0
"""Seconds of a call that is made once in a round: a few of it vary less than many short ones."""


class Race(NamedTuple):
    """Seconds of a call by name, the median of each round."""

    rounds: Mapping[str, list[float]]

    def slower(self, name: str, than: str) -> tuple[float, float, float]:
        """Compare the time of two calls: median, least and most of the rounds' ratios.

        Both times of a ratio are of one round, under the same load.
        """
        pairs = zip(self.rounds[name], self.rounds[than], strict=True)
        ratios = [ours / theirs for ours, theirs in pairs]
        return statistics.median(ratios), min(ratios), max(ratios)


def race(
    contenders: Mapping[str, Callable[[], Callable[[], Any]]],
    rounds: int,
    *,
    quiet: bool = True,
) -> Race:
    """Time calls in turns; each call does all of its work and waits for it.

    The first call of each, which compiles, does not count, nor does the first of each turn. A call
    of `_LONG` and longer is then made once, any other `_CALLS` times. A contender makes its call
    for a turn and drops it: one model is in memory at a time. A progress bar counts the turns,
    unless `quiet`.
    """
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    with progress_bar("speed", (1 + rounds) * len(contenders), "turns", quiet=quiet) as bar:
        for ready in contenders.values():
            ready()()
            bar.advance(1)
        for _ in range(rounds):
            for name, ready in contenders.items():
                call = ready()
                calls = 1 if _seconds(call) >= _LONG else _CALLS
                times = [_seconds(call) for _ in range(calls)]
                seconds[name].append(statistics.median(times))
                bar.advance(1)
    return Race(seconds)


def _seconds(call: Callable[[], Any]) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


def describing(
    params: Crisalad, config: ModelConfig, image: np.ndarray, batch_size: int
) -> Callable[[], Any]:
    """Make a call that describes a batch, each image alone, with the programs of `evaluate`.

    Args:
        params: the model's parameters.
        config: the model.
        image: a prepared image, which is repeated.
        batch_size: number of images.

    Returns:
        The call, which takes no argument and waits for its result.
    """
    devices = devices_for(batch_size)
    shared = devices.replicate(cast_params(params, config))
    images = devices.shard_batch(np.repeat(image[None], batch_size, axis=0))
    mask = self_mask(batch_size)

    def call() -> None:
        tokens = extract_tokens(shared, images, config)
        jax.block_until_ready(attend_across_images(shared, tokens, config, mask=mask))

    return call


def machine() -> str:
    """Name the device that is measured on, in a few words."""
    device = jax.devices()[0]
    if device.platform == "cpu":
        return f"{usable_cores()} CPU cores"
    return device.device_kind


def is_absolute() -> bool:
    """Return whether times are comparable; a CPU's are not, for they depend on other load."""
    return target().platform != "cpu"
