"""The batches of a training set of places, epoch by epoch."""

from collections.abc import Iterator, Sequence
from typing import Any

from crisalad_jax.data.class_groups import class_groups
from crisalad_jax.data.loader import ImageBatch, training_batches
from crisalad_jax.data.places import Places, epoch_batches
from crisalad_jax.training.config import TrainConfig


def prepared_as(config: TrainConfig) -> dict[str, Any]:
    """Return how a run's images are prepared, as `data.loader` takes it."""
    return {
        "image_size": config.model.input_size,
        "preprocessing": config.model.preprocessing,
        "augmentation": config.augmentation,
    }


class PlaceBatches:
    """The batches of places, or of groups of classes that epochs take in turn."""

    mined: None = None

    def __init__(self, config: TrainConfig, places: Places, **reading: Any) -> None:
        """Divide the places into groups where the loss classifies, and count the steps.

        Args:
            config: the run's.
            places: the training set.
            **reading: how images are read; see `training_batches`.

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
        self._drawing: Any = {
            "places_per_batch": config.places_per_batch,
            "images_per_place": config.images_per_place,
            "order": config.batch_order,
            "seed": config.seed,
        }
        steps = None if grouping is None else grouping.steps
        self.steps_per_epoch = self.steps_per_round = steps or max(
            len(epoch_batches(group, **self._drawing, epoch=0)) for group in self._groups
        )

    def batches(self, step: int) -> Iterator[ImageBatch]:
        """Yield the batches from `step` to the end of its epoch; see `training_batches`."""
        epoch, start_step = divmod(step, self.steps_per_epoch)
        return training_batches(
            self._groups[epoch % len(self._groups)],
            epoch=epoch,
            steps=self.steps_per_epoch,
            start_step=start_step,
            **self._drawing,
            **self._reading,
        )
