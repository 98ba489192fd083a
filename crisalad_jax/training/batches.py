"""The batches of a training set of places, epoch by epoch."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.data.class_groups import class_groups
from crisalad_jax.data.loader import ImageBatch, batches_of_groups
from crisalad_jax.data.places import Places
from crisalad_jax.data.samplers.base import Describe, epoch_batches, labels_of
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.utils.shapes import Int, Int32


def prepared_as(config: TrainConfig) -> dict[str, Any]:
    """Return how a run's images are prepared, as `data.loader` takes it."""
    return {
        "image_size": config.model.input_size,
        "preprocessing": config.model.preprocessing,
        "augmentation": config.augmentation,
    }


class Drawn(NamedTuple):
    """The batches of an epoch that were drawn by descriptors, which a run saves with its state."""

    step: Int32[np.ndarray, ""]
    """First step of the epoch; -1 before the first."""
    images: Int32[np.ndarray, "steps places images"]


class PlaceBatches:
    """The batches of places, or of groups of classes that epochs take in turn."""

    def __init__(self, config: TrainConfig, places: Places, **reading: Any) -> None:
        """Divide the places into groups where the loss classifies, and count the steps.

        Args:
            config: the run's.
            places: the training set.
            **reading: how images are read; see `batches_of_groups`.

        Raises:
            InputError: there are too few places, classes or images, or positions are missing.
        """
        self._reading = prepared_as(config) | reading
        self._groups: Sequence[Places] = (places,)
        self.classes: tuple[int, ...] = ()
        """Number of classes of each group, where the loss classifies."""
        grouping = config.loss.kind.grouping
        if grouping is not None:
            self._groups = class_groups(
                places,
                grouping,
                min_images=config.min_images,
                places_per_batch=config.places_per_batch,
            )
            self.classes = tuple(len(group.names) for group in self._groups)
        self._config = config
        self.mined: Drawn | None = None
        """The epoch that trains now, where it was drawn by descriptors; a run saves it."""
        if config.sampler.describes:
            config.sampler.check(places)
            steps = max(1, len(places.names) // config.places_per_batch)
            shape = steps, config.places_per_batch, config.images_per_place
            self.mined = Drawn(np.array(-1, np.int32), np.zeros(shape, np.int32))
        else:
            steps = None if grouping is None else grouping.steps
            steps = steps or max(len(self._draw(group, 0)) for group in self._groups)
        self.steps_per_epoch = self.steps_per_round = steps

    def is_due(self, step: int) -> bool:
        """Return whether an epoch begins with this step, whose batches take descriptors."""
        begins = step % self.steps_per_epoch == 0
        return self.mined is not None and begins and int(self.mined.step) != step

    def mine(self, step: int, describe: Describe) -> str:
        """Draw the batches of the epoch that begins with a step.

        Args:
            step: its first.
            describe: describes images by the model as it is.

        Returns:
            What was done, for the user.
        """
        chosen = self._draw(
            self._groups[0], step // self.steps_per_epoch, self.steps_per_epoch, describe
        )
        self.mined = Drawn(np.array(step, np.int32), chosen.astype(np.int32))
        sampler = self._config.sampler.part_name
        return f"drew {len(chosen)} batches by descriptors (sampler {sampler})"

    def batches(self, step: int) -> Iterator[ImageBatch]:
        """Yield the batches from `step` to the end of its epoch; see `batches_of_groups`."""
        epoch, start_step = divmod(step, self.steps_per_epoch)
        places = self._groups[epoch % len(self._groups)]
        if self.mined is None:
            chosen = self._draw(places, epoch, self.steps_per_epoch)
        else:
            chosen = self.mined.images
        return batches_of_groups(
            places,
            chosen,
            labels_of(places, self._config.sampler, chosen),
            seed=(self._config.seed, epoch),
            start_step=start_step,
            **self._reading,
        )

    def _draw(
        self,
        places: Places,
        epoch: int,
        steps: int | None = None,
        describe: Describe | None = None,
    ) -> Int[np.ndarray, "steps places images"]:
        config = self._config
        return epoch_batches(
            places,
            sampler=config.sampler,
            places_per_batch=config.places_per_batch,
            images_per_place=config.images_per_place,
            seed=config.seed,
            epoch=epoch,
            steps=steps,
            describe=describe,
        )
