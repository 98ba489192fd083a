"""What models cost: their speed, timed in turns under the same load, and the paper's Table 3."""

import dataclasses
import functools
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from crisalad_jax.experiments.comparison.methods import AdapterKind
from crisalad_jax.nn.adapter import AdapterConfig, adapter, init_adapter
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import PRESETS, ModelConfig
from crisalad_jax.nn.costs import adapter_macs, paper_adapter_macs
from crisalad_jax.nn.model import (
    Crisalad,
    attend_across_images,
    cast_params,
    extract_tokens,
    self_mask,
)
from crisalad_jax.utils.compiler import jit
from crisalad_jax.utils.devices import devices_for
from crisalad_jax.utils.host import usable_cores
from crisalad_jax.utils.progress import progress_bar

_CALLS = 3
"""Number of calls of each in a round; their median counts."""
_LONG = 3.0
"""Seconds of a call that is made once in a round: a few of it vary less than many short ones."""


class Spread(NamedTuple):
    """What repeats of a measurement range over."""

    median: float
    least: float
    most: float

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread | None":
        """Summarise values; None of none."""
        return cls(statistics.median(values), min(values), max(values)) if values else None


def race(
    contenders: Mapping[str, Callable[[], Callable[[], Any]]],
    rounds: int,
    *,
    quiet: bool = True,
) -> dict[str, list[float]]:
    """Time calls in turns; each call does all of its work and waits for it.

    The first call of each, which compiles, does not count, nor does the first of each turn. A call
    of `_LONG` and longer is then made once, any other `_CALLS` times. A contender makes its call
    for a turn and drops it: one model is in memory at a time. A progress bar counts the turns,
    unless `quiet`.

    Returns:
        Seconds of a call by name, the median of each round.
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
    return seconds


def ratios(rounds: Mapping[str, Sequence[float]], name: str, than: str) -> list[float]:
    """Compare the times of two calls: a ratio of each round, both times under the same load."""
    pairs = zip(rounds[name], rounds[than], strict=True)
    return [ours / theirs for ours, theirs in pairs]


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


class AdapterCost(NamedTuple):
    """A row of Table 3."""

    adapter: str
    paper_parameters: int
    """Number of parameters as the paper counts them: docs/comparison.md."""
    parameters: int
    """Number of parameters of one adapter here, with batch norms' running statistics."""
    paper_macs: int
    macs: int
    """Multiply-accumulates that an image really takes."""
    time: Spread | None
    """Time over the depthwise adapter's, over the rounds; None where it was not measured."""


NOTES = (
    "Table 3 at the paper's size (ViT-B/14, 224 x 224 pixels); docs/comparison.md says what the "
    "paper counts.",
)


def adapter_costs(*, measure: bool = True, rounds: int = 5, images: int = 4) -> list[AdapterCost]:
    """Compute Table 3, of one adapter at the paper's size.

    Args:
        measure: whether to time the adapters, in turns.
        rounds: number of turns of each.
        images: number of images in a batch.
    """
    kinds: tuple[AdapterKind, ...] = ("mlp", "multi-resolution", "depthwise")
    calls = {kind: functools.partial(_adapter_call, kind, images) for kind in kinds}
    seconds = race(calls, rounds) if measure else {}
    return [_adapter_cost(kind, seconds) for kind in kinds]


_PAPER_PARAMETERS = {"mlp": 590_976, "multi-resolution": 761_472, "depthwise": 741_504}
"""By the count that docs/comparison.md explains."""


def _adapter_cost(kind: AdapterKind, seconds: Mapping[str, Sequence[float]]) -> AdapterCost:
    config = AdapterConfig(kind=kind)
    backbone = ViTConfig(adapter=config)
    model = dataclasses.replace(PRESETS["b14"], backbone=backbone)
    make = functools.partial(init_adapter, dim=backbone.dim, config=config)
    leaves = jax.tree.leaves(jax.eval_shape(make, jax.random.key(0)))
    true_macs = adapter_macs(model)
    macs = paper_adapter_macs(model, true_macs)
    if kind == "mlp":  # the paper counts each weight twice here, and the biases
        macs = 2 * macs + backbone.dim // 2 + backbone.dim
    time = Spread.of(ratios(seconds, kind, "depthwise")) if seconds else None
    parameters = sum(leaf.size for leaf in leaves)
    return AdapterCost(kind, _PAPER_PARAMETERS[kind], parameters, macs, true_macs, time)


def _adapter_call(kind: AdapterKind, images: int) -> Callable[[], Any]:
    dim, grid = ViTConfig().dim, (16, 16)
    tokens = jnp.ones((images, 1 + grid[0] * grid[1], dim), jnp.float32)
    params = init_adapter(jax.random.key(0), dim, AdapterConfig(kind=kind))
    return lambda: jax.block_until_ready(_apply_adapter(params, tokens, grid))


@functools.partial(jit, static_argnames="grid")
def _apply_adapter(params: Any, tokens: jax.Array, grid: tuple[int, int]) -> jax.Array:
    return adapter(params, tokens, grid)[0]
