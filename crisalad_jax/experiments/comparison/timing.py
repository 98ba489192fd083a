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

    The first call of each, which compiles, does not count, nor does the first of each turn. A
    contender makes its call for a turn and drops it: one model is in memory at a time. A progress
    bar counts the turns, unless `quiet`.
    """
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    with progress_bar("speed", (1 + rounds) * len(contenders), "turns", quiet=quiet) as bar:
        for ready in contenders.values():
            ready()()
            bar.advance(1)
        for _ in range(rounds):
            for name, ready in contenders.items():
                call = ready()
                call()
                times = []
                for _ in range(_CALLS):
                    started = time.perf_counter()
                    call()
                    times.append(time.perf_counter() - started)
                seconds[name].append(statistics.median(times))
                bar.advance(1)
    return Race(seconds)


def describing(params: Crisalad, config: ModelConfig, batch_size: int) -> Callable[[], Any]:
    """Make a call that describes a batch, each image alone, with the programs of `evaluate`."""
    devices = devices_for(batch_size)
    shared = devices.replicate(cast_params(params, config))
    pixels = np.random.default_rng(0).integers(0, 256, (batch_size, *config.input_size, 3))
    images = devices.shard_batch(pixels.astype(np.uint8))
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
