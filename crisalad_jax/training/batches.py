"""The batches that a configuration asks for, epoch by epoch."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from crisalad_jax.data.class_groups import class_groups
from crisalad_jax.data.loader import ImageBatch, batches_of_groups, training_batches
from crisalad_jax.data.places import Places, epoch_batches
from crisalad_jax.data.query_set import QuerySet
from crisalad_jax.losses.pairs import tuple_labels
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.mining import Mined
from crisalad_jax.utils.errors import InputError


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


class Rounds(NamedTuple):
    """The rounds of an epoch, of equal size; tuples are mined before each."""

    count: int
    steps: int


def rounds_of(config: TrainConfig, queries: QuerySet) -> Rounds:
    """Divide an epoch into rounds of whole batches.

    Raises:
        InputError: the queries make no batch.
    """
    mining = config.mining
    queries_per_epoch = mining.queries_per_epoch or len(queries.queries)
    rounds = math.ceil(queries_per_epoch / mining.queries_per_round)
    size = min(queries_per_epoch // rounds, len(queries.queries))
    steps = size // config.places_per_batch
    if not steps:
        raise InputError(
            f"{queries.root}: found rounds of {size} queries, of {len(queries.queries)} with "
            f"positives, mining.queries_per_epoch {mining.queries_per_epoch} and queries_per_round "
            f"{mining.queries_per_round}, expected at least places_per_batch "
            f"{config.places_per_batch}"
        )
    return Rounds(rounds, steps)


def batches_of_tuples(
    config: TrainConfig, queries: QuerySet, mined: Mined, **options: Any
) -> Iterator[ImageBatch]:
    """Yield the batches of a round; `options` go to `batches_of_groups`."""
    shape = (-1, config.places_per_batch, config.images_per_place)
    return batches_of_groups(
        queries,
        mined.images.reshape(shape),
        tuple_labels(mined.roles).reshape(shape),
        image_size=config.model.input_size,
        preprocessing=config.model.preprocessing,
        augmentation=config.augmentation,
        seed=(config.seed, int(mined.step)),
        **options,
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
