"""Costs of models (speed, timed in turns under the same load) and of adapters (paper, Table 3)."""

import dataclasses
import functools
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from crisalad_jax.nn.adapters import ADAPTERS
from crisalad_jax.nn.backbones.vit import Block, ViTConfig, run_blocks
from crisalad_jax.nn.config import PRESETS
from crisalad_jax.nn.costs import adapter_macs, paper_adapter_macs
from crisalad_jax.utils.compiler import jit
from crisalad_jax.utils.host import usable_cores
from crisalad_jax.utils.progress import progress_bar

_ROUNDS = 5
"""Number of turns per contender."""
_CALLS = 3
"""Number of calls per contender in a round; their median counts."""
_LONG = 3.0
"""Seconds from which a call is made once in a round: long calls vary less than short ones."""


class Spread(NamedTuple):
    """Median, minimum and maximum of repeated measurements."""

    median: float
    least: float
    most: float

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread | None":
        """Return the spread of some values; None if there are none."""
        return cls(statistics.median(values), min(values), max(values)) if values else None


def race(
    contenders: Mapping[str, Callable[[], Callable[[], Any]]],
    rounds: int = _ROUNDS,
    *,
    quiet: bool = True,
) -> dict[str, list[float]]:
    """Time functions in turns, so that all of them run under the same load.

    A contender makes the function to time, a new one for each turn, so that only one model is in
    memory at a time. The function must finish its work before it returns. The first call of a turn
    is not counted; if it took three seconds or more, one more call is timed, otherwise three. An
    extra turn per contender comes first, to compile. A progress bar counts turns, unless `quiet`.

    Returns:
        Seconds per call, by name: for each of the `rounds`, the median of its calls.
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
    """Divide the times of `name` by those of `than` in each round of `race`: under equal load."""
    pairs = zip(rounds[name], rounds[than], strict=True)
    return [ours / theirs for ours, theirs in pairs]


def _seconds(call: Callable[[], Any]) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


def machine() -> str:
    """Return a short name of the device that JAX computes on, such as "2 CPU cores"."""
    device = jax.devices()[0]
    if device.platform == "cpu":
        return f"{usable_cores()} CPU cores"
    return device.device_kind


class AdapterCost(NamedTuple):
    """A row of the paper's Table 3, the costs of one adapter in a block, with our own counts."""

    adapter: str
    paper_parameters: int | None
    """Number of parameters as the paper counts them (docs/comparison.md); None for adapters that
    the paper lacks. The same holds for `paper_macs`."""
    parameters: int
    """Number of parameters of the adapter here, with the running statistics of batch norms."""
    paper_macs: int | None
    macs: int
    """Multiply-accumulates that the adapter really adds to a block, per image."""
    time: Spread | None
    """Time of a block's gradient, divided by the time without adapter; None if not measured."""
    memory: float | None
    """Memory for that gradient by the compiler's count, divided by the memory without adapter; None
    if not measured."""


_PAPER_PARAMETERS: Mapping[str, int] = {
    "mlp": 590_976,
    "multi-resolution": 761_472,
    "depthwise": 741_504,
}
"""Counted as docs/comparison.md explains."""


def adapter_calls() -> dict[str, Callable[[], Callable[[], Any]]]:
    """Make contenders for `race`, by adapter name: the gradient of a block on four images."""

    def ready(name: str) -> Callable[[], Any]:
        inputs = _stack_and_tokens(name)
        return lambda: jax.block_until_ready(_block_program(name)(*inputs))

    return {name: functools.partial(ready, name) for name in ADAPTERS}


def adapter_memory(names: Iterable[str]) -> dict[str, int]:
    """Return the bytes that the gradient of a block on four images takes, by adapter name."""
    analyses = {name: _block_program(name).memory_analysis() for name in names}
    return {name: each.temp_size_in_bytes for name, each in analyses.items() if each is not None}


def adapter_costs(
    seconds: Mapping[str, Sequence[float]], memory: Mapping[str, int]
) -> list[AdapterCost]:
    """Compute the paper's Table 3, the costs of an adapter in ViT-B/14, for every adapter here.

    Args:
        seconds: what `race` returns for `adapter_calls`; empty if nothing was measured.
        memory: what `adapter_memory` returns; empty if nothing was measured.
    """
    costs = []
    for name in (*_PAPER_PARAMETERS, *sorted({*ADAPTERS} - {"none", *_PAPER_PARAMETERS})):
        backbone, paper_parameters = ViTConfig(adapter=name), _PAPER_PARAMETERS.get(name)
        model = dataclasses.replace(PRESETS["b14"], backbone=backbone)
        true_macs = adapter_macs(model)
        macs = None if paper_parameters is None else paper_adapter_macs(model, true_macs)
        if name == "mlp":  # the paper counts each weight twice here, and the biases
            macs = 2 * (macs or 0) + backbone.dim // 2 + backbone.dim
        time = Spread.of(ratios(seconds, name, "none")) if name in seconds else None
        relative = memory[name] / memory["none"] if name in memory else None
        make = functools.partial(backbone.adapter.init, shape=backbone.block_shape)
        leaves = jax.tree.leaves(jax.eval_shape(make, jax.random.key(0)))
        sizes = paper_parameters, sum(leaf.size for leaf in leaves), macs, true_macs
        costs.append(AdapterCost(name, *sizes, time, relative))
    return costs


def _stack_and_tokens(name: str) -> tuple[Block, jax.Array]:
    """Make a stack of one block, and the tokens of four images."""
    backbone = ViTConfig(depth=1, adapter=name)
    tokens = jnp.ones((4, 1 + 16 * 16, backbone.dim), jnp.float32)
    return backbone.init(jax.random.key(0)).blocks, tokens  # pyright: ignore[reportReturnType]


@functools.cache
def _block_program(name: str) -> jax.stages.Compiled:
    """Compile the gradient of a block for its adapter and its input; its weights are frozen."""
    backbone = ViTConfig(depth=1, adapter=name)

    def total(adapter: Any, stack: Block, tokens: jax.Array) -> jax.Array:
        stack = dataclasses.replace(stack, adapter=adapter)
        return run_blocks([stack], tokens, (16, 16), backbone)[0].sum()

    def gradient(stack: Block, tokens: jax.Array) -> Any:
        return jax.grad(total, argnums=(0, 2))(stack.adapter, stack, tokens)

    return jit(gradient).lower(*_stack_and_tokens(name)).compile()
