"""The training state on the devices, and the compiled steps that change it."""

import collections
import math
import time
from collections.abc import Generator, Iterator, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray, PyTree

from crisalad_jax.data.loader import ImageBatch, one_ahead
from crisalad_jax.nn.model import Crisalad, cast_params
from crisalad_jax.training import distributed
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.mining import Batches
from crisalad_jax.training.step import (
    Metrics,
    TrainState,
    init_train_state,
    named_scalars,
    step_config,
    train_step,
)
from crisalad_jax.training.trainable import merge_params, shards_batch
from crisalad_jax.utils.devices import Devices, devices_for
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn

_T = TypeVar("_T")
Batch = tuple[jax.Array, jax.Array, jax.Array, jax.Array | None]
"""Images, labels, which images are valid, and a teacher's descriptors of them, on the devices."""


class LossNotFiniteError(InputError):
    """The loss or its gradient is not finite."""


class Trainer:
    """The training state on the devices; a step is started before the previous one is finished."""

    def __init__(
        self,
        config: TrainConfig,
        data: Batches,
        initial: Crisalad,
        *,
        shard_state: bool,
        targets: np.ndarray | None = None,
    ) -> None:
        """Make the state before the first step; `data` yields the batches; see `fit` for the rest.

        Raises:
            InputError: the configuration does not fit the model or the devices.
        """
        self._config, self._devices, self._targets = config, _choose_devices(config), targets
        mesh = self._devices.mesh
        if shard_state and mesh.size == 1:
            raise InputError(
                "shard_state: found one device for the state, expected several; CPU devices do "
                "not share a step if all parameters train"
            )
        self._step_config = step_config(
            config,
            steps=data.steps_per_epoch * config.epochs,
            steps_per_epoch=data.steps_per_epoch,
            classes=data.classes,
            shard_over=mesh if shard_state else None,
        )
        _, self._step_key, classifiers_key = run_keys(config.seed)
        self.state, frozen = init_train_state(
            initial, config.trainable, self._step_config, key=classifiers_key
        )
        self._frozen: PyTree = jax.device_get(frozen)
        self._frozen_on_devices = self._devices.replicate(cast_params(self._frozen, config.model))
        self._place = self._devices.shard if shard_state else self._devices.replicate
        self._proceed: Any = self._devices.replicate(np.asarray(True))
        self._running: collections.deque[tuple[Metrics, int, float]] = collections.deque()
        """Metrics of the steps that the devices may still be computing, number of their images, and
        seconds spent waiting for these."""
        self._finished_at = 0.0
        distributed.raise_together(self._check_memory)

    def resume(self, state: TrainState) -> None:
        """Resume from a state, which has to be the same in all processes."""
        # Copied, because a step donates the buffers of its state.
        self.state = jax.jit(lambda state: jax.tree.map(jnp.copy, state))(self._place(state))

    def on_devices(self, batches: Iterator[ImageBatch]) -> Generator[Batch, None, None]:
        """Yield batches on the devices, each copied while the devices compute the previous one."""
        return one_ahead(self._batch(batch) for batch in batches)

    def start_step(self, batch: Batch | None, waited: float) -> None:
        """Start a step, while the devices may still be computing the previous one.

        After a step that is not taken, no later one is taken either (`train_step`).

        Args:
            batch: the batch; None if this process has failed to read it.
            waited: seconds spent waiting for the batch.
        """
        if not self._running:
            self._finished_at = time.monotonic() - waited
        images, labels, valid, targets = batch or self._no_images()
        arguments = self.state, self._frozen_on_devices, images, labels, valid
        how = self._step_key, self._step_config, self._proceed, targets
        self.state, metrics = train_step(*arguments, *how)
        self._proceed = metrics.updated
        self._running.append((metrics, len(images), waited))

    def finish_steps(self, *, leave: int = 0) -> Iterator[dict[str, float]]:
        """Wait for the started steps except the last `leave`.

        Yields:
            The metrics to log for each step.

        Raises:
            InputError: none of a step's images could be read.
            LossNotFiniteError: the loss or gradient was not finite; `state` precedes the step.
        """
        while len(self._running) > leave:
            metrics, size, waited = self._running.popleft()
            values = named_scalars(jax.device_get(metrics))
            now = time.monotonic()
            seconds, self._finished_at = now - self._finished_at, now
            skipped = size - int(values.pop("images"))
            if not values.pop("updated"):
                step = int(self.state.step) + 1
                if skipped == size:
                    raise InputError(
                        f"training: found none of the {size} images of step {step} readable, "
                        "expected at least one"
                    )
                raise LossNotFiniteError(
                    f"training: found loss {values['loss']:.4g}, gradient_norm "
                    f"{values['gradient_norm']:.4g} at step {step}, expected finite numbers; the "
                    f"state after step {step - 1} is saved"
                )
            yield {
                # The shares of a transport plan without mass are NaN, which JSON lacks.
                **{name: value for name, value in values.items() if math.isfinite(value)},
                "images_per_second": round(size / seconds, 2),
                "waited_for_images": round(min(waited / seconds, 1), 4),
                "skipped_images": skipped,
            }

    def gather(self, tree: _T) -> _T:
        """Gather the state, or a part of it; all processes call it together."""
        return self._devices.gather(tree)

    def params(self, trainable: PyTree = None) -> Crisalad:
        """Return the float32 model with gathered `trainable`; None gathers `state.averaged`."""
        if trainable is None:
            trainable = self.gather(self.state.averaged)
        return merge_params(trainable, jax.tree.map(jnp.asarray, self._frozen), self._config.model)

    def _batch(self, batch: ImageBatch) -> Batch:
        place, valid, targets = self._devices.shard_batch, batch.valid, None
        if self._targets is not None:
            rows = self._targets[batch.indices]
            # Zeros mark an image that the teacher could not read.
            valid, targets = valid & rows.any(axis=1), place(rows)
        return place(batch.images), place(batch.labels), place(valid), targets

    def _no_images(self) -> Batch:
        """Return a batch without valid images."""
        own = self._config.places_per_batch * self._config.images_per_place // jax.process_count()
        images = np.zeros((own, *self._config.model.input_size, 3), np.uint8)
        none = np.full(own, -1, np.int32)
        return self._batch(ImageBatch(images, none, np.zeros(own, bool), none.astype(np.int64)))

    def _check_memory(self) -> None:
        """Check that a step fits the devices' memory, by the compiler's analysis of its program.

        The first step reuses the program that is compiled here. A TPU's compiler checks the limit
        itself.
        """
        limit = memory_limit(self._devices.mesh.local_devices)
        if limit is None:
            return
        state, (*batch, targets) = self._place(self.state), self._no_images()
        arguments = state, self._frozen_on_devices, *batch, self._step_key, self._step_config
        try:
            needed = memory_of(train_step.lower(*arguments, self._proceed, targets).compile())
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            needed = math.inf
        if needed > limit:
            raise InputError(
                f"training: found a step that takes {needed / 1e9:.1f} GB of each device, expected "
                f"at most {limit / 1e9:.1f} GB; reduce it with a smaller --micro-batch (now "
                f"{self._config.micro_batch}), --model.compute-dtype bfloat16, --model.remat full, "
                "--shard-state, a smaller image or model, or more devices"
            )


