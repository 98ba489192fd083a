"""What a run reads before its first step: its images, and the parameters that it starts from."""

import os
import pathlib
import re
from typing import Any

import jax
import numpy as np

from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.checkpoints.public import with_backbone_of
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.config.checks import require
from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.data.places import Places, read_places
from crisalad_jax.data.query_set import QuerySet, read_query_set
from crisalad_jax.nn.layers import STATISTICS
from crisalad_jax.nn.model import Crisalad, Model, init_crisalad, parameter_shapes
from crisalad_jax.training import distributed
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.run_files import check_run
from crisalad_jax.training.trainable import split_params
from crisalad_jax.training.vocabulary import with_vocabulary
from crisalad_jax.utils.errors import few
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.pytree import named_leaves

Path = str | os.PathLike[str]


RunInputs = tuple[Places | QuerySet, Benchmark | None, Crisalad | None]
"""The training set, the validation set, and the parameters to start from, as `fit` takes them."""


def read_inputs(
    config: TrainConfig,
    data: Path,
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
    """Read the training set, the validation set and the start of a run; see `experiments.train`.

    All processes call it together. Without `weights`, an aggregator's centroids are fitted to the
    training images.

    Args:
        config: the run's.
        data: the training set.
        out: folder of the run, which is checked first.
        images: folder of the images that a file of queries names.
        validation: evaluation set.
        validation_images: folder of the images that a file at `validation` names.
        weights: see `read_start`.
        backbone: see `read_start`.
        on_bad_image: "stop", or "skip" to leave unreadable images out.
        quiet: no progress bars.
        **grouping: how images become places; see `read_places`.

    Returns:
        (places, validation, initial).

    Raises:
        InputError: in every process, where one cannot read its files or they do not fit.
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

    distributed.run_on_primary(lambda: check_run(pathlib.Path(out), config))
    places, benchmark, initial = distributed.raise_together(read)
    if weights is None and config.model.aggregator.trainable:
        how: Any = {"on_bad_image": on_bad_image, "quiet": quiet}
        initial = with_vocabulary_of(initial, config, places, **how)
    return places, benchmark, initial


def _read_set(
    config: TrainConfig,
    data: Path,
    images: Path | None,
    on_bad_image: OnBadImage,
    grouping: dict[str, Any],
) -> Places | QuerySet:
    """Read the training set: places, or queries of which tuples are mined."""
    unused = grouping if config.mines else {"data_images": images}
    given = [f"--{name.replace('_', '-')}" for name, value in unused.items() if value is not None]
    what = "mines tuples of queries" if config.mines else "trains on places"
    expected = f"found for a recipe that {what}, expected no such flag"
    require(not given, f"{', '.join(given)}: {expected}")
    if config.mines:
        return read_query_set(
            data,
            positive_radius=config.mining.positive_radius,
            negative_radius=config.mining.negative_radius,
            images=images,
            on_bad_image=on_bad_image,
        )
    return read_places(
        data,
        cities=config.cities,
        min_images=config.min_images_of_place,
        on_bad_image=on_bad_image,
        **grouping,
    )


def read_start(
    config: TrainConfig,
    *,
    weights: Path | None = None,
    backbone: Path | None = None,
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
        InputError: both are given, or a file cannot be read or does not fit the model; or adapters
            that start untrained would stay so.
    """
    both = weights is not None and backbone is not None
    require(not both, "--backbone: found beside --weights, expected only one of the two")
    if weights is not None:
        file = find_weights(weights, quiet=quiet)
        params, theirs = load_weights(file, expected=config.model)
        if theirs.images_in_words != config.model.images_in_words:
            warn(
                f"{weights}: found weights for images at {theirs.images_in_words}; this run trains "
                f"and is saved with {config.model.images_in_words}"
            )
        return params
    frozen = _frozen_adapters(config)
    if backbone is None:
        params = None
    else:
        backbone = find_weights(backbone, quiet=quiet)
        fresh = init_crisalad(jax.random.key(config.seed), config.model)
        params = with_backbone_of(fresh, config.model, backbone)
        before, after = named_leaves(fresh), named_leaves(params)
        if any(not np.array_equal(before[name], after[name]) for name in frozen):
            frozen = []  # the file has trained ones
    require(
        not frozen,
        f"--trainable: found {config.trainable}, which leaves adapters out that start untrained "
        f"({few(frozen)}), expected adapters+head or all, or --model.backbone.adapter none",
    )
    return params


def _frozen_adapters(config: TrainConfig) -> list[str]:
    """Return the names of adapters' parameters of which some do not train."""
    _, frozen = jax.eval_shape(
        lambda params: split_params(params, config.model, config.trainable),
        parameter_shapes(config.model),
    )
    # A stack of blocks may be cut in two.
    names = (re.sub(r"\.blocks\.\d+\.", ".blocks.", name) for name in named_leaves(frozen))
    adapters = (name for name in names if name.startswith("backbone.blocks.adapter."))
    learnt = (name for name in adapters if name.rpartition(".")[2] not in STATISTICS)
    return list(dict.fromkeys(learnt))


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
    model, paths = Model(initial, config.model), [places.path(image) for image in range(count)]
    images, seed = config.model.aggregator.centroid_images, config.seed
    how: Any = {"on_bad_image": on_bad_image, "quiet": quiet}
    fitted = distributed.raise_together(
        lambda: with_vocabulary(model, paths, images=images, seed=seed, **how)
    )
    return distributed.broadcast(fitted)
