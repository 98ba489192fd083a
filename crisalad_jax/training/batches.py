"""The batches of a training set of places, or of a mixture of sets, epoch by epoch."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.data.class_groups import class_groups
from crisalad_jax.data.loader import ImageBatch, batches_of_groups
from crisalad_jax.data.places import JoinedPlaces, Places
from crisalad_jax.data.query_set import QuerySet
from crisalad_jax.data.samplers.base import Describe, epoch_batches, labels_of
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.utils.shapes import Int, Int32

TrainingSet = Places | QuerySet | Mapping[str, Places]
"""What a run trains on: places, queries to mine tuples for, or a mixture's sets by name."""


def sets_of(places: TrainingSet) -> tuple[Places | QuerySet, ...]:
    """Return the sets of a mixture in the order of their names, or the single set."""
    if isinstance(places, Mapping):
        return tuple(places[name] for name in sorted(places))
    return (places,)


def prepared_as(config: TrainConfig) -> dict[str, Any]:
    """Return how a run's images are prepared, as keyword arguments for `data.loader`."""
    return {
        "image_size": config.model.input_size,
        "preprocessing": config.model.preprocessing,
        "augmentation": config.augmentation,
    }


class Drawn(NamedTuple):
    """An epoch's batches, as image indices drawn by descriptors; a run saves them in its state."""

    step: Int32[np.ndarray, ""]
    """First step of the epoch; -1 before the first epoch."""
    images: Int32[np.ndarray, "steps places images"]


class PlaceBatches:
    """Batches of places from one set or a mixture, or from groups of classes in turn.

    The images of a mixture are numbered consecutively over its sets, and a batch concatenates one
    sub-batch of each set.
    """

    def __init__(
        self, config: TrainConfig, places: Places | Mapping[str, Places], **reading: Any
    ) -> None:
        """Divide the places into groups of classes if the loss classifies, and count the steps.

        Args:
            config: the run's configuration.
            places: the training set, or those of the mixture by name.
            **reading: how images are read; see `batches_of_groups`.

        Raises:
            InputError: there are too few places, classes or images, or positions are missing.
        """
        self._reading = prepared_as(config) | reading
        self._runs = config.alone
        sets = (places,) if isinstance(places, Places) else [places[m.name] for m in config.mixture]
        self._turns = (JoinedPlaces(tuple(sets)),)
        """What each epoch in turn trains on: all sets, or one group of classes."""
        self.classes: tuple[int, ...] = ()
        """Number of classes of each group, if the loss classifies; otherwise empty."""
        grouping = config.loss.kind.grouping
        if grouping is not None:
            (places,) = sets
            groups = class_groups(
                places,
                grouping,
                min_images=config.min_images,
                places_per_batch=config.places_per_batch,
            )
            self._turns = tuple(JoinedPlaces((group,)) for group in groups)
            self.classes = tuple(len(group.names) for group in groups)
        self.mined: Drawn | None = None
        """Batches of the current epoch, if a sampler reads descriptors; a run saves them."""
        # Each set draws once, to fail before the run if it cannot. The first defines the epoch.
        each_set = zip(self._runs, *(turn.sets for turn in self._turns), strict=True)
        steps, *_ = [_steps(run, *groups) for run, *groups in each_set]
        if grouping is not None and grouping.steps is not None:
            steps = grouping.steps
        self.steps_per_epoch = self.steps_per_round = steps
        if any(run.sampler.describes for run in self._runs):
            shape = steps, config.places_per_batch, config.images_per_place
            self.mined = Drawn(np.array(-1, np.int32), np.zeros(shape, np.int32))

    def is_due(self, step: int) -> bool:
        """Return whether this step begins an epoch that `mine` has yet to draw."""
        begins = step % self.steps_per_epoch == 0
        return self.mined is not None and begins and int(self.mined.step) != step

    def mine(self, step: int, describe: Describe) -> str:
        """Draw the batches of the epoch that begins with a step.

        Args:
            step: the first step of the epoch.
            describe: function that describes image files with the current model.

        Returns:
            A message for the user, with the number of batches.
        """
        chosen = self._draw(step // self.steps_per_epoch, describe)
        self.mined = Drawn(np.array(step, np.int32), chosen.astype(np.int32))
        names = [run.sampler.part_name for run in self._runs if run.sampler.describes]
        return f"drew {len(chosen)} batches by descriptors (sampler {', '.join(names)})"

    def batches(self, step: int) -> Iterator[ImageBatch]:
        """Yield the batches from `step` to the end of its epoch; see `batches_of_groups`."""
        epoch, start_step = divmod(step, self.steps_per_epoch)
        chosen = self._draw(epoch) if self.mined is None else self.mined.images
        joined = self._turns[epoch % len(self._turns)]
        ends = np.cumsum([run.places_per_batch for run in self._runs])
        parts = np.split(chosen, ends[:-1], axis=1)
        labels = [
            labels_of(places, run.sampler, part - start)
            for run, places, start, part in zip(
                self._runs, joined.sets, joined.starts[:-1], parts, strict=True
            )
        ]
        return batches_of_groups(
            joined,
            chosen,
            np.concatenate(labels, axis=1),
            seed=(self._runs[0].seed, epoch),
            start_step=start_step,
            **self._reading,
        )

    def _draw(
        self, epoch: int, describe: Describe | None = None
    ) -> Int[np.ndarray, "steps places images"]:
        """Draw the batches of an epoch from all sets."""
        joined = self._turns[epoch % len(self._turns)]
        how = {"epoch": epoch, "steps": self.steps_per_epoch, "describe": describe}
        drawn = [
            _draw(run, places, **how) + start
            for run, places, start in zip(self._runs, joined.sets, joined.starts[:-1], strict=True)
        ]
        return np.concatenate(drawn, axis=1)


def _draw(run: TrainConfig, places: Places, **how: Any) -> Int[np.ndarray, "steps places images"]:
    """Draw the sub-batches of an epoch from one set, as `epoch_batches` does."""
    return epoch_batches(
        places,
        sampler=run.sampler,
        places_per_batch=run.places_per_batch,
        images_per_place=run.images_per_place,
        seed=run.seed,
        **how,
    )


def _steps(run: TrainConfig, *groups: Places) -> int:
    """Count the steps that visit each place of a set about once; for groups, the maximum."""
    if run.sampler.describes:
        (places,) = groups
        run.sampler.check(places)
        return max(1, len(places.names) // run.places_per_batch)
    return max(len(_draw(run, group, epoch=0)) for group in groups)
