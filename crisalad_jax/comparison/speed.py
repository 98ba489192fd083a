"""How fast models describe images: side by side, in turns, so that all meet the same machine."""

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from crisalad_jax.config import ModelConfig
from crisalad_jax.cores import usable_cores
from crisalad_jax.model import Crisalad, alone, relate, tokenise
from crisalad_jax.platform import devices_for

_CALLS = 3
"""Of each in a round; their median counts."""


class Race(NamedTuple):
    """Seconds of a call by name, the median of each round."""

    rounds: Mapping[str, list[float]]

    def slower(self, name: str, than: str) -> tuple[float, float, float]:
        """How many times as long a call takes: of the rounds' ratios the median, least and most.

        Each is of one round, in which both met the same machine.
        """
        pairs = zip(self.rounds[name], self.rounds[than], strict=True)
        ratios = [ours / theirs for ours, theirs in pairs]
        return statistics.median(ratios), min(ratios), max(ratios)


def race(contenders: Mapping[str, Callable[[], Callable[[], Any]]], rounds: int) -> Race:
    """Time calls in turns; each does the whole of its work and waits for it.

    The first call of each, which compiles, does not count, nor does the first of each turn. What a
    contender gives is called for its turn and then let go: one model is in memory at a time.
    """
    for ready in contenders.values():
        ready()()
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
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
    return Race(seconds)


def describing(params: Crisalad, config: ModelConfig, batch_size: int) -> Callable[[], Any]:
    """A call that describes a batch, each image alone, by the programs that `evaluate` uses."""
    devices = devices_for(batch_size)
    shared = devices.share(params)
    pixels = np.random.default_rng(0).integers(0, 256, (batch_size, *config.image_size, 3))
    images = devices.spread(pixels.astype(np.uint8))
    mask = alone(batch_size)

    def call() -> None:
        tokens = tokenise(shared, images, config)
        jax.block_until_ready(relate(shared, tokens, config, mask=mask))

    return call


def machine() -> str:
    """What it was measured on, in a few words."""
    device = jax.devices()[0]
    if device.platform == "cpu":
        return f"{usable_cores()} CPU cores"
    return device.device_kind


def is_absolute() -> bool:
    """Whether times mean something by themselves: those of a CPU hang on whatever else it does."""
    return jax.default_backend() != "cpu"
