"""Measure the memory of a training step of the paper's size by the compiler's analysis.

    python scripts/bench/bench_memory.py [--out docs/training]
        [--preset b14] [--images 192] [--micro-batches 24] [--take]

The paper's recipe (adapters and head train, the rest is frozen) with 48 places x 4 images is
compiled for one device: in float32 and bfloat16, all at once and in micro-batches. "temporary" is
what the program needs in addition to its inputs; the inputs are weights, moments and images.
`--take` also takes one step in float32 with micro-batches, over this machine's devices, on random
images; its memory is the peak of the process, including the compiler.
"""

import argparse
import dataclasses
import resource
import sys
from typing import Any

import jax
import numpy as np
from tables import Study, Table, count, flags, leave, read

from crisalad_jax.nn.config import PRESETS
from crisalad_jax.nn.model import cast_params, init_crisalad
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.recipes import recipe
from crisalad_jax.training.step import StepConfig, init_train_state, train_step
from crisalad_jax.utils import compiler
from crisalad_jax.utils.devices import devices_for

CARD = 24e9
"""Bytes of the card that a step should fit on."""


def step_of(config: TrainConfig, dtype: str, micro_batch: int | None) -> StepConfig:
    model = dataclasses.replace(config.model, compute_dtype=dtype)
    return StepConfig(model, config.loss, config.optimiser, 1000, micro_batch=micro_batch)


def batch_of(config: TrainConfig, images: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    shape = (images, *config.model.image_size, 3)
    pixels = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    labels = np.arange(images, dtype=np.int32) // config.images_per_place
    return pixels, labels, np.ones(images, np.bool_)


def analysed(config: TrainConfig, step: StepConfig, images: int) -> dict[str, Any]:
    """Analyse the memory of a step in bytes, without allocating any array."""

    def start() -> Any:
        state, frozen = init_train_state(
            init_crisalad(jax.random.key(0), step.model), config.trainable, step
        )
        return state, cast_params(frozen, step.model)

    batch = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in batch_of(config, images)]
    key = jax.eval_shape(lambda: jax.random.key(0))
    lowered = train_step.lower(*jax.eval_shape(start), *batch, key, step)  # pyright: ignore
    found: Any = lowered.compile().memory_analysis()
    return {
        "type": step.compute_dtype,
        "micro_batch": step.micro_batch,
        "temporary": found.temp_size_in_bytes,
        "given": found.argument_size_in_bytes,
    }


def taken(config: TrainConfig, step: StepConfig, images: int) -> dict[str, Any]:
    devices = devices_for(images)
    state, frozen = init_train_state(
        init_crisalad(jax.random.key(0), step.model), config.trainable, step
    )
    frozen = devices.replicate(cast_params(jax.device_get(frozen), step.model))
    state = jax.jit(lambda tree: jax.tree.map(jax.numpy.copy, tree))(devices.replicate(state))
    pixels, labels, valid = map(devices.shard_batch, batch_of(config, images))
    state, metrics = train_step(state, frozen, pixels, labels, valid, jax.random.key(1), step)
    # Linux reports KiB, other systems bytes.
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "steps": int(state.step),
        "loss": float(metrics.loss),
        "gradient_norm": float(metrics.gradient_norm),
        "devices": devices.mesh.size,
        "memory": most * (1024 if sys.platform == "linux" else 1),
    }


def table(values: dict[str, Any], arguments: argparse.Namespace) -> Table:
    rows = []
    for one in values["analysed"]:
        size = one["temporary"] + one["given"]
        batch = "all at once" if one["micro_batch"] is None else f"{one['micro_batch']} at a time"
        sizes = (f"{x / 1e9:.2f}" for x in (one["temporary"], one["given"], size))
        rows.append((one["type"], batch, *sizes, "yes" if size < CARD else "no"))
    caption = (
        f"Memory in GB of a training step of {arguments.images} images, {arguments.preset} at "
        "224 x 224, for one device, by XLA's memory analysis "
        f"({jax.default_backend()}, jax {jax.__version__})."
    )
    if one := values.get("taken"):
        caption += (
            f" One such step was taken, {arguments.micro_batches[0]} images at a time in float32, "
            f"on {one['devices']} CPU devices: loss {one['loss']:.3f}, peak memory of the process "
            f"{one['memory'] / 1e9:.1f} GB."
        )
    header = ("type", "images", "temporary", "inputs", "total", "fits 24 GB")
    return Table(header, rows, caption, 2)


def main() -> None:
    parser = flags(__doc__ or "", "docs/training")
    parser.add_argument("--preset", choices=PRESETS, default="b14")
    parser.add_argument("--images", type=count, default=192)
    parser.add_argument("--micro-batches", type=count, nargs="+", default=[24])
    parser.add_argument("--take", action="store_true", help="also take a step")
    arguments = read(parser, "bench_memory")
    if arguments.images % 4 or any(arguments.images % n for n in arguments.micro_batches):
        parser.error(f"found {arguments.images} images, expected a multiple of 4 and micro-batches")
    compiler.configure()
    config = recipe(arguments.preset, "crisalad")
    values: dict[str, Any] = {}
    if arguments.take:
        step = step_of(config, "float32", arguments.micro_batches[0])
        values["taken"] = taken(config, step, arguments.images)
    values["analysed"] = [
        analysed(config, step_of(config, dtype, micro_batch), arguments.images)
        for dtype in ("float32", "bfloat16")
        for micro_batch in (*arguments.micro_batches, None)
    ]
    leave("bench_memory", Study(table(values, arguments), values), arguments)


if __name__ == "__main__":
    main()
