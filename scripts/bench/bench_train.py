"""Measure images per second of a training step, compared with the same step in torch.

    python scripts/bench/bench_train.py [--out docs/performance]
        [--presets b14 ...] [--batches 8 16] [--dtypes float32 bfloat16] [--keep]

The step is that of the preset's recipe: the paper's (frozen backbone; adapters and head train), and
for `tiny` the whole model. It is a complete step: forward with dropout, mining, loss, backward,
AdamW. Batches have 4 images per place. Weights, images and the rest are as in `bench_describe.py`.

Before anything is timed, losses without dropout are checked to be equal; the parity checks show the
same for 20 steps. Memory is the peak that a step needs beyond what stays between steps, plus each
further device's copy of the trainable parameters and their moments. The operations are counted as
twice the forward pass for layers that pass the gradient on, and three times for layers that also
train.
"""

import argparse
import dataclasses
import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
from bench_describe import (
    OURS,
    TORCHES,
    Case,
    Contender,
    Sides,
    at_size,
    by_torch,
    compare,
    read_race,
    seconds,
    sides,
    title,
)
from timing import torch_memory, wait

# After timing, which says how many devices there are.
import jax  # isort: skip
import jax.numpy as jnp  # isort: skip
import torch  # isort: skip

from crisalad_jax.nn.costs import part_costs
from crisalad_jax.nn.model import describe
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.losses import metric_loss
from crisalad_jax.training.recipes import recipe
from crisalad_jax.training.step import StepConfig, init_train_state, train_step
from crisalad_jax.training.trainable import shards_batch
from crisalad_jax.utils.devices import devices_for
from parity.reference.losses import multi_similarity_loss as torch_loss
from parity.reference.training import clip_gradients, freeze

IMAGES_PER_PLACE = 4
LOSS_TOLERANCES = {"float32": 1e-4, "bfloat16": 5e-2}
"""Relative bounds: similarities differ by 1e-6 and 1e-3, times the loss's exponents up to 50."""
STEPS = 1000
"""Length of the schedule: longer than any race."""


def labels(both: Sides) -> np.ndarray:
    return (np.arange(len(both.images)) // IMAGES_PER_PLACE).astype(np.int32)


def torch_step(both: Sides, config: TrainConfig, compiled: bool) -> Contender:
    parameters = freeze(both.theirs, config.trainable)
    model = torch.compile(both.theirs, dynamic=False) if compiled else both.theirs
    places = torch.from_numpy(labels(both)).long().to(both.theirs_images.device)
    optimiser = torch.optim.AdamW(parameters, lr=config.optimiser.learning_rate, fused=True)

    def call() -> float:
        both.theirs.train()
        optimiser.zero_grad()
        loss = torch_loss(model(both.theirs_images), places, config.loss).loss
        loss.backward()
        if config.optimiser.clip_norm is not None:
            clip_gradients(parameters, config.optimiser.clip_norm)
        optimiser.step()
        wait()
        return loss.item()

    def memory() -> int:
        optimiser.zero_grad()  # otherwise the gradients of the previous call would count as freed
        return torch_memory(call)

    return Contender(TORCHES[compiled], call, memory)


def our_step(both: Sides, config: TrainConfig, spread: bool) -> Contender:
    step = StepConfig(both.config, config.loss, config.optimiser, STEPS)
    devices = devices_for(len(both.images) if spread else 1)
    state, frozen = devices.replicate(init_train_state(both.ours, config.trainable, step))
    count, size = devices.mesh.size, sum(leaf.nbytes for leaf in jax.tree.leaves(state))
    state = jax.tree.map(jnp.copy, state)
    images = devices.shard_batch(both.images)
    valid = jnp.ones(len(both.images), bool)
    rest = (frozen, images, jnp.asarray(labels(both)), valid, jax.random.key(0))

    def call() -> float:
        nonlocal state
        state, metrics = train_step(state, *rest, step)
        return float(metrics.loss)

    def compiled() -> Any:
        return train_step.lower(state, *rest, step).compile()  # pyright: ignore

    def memory() -> int:
        return count * compiled().memory_analysis().temp_size_in_bytes + (count - 1) * size

    return Contender(OURS[spread], call, memory, lambda: compiled().as_text(), count)


def check(both: Sides, config: TrainConfig, tolerance: float) -> None:
    """Check that the losses without dropout are equal.

    Raises:
        RuntimeError: they are not.
    """
    theirs = by_torch(both, compiled=False).call()
    places = labels(both)
    expected = float(torch_loss(theirs.float().cpu(), torch.from_numpy(places), config.loss).loss)
    ours = describe(both.ours, jax.device_put(both.images), both.config)
    everyone = jnp.ones(len(places), bool)
    found = float(metric_loss(ours, jnp.asarray(places), config.loss, valid=everyone)[0])
    if not abs(found - expected) < tolerance * expected:
        raise RuntimeError(f"ours: loss {found} differs from torch's {expected}")


def operations(config: TrainConfig, batch: int) -> float:
    """Count the floating-point operations of one step, products only."""
    total = 0
    for cost in part_costs(config.model, images=batch):
        frozen = config.trainable != "all" and cost.part.startswith("backbone")
        # Nothing before the embedding trains.
        passes = 1 if frozen and "embedding" in cost.part else 2 if frozen else 3
        total += 2 * batch * passes * cost.macs
    return total


def cases(arguments: argparse.Namespace) -> Iterator[Case]:
    for preset, size, dtype, batch in itertools.product(
        arguments.presets, arguments.sizes, arguments.dtypes, arguments.batches
    ):
        config = recipe(preset)
        config = dataclasses.replace(config, model=at_size(config.model, size))
        both = sides(config.model, preset, batch, dtype)
        check(both, config, LOSS_TOLERANCES[dtype])
        contenders = [
            torch_step(both, config, False),
            torch_step(both, config, True),
            our_step(both, config, False),
        ]
        if len(jax.local_devices()) > 1 and shards_batch(config.trainable):
            contenders.append(our_step(both, config, True))
        first = {one.name: seconds(one.call) for one in contenders}
        name, count = title(preset, config.model), operations(config, batch)
        yield Case(name, batch, dtype, contenders, first, count)


def main() -> None:
    arguments = read_race(__doc__ or "", "bench_train")
    compare("bench_train", "A training step", cases(arguments), arguments)


if __name__ == "__main__":
    main()
