"""The batches that a configuration asks for, epoch by epoch."""

from collections.abc import Iterator, Sequence
from typing import Any

from crisalad_jax.data.class_groups import class_groups
from crisalad_jax.data.loader import ImageBatch, training_batches
from crisalad_jax.data.places import Places, epoch_batches
from crisalad_jax.training.config import TrainConfig


def groups_of(config: TrainConfig, places: Places) -> tuple[Places, ...]:
    """List what epochs draw from in turn: all places, or groups of classes (`data.class_groups`).

    Raises:
        InputError: there are too few classes, or positions are missing.
    """
    grouping = config.loss.kind.grouping
    if grouping is None:
        return (places,)
    return class_groups(
        places,
        grouping,
        min_images=config.min_images,
        places_per_batch=config.places_per_batch,
    )


def steps_per_epoch(config: TrainConfig, groups: Sequence[Places]) -> int:
    """Count the steps of every epoch: as configured, or one pass over the largest group.

    Raises:
        InputError: a group has too few places or images for a batch.
    """
    grouping = config.loss.kind.grouping
    if grouping is not None and grouping.steps is not None:
        return grouping.steps
    return max(
        len(
            epoch_batches(
                group,
                places_per_batch=config.places_per_batch,
                images_per_place=config.images_per_place,
                order=config.batch_order,
                seed=config.seed,
                epoch=0,
            )
        )
        for group in groups
    )


def batches_of(
    config: TrainConfig, places: Places, epoch: int, **options: Any
) -> Iterator[ImageBatch]:
    """Yield the batches of an epoch; `options` go to `training_batches`."""
    return training_batches(
        places,
        image_size=config.model.input_size,
        preprocessing=config.model.preprocessing,
        places_per_batch=config.places_per_batch,
        images_per_place=config.images_per_place,
        order=config.batch_order,
        augmentation=config.augmentation,
        seed=config.seed,
        epoch=epoch,
        **options,
    )
