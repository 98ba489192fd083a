"""Read what a run needs before its first step: its images and its initial parameters."""

import os
import pathlib
from collections.abc import Mapping
from typing import Any

import jax

from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.checkpoints.public import with_backbone_of
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.config.checks import require
from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.data.places import Places, read_places
from crisalad_jax.data.query_set import QuerySet, read_query_set
from crisalad_jax.nn.model import Crisalad, Model, init_crisalad
from crisalad_jax.training import distributed
from crisalad_jax.training.batches import TrainingSet, sets_of
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.lost import ends_with_the_others
from crisalad_jax.training.mixture import check_names
from crisalad_jax.training.run_files import check_run, checksum_of_config
from crisalad_jax.training.trainable import count_trainable
from crisalad_jax.training.vocabulary import with_vocabulary
from crisalad_jax.utils.output import warn

Path = str | os.PathLike[str]


RunInputs = tuple[TrainingSet, Benchmark | None, Crisalad | None]
"""The training set, the validation set, and the parameters to start from, as `fit` takes them."""


@ends_with_the_others
def read_inputs(
    config: TrainConfig,
    data: Path | Places | Mapping[str, Path],
    out: Path,
    *,
    images: Path | None = None,
    validation: Path | None = None,
    validation_images: Path | None = None,
    weights: Path | None = None,
    backbone: Path | None = None,
    on_bad_image: OnBadImage = "stop",
    quiet: bool = False,
    **grouping: Any,
) -> RunInputs:
    """Read the training set, validation set and initial parameters; see `experiments.train`.

    All processes call it together. Without `weights`, the centroids that an aggregator such as
    NetVLAD starts from are fitted to the training images.

    Args:
        config: the run's configuration.
        data: the training set or its path; for `config.mixture`, a path by the name of each set.
        out: folder of the run, which is checked first.
        images: folder of the images that a file of queries lists.
        validation: path of the validation set; None for a run without validations.
        validation_images: folder of the images that a file at `validation` lists.
        weights: complete model to start from; see `read_start`.
        backbone: checkpoint to take only the backbone from; see `read_start`.
        on_bad_image: "stop", or "skip" to leave unreadable images out.
        quiet: whether to hide progress bars.
        **grouping: how images become places; see `read_places`.

    Returns:
        (training set, validation set or None, initial parameters or None for random ones).

    Raises:
        InputError: a process cannot read its files, or they do not fit; all processes raise it.
    """
    quiet = quiet or not distributed.is_primary()

    def read() -> RunInputs:
        initial = read_start(config, weights=weights, backbone=backbone, quiet=quiet)
        places = _read_set(config, data, images, on_bad_image, grouping)
        if validation is None:
            require(
                validation_images is None, "--val-images: found no --val, expected both or none"
            )
            return places, None, initial
        how: Any = {"images": validation_images, "on_bad_image": on_bad_image}
        return places, open_benchmark(validation, **how), initial

    # A wrong name is rejected before anything is read.
    distributed.raise_together(lambda: count_trainable(config.model, config.trainable))
    distributed.run_on_primary(lambda: check_run(pathlib.Path(out), config))
    places, benchmark, initial = distributed.raise_together(read)
    # Otherwise the collective operations below would not match.
    given = {"configuration": checksum_of_config(config), "--weights": weights is not None}
    distributed.check_same(given)
    if weights is None and config.model.aggregator.trainable:
        how = {"on_bad_image": on_bad_image, "quiet": quiet}
        initial = with_vocabulary_of(initial, config, places, **how)
    return places, benchmark, initial


def _read_set(
    config: TrainConfig,
    data: Path | Places | Mapping[str, Path],
    images: Path | None,
    on_bad_image: OnBadImage,
    grouping: dict[str, Any],
) -> TrainingSet:
    """Read the training set: places of one set or several, or queries to mine tuples for."""
    named = data if isinstance(data, Mapping) else {}
    check_names("--data", named, config)
    unused, what = {"data_images": images}, "trains on places"
    if config.mines:
        unused, what = grouping, "mines tuples of queries"
    elif named:
        unused, what = unused | grouping, "mixes several sets"
    given = [f"--{name.replace('_', '-')}" for name, value in unused.items() if value is not None]
    expected = f"found for a recipe that {what}, expected no such flag"
    require(not given, f"{', '.join(given)}: {expected}")

    if isinstance(data, Places):
        return data

    def places_at(root: Any, run: TrainConfig) -> Places:
        return read_places(
            root,
            cities=run.cities,
            min_images=run.min_images_of_place,
            on_bad_image=on_bad_image,
            **grouping,
        )

    if config.mines:
        root: Any = data
        return read_query_set(
            root,
            positive_radius=config.mining.positive_radius,
            negative_radius=config.mining.negative_radius,
            images=images,
            on_bad_image=on_bad_image,
        )
    if named:
        sets = zip(config.mixture, config.alone, strict=True)
        return {each.name: places_at(named[each.name], run) for each, run in sets}
    return places_at(data, config)


def read_start(
    config: TrainConfig, *, weights: Path | None = None, backbone: Path | None = None, quiet: bool
) -> Crisalad | None:
    """Read the parameters that a run starts from.

    Warn about weights that were trained on images of another size or resized in another way.

    Args:
        config: the run's configuration; the function `recipe` makes one that fits given weights.
        weights: a complete model of this package, or the name of a published model.
        backbone: a checkpoint (public or of this package) or the name of a published model, of
            which only the backbone is used.
        quiet: whether to hide the progress bar of a download.

    Returns:
        All parameters; or None, for random ones, if neither `weights` nor `backbone` is given.

    Raises:
        InputError: `weights` and `backbone` are both given, or a file is unreadable or unsuitable.
    """
    both = weights is not None and backbone is not None
    require(not both, "--backbone: found together with --weights, expected only one of the two")
    if weights is not None:
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
    initial: Crisalad | None, config: TrainConfig, places: TrainingSet, **how: Any
) -> Crisalad | None:
    """Fit an aggregator's centroids to the training images, if it starts from centroids.

    The same arguments give the same centroids, so that runs can resume. All processes call this
    together, and each gets the centroids of the primary process.

    Args:
        initial: the parameters; None for random ones from the run's seed.
        config: the run's configuration.
        places: the training images.
        **how: `on_bad_image` and `quiet` of `with_vocabulary`.

    Returns:
        The parameters, unchanged if the aggregator has no centroids.

    Raises:
        InputError: an image cannot be read, or there are too few images for the centroids.
    """
    if not config.model.aggregator.starts_from_centroids:
        return initial
    if initial is None:
        initial = init_crisalad(jax.random.key(config.seed), config.model)
    paths = [
        each.path(image)
        for each in sets_of(places)
        for image in range(each.database if isinstance(each, QuerySet) else len(each.files))
    ]
    model = Model(initial, config.model)
    images, seed = config.model.aggregator.centroid_images, config.seed
    fitted = distributed.raise_together(
        lambda: with_vocabulary(model, paths, images=images, seed=seed, **how)
    )
    return distributed.broadcast(fitted)