def run_keys(seed: int) -> tuple[PRNGKeyArray, PRNGKeyArray, PRNGKeyArray]:
    """Make the random keys of a run: for initial parameters, dropout and the loss's parameters."""
    key = jax.random.key(seed)
    params, dropout = jax.random.split(key)
    # Folds in 2, because folding in 0 or 1 may repeat the keys of the split.
    return params, dropout, jax.random.fold_in(key, 2)


def _choose_devices(config: TrainConfig) -> Devices:
    """Choose the devices of a step: all that share its images, or one for each process."""
    images = config.places_per_batch * config.images_per_place
    devices = devices_for(images, processes=True)
    if not shards_batch(config.trainable):
        return devices_for(jax.process_count(), processes=True)
    found, used = len(jax.devices()), devices.mesh.size
    if used < found and distributed.is_primary():
        warn(
            f"training: found {found} devices for {images} images a step, of which {used} share "
            "them, the most that divide them in each process"
        )
    return devices


def memory_limit(devices: Sequence[Any]) -> int | None:
    """Return the bytes that a program may use on each device; None if the platform reports none."""
    limits = [(device.memory_stats() or {}).get("bytes_limit", 0) for device in devices]
    return min(limits, default=0) or None


def memory_of(program: jax.stages.Compiled) -> int:
    """Return the bytes that a compiled program uses on each device: all that it reads and writes.

    Args:
        program: compiled with a state that it may overwrite (`donate_argnames`).
    """
    sizes = program.memory_analysis()
    assert sizes is not None
    total = sizes.argument_size_in_bytes + sizes.output_size_in_bytes + sizes.temp_size_in_bytes
    return total + sizes.generated_code_size_in_bytes - sizes.alias_size_in_bytes
