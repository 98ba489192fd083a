"""The parameters that a run starts from: a whole model, a backbone, or random numbers."""

import functools
import os

import jax

from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.checkpoints.public import with_backbone_of
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.data.places import Places
from crisalad_jax.data.query_set import QuerySet
from crisalad_jax.nn.model import Crisalad, Model, init_crisalad
from crisalad_jax.training import distributed
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.vocabulary import with_vocabulary
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn


def read_start(
    config: TrainConfig,
    *,
    weights: str | os.PathLike[str] | None = None,
    backbone: str | os.PathLike[str] | None = None,
    quiet: bool = False,
) -> Crisalad | None:
    """Read the parameters that a run starts from.

    A note tells of weights that were made for images of another size, or resized in another way.

    Args:
        config: the run's; `recipe` takes the model of weights.
        weights: a whole model of this package, or a published model's name.
        backbone: a checkpoint of which the backbone alone is taken, public or of this package, or a
            published model's name.
        quiet: no progress bar of a download.

    Returns:
        All parameters; None for random ones, with neither file.

    Raises:
        InputError: both are given, or a file cannot be read or does not fit the model.
    """
    if weights is not None:
        if backbone is not None:
            raise InputError("--backbone: found beside --weights, expected only one of the two")
        file = find_weights(weights, quiet=quiet)
        params, theirs = load_weights(file, expected=config.model)
        if theirs.images_in_words != config.model.images_in_words:
            warn(
                f"{weights}: found weights for images at {theirs.images_in_words}; this run trains "
                f"and is saved with {config.model.images_in_words}"
            )
        return params
    if backbone is None:
        return None
    backbone = find_weights(backbone, quiet=quiet)
    fresh = init_crisalad(jax.random.key(config.seed), config.model)
    return with_backbone_of(fresh, config.model, backbone)


def with_vocabulary_of(
    initial: Crisalad | None,
    config: TrainConfig,
    places: Places | QuerySet,
    *,
    on_bad_image: OnBadImage = "stop",
    quiet: bool = False,
) -> Crisalad | None:
    """Fit an aggregator's centroids to the training images, if it starts from centroids.

    The same start always gets the same centroids, so that runs can resume. All processes call it
    together, and each gets the centroids of the primary process.

    Args:
        initial: the parameters; None for random ones, by the run's seed.
        config: the run's.
        places: the training images.
        on_bad_image: "stop", or "skip" to leave unreadable images out.
        quiet: no progress bar.

    Returns:
        The parameters; as they are where the aggregator has no centroids.

    Raises:
        InputError: what `with_vocabulary` raises.
    """
    if not config.model.aggregator.starts_from_centroids:
        return initial
    if initial is None:
        initial = init_crisalad(jax.random.key(config.seed), config.model)
    count = places.database if isinstance(places, QuerySet) else len(places.files)
    build = functools.partial(
        with_vocabulary,
        *(Model(initial, config.model), [places.path(image) for image in range(count)]),
        images=config.model.aggregator.centroid_images,
        seed=config.seed,
        on_bad_image=on_bad_image,
        quiet=quiet or not distributed.is_primary(),
    )
    return distributed.broadcast(distributed.raise_together(build))
