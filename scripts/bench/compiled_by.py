"""Time one program under several options of XLA, as a child process of `study_compiler.py`.

    python scripts/bench/compiled_by.py '{"work": "describe", "preset": "tiny", "dtype": "float32",
        "batch": 8, "devices": 2, "rounds": 3, "choices": {"defaults": {}}}'

It is a separate process because the device count is fixed at start-up and because options may crash
it. The options take turns. It prints a line of JSON: for each choice, images per second (the median
of each round), seconds of the first call, and megabytes beyond parameters and images.
"""

import dataclasses
import functools
import json
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from crisalad_jax.nn.config import PRESETS
from crisalad_jax.nn.model import describe, init_crisalad
from crisalad_jax.training.recipes import recipe
from crisalad_jax.training.step import StepConfig, init_train_state, train_step
from crisalad_jax.utils import compiler
from crisalad_jax.utils.devices import devices_for

SECONDS, CALLS = 2.0, 3
"""A program is called for at least that long and that many times."""


def describing(batch: int, devices: Any, preset: str, dtype: str) -> tuple[Callable[[], Any], Any]:
    """Make a call that describes a batch of bytes, and one that compiles it."""
    config = dataclasses.replace(PRESETS[preset], compute_dtype=dtype)
    params = devices.replicate(init_crisalad(jax.random.key(0), config))
    images = np.random.default_rng(0).integers(0, 256, (batch, *config.image_size, 3), np.uint8)
    arguments = (params, devices.shard_batch(images), config)
    return lambda: describe(*arguments), lambda: describe.lower(*arguments).compile()  # pyright: ignore


def training(batch: int, devices: Any, preset: str, dtype: str) -> tuple[Callable[[], Any], Any]:
    """Make a call that takes a training step of the preset's recipe, and one that compiles it."""
    config = recipe(preset)
    model = dataclasses.replace(config.model, compute_dtype=dtype)
    step = StepConfig(model, config.loss, config.optimiser, 1000)
    params = init_crisalad(jax.random.key(0), model)
    state, frozen = devices.replicate(init_train_state(params, config.trainable, step))
    state = jax.tree.map(jax.numpy.copy, state)
    images = np.random.default_rng(0).integers(0, 256, (batch, *model.image_size, 3), np.uint8)
    labels, valid = jax.numpy.arange(batch) // 4, jax.numpy.ones(batch, bool)
    rest = (frozen, devices.shard_batch(images), labels, valid, jax.random.key(0))

    def call() -> Any:
        nonlocal state
        state, metrics = train_step(state, *rest, step)
        return metrics.loss

    return call, lambda: train_step.lower(state, *rest, step).compile()


def timed(call: Callable[[], Any]) -> float:
    started = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - started


def main(asked: dict[str, Any]) -> None:
    jax.config.update("jax_num_cpu_devices", asked["devices"])
    make = {"describe": describing, "train": training}[asked["work"]]
    devices = devices_for(asked["batch"] if asked["devices"] > 1 else 1)
    found, calls = {}, {}
    for name, options in asked["choices"].items():
        chosen = functools.partial(given, options)
        compiler.compiler_options = chosen
        call, compiled = make(asked["batch"], devices, asked["preset"], asked["dtype"])
        first = timed(call)
        needed = compiled().memory_analysis().temp_size_in_bytes
        found[name] = {"first": first, "megabytes": devices.mesh.size * needed / 1e6, "rates": []}
        calls[name] = call, chosen
    for _ in range(asked["rounds"]):
        for name, (call, chosen) in calls.items():
            compiler.compiler_options = chosen
            times, end = [], time.perf_counter() + SECONDS
            while len(times) < CALLS or time.perf_counter() < end:
                times.append(timed(call))
            found[name]["rates"].append(asked["batch"] / statistics.median(times))
    print(json.dumps(found))


def given(options: dict[str, Any], **_: Any) -> dict[str, Any]:
    """Replace `compiler.compiler_options`, and return the options given."""
    return options


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
