"""Time one program of this package under given options of XLA: a child of `study_compiler.py`.

    python scripts/bench/compiled_by.py '{"work": "describe", "preset": "tiny", "dtype": "float32",
        "batch": 8, "devices": 2, "options": {}}'

A process of its own, because devices are counted once and because options may end it. It prints a
line of JSON: images a second (median of the calls), seconds of the first call, and megabytes that
the program needs beyond parameters and images. Without options (null) it has the package's own.
"""

import dataclasses
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
"""A program is called for that long, and at least that often."""


def describing(batch: int, devices: Any, preset: str, dtype: str) -> tuple[Callable[[], Any], Any]:
    """What describes a batch of bytes, and the same compiled."""
    config = dataclasses.replace(PRESETS[preset], compute_dtype=dtype)
    params = devices.replicate(init_crisalad(jax.random.key(0), config))
    images = np.random.default_rng(0).integers(0, 256, (batch, *config.image_size, 3), np.uint8)
    arguments = (params, devices.shard_batch(images), config)
    return lambda: describe(*arguments), lambda: describe.lower(*arguments).compile()  # pyright: ignore


def training(batch: int, devices: Any, preset: str, dtype: str) -> tuple[Callable[[], Any], Any]:
    """What takes a training step of the preset's recipe, and the same compiled."""
    config = recipe(preset)
    model = dataclasses.replace(config.model, compute_dtype=dtype)
    step = StepConfig(model, config.loss, config.optimiser, 1000)
    params = init_crisalad(jax.random.key(0), model)
    state, frozen = devices.replicate(init_train_state(params, config.trainable, step))
    state = jax.tree.map(jax.numpy.copy, state)
    images = np.random.default_rng(0).integers(0, 256, (batch, *model.image_size, 3), np.uint8)
    labels = (np.arange(batch) // 4).astype(np.int32)
    rest = (frozen, devices.shard_batch(images), labels, np.ones(batch, bool), jax.random.key(0))

    def call() -> Any:
        nonlocal state
        state, metrics = train_step(state, *rest, step)
        return metrics.loss

    return call, lambda: train_step.lower(state, *rest, step).compile()  # pyright: ignore


def timed(call: Callable[[], Any]) -> float:
    started = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - started


def main(asked: dict[str, Any]) -> None:
    jax.config.update("jax_num_cpu_devices", asked["devices"])
    if asked["options"] is not None:  # else the package's own
        compiler.compiler_options = lambda library, brief=False: asked["options"]
    make = {"describe": describing, "train": training}[asked["work"]]
    devices = devices_for(asked["batch"] if asked["devices"] > 1 else 1)
    call, compiled = make(asked["batch"], devices, asked["preset"], asked["dtype"])
    first = timed(call)
    times, end = [], time.perf_counter() + SECONDS
    while len(times) < CALLS or time.perf_counter() < end:
        times.append(timed(call))
    found = {
        "jax": jax.__version__,
        "rate": asked["batch"] / statistics.median(times),
        "first": first,
        "megabytes": devices.mesh.size * compiled().memory_analysis().temp_size_in_bytes / 1e6,
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
