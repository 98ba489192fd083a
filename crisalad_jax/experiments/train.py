"""A training run from folders to curves."""

import os
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

from crisalad_jax.config.checks import PATH, takes
from crisalad_jax.data.benchmarks import open_benchmark
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.data.places import Places, read_places
from crisalad_jax.data.query_set import QuerySet, read_query_set
from crisalad_jax.experiments.report import save, training_curves
from crisalad_jax.training import distributed
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.log import read_metrics
from crisalad_jax.training.loop import FitResult, check_learns, fit
from crisalad_jax.training.run_files import check_run
from crisalad_jax.training.start import read_start, with_vocabulary_of
from crisalad_jax.utils.errors import InputError

Path = str | os.PathLike[str]


@takes(config=TrainConfig, data=PATH, out=PATH)
def train(
    config: TrainConfig,
    data: Path,
    out: Path,
    *,
    place_radius: float | None = None,
    place_frames: int | None = None,
    positions: Path | None = None,
    fps: float | None = None,
    images: Path | None = None,
    validation: Path | None = None,
    validation_images: Path | None = None,
    weights: Path | None = None,
    backbone: Path | None = None,
    on_bad_image: OnBadImage = "stop",
    num_threads: int | None = None,
    shard_state: bool = False,
    quiet: bool = False,
    say: Callable[[str], None] = lambda line: None,
) -> FitResult:
    """Train on a folder of places, or resume the run in `out`, and draw its curves.

    Args:
        config: how to train.
        data: places, in a layout that `read_places` reads; for a recipe that mines tuples, a set
            that `open_benchmark` reads, such as pitts30k_train.mat.
        place_radius: metres within which images of a source with positions are a place; see
            `read_places`, as for the three that follow.
        place_frames: number of consecutive images that are a place.
        positions: table of positions.
        fps: frames a second taken of videos.
        images: folder of the images that such a file names.
        out: folder of the run; see `fit`.
        validation: evaluation set for early stopping, in any layout that `open_benchmark` reads.
        validation_images: folder of the images that a .mat file or .npy lists at `validation` name.
        weights: a whole model to start from, or a published one's name. `config.model` is what is
            trained and saved; `recipe(model=load(weights).config)` has the file's.
        backbone: a checkpoint to start the backbone from, or a published model's name.
        on_bad_image: "stop", or "skip" to mask out unreadable images and count them.
        num_threads: number of threads that read the training images; None for one a usable core.
        shard_state: keep what trains and its moments in shards, one a device.
        quiet: no progress bars.
        say: called with each line to print.

    Returns:
        How the run ended.

    Raises:
        InputError: what `read_start`, `read_places`, `read_query_set`, `open_benchmark` and `fit`
            raise.
        Interrupted: what `fit` raises; the same call resumes.

    Example:
        >>> import dataclasses
        >>> from crisalad_jax import recipe
        >>> config = dataclasses.replace(recipe("tiny"), epochs=1, places_per_batch=4)
        >>> train(config, places, folder / "run", quiet=True).steps
        2
    """
    out = pathlib.Path(out)
    check_learns(config)
    if validation is None and validation_images is not None:
        raise InputError("--val-images: found no --val, expected it beside --val")

    grouping = {
        "place_radius": place_radius,
        "place_frames": place_frames,
        "positions": positions,
        "fps": fps,
    }

    def read() -> tuple:
        initial = read_start(
            config, weights=weights, backbone=backbone, quiet=quiet or not distributed.is_primary()
        )
        places = _read_set(config, data, images, grouping, on_bad_image)
        benchmark = None
        if validation is not None:
            benchmark = open_benchmark(
                validation, images=validation_images, on_bad_image=on_bad_image
            )
        return initial, places, benchmark

    initial, places, benchmark = distributed.raise_together(read)
    if (weights, backbone) == (None, None) and config.trainable != "all":
        say(
            "Note: no --weights or --backbone, so the frozen part of the model "
            f"({config.trainable} trains) is random. --trainable all trains everything."
        )
    if isinstance(places, QuerySet):
        groups = f"{len(places.queries)} queries with positives"
    else:
        groups = f"{len(places.names)} places"
    on = "" if benchmark is None else f"; validation on {benchmark.name}"
    say(f"{data}: {groups}, {len(places.files)} images{on}")
    if weights is None:
        distributed.run_on_primary(lambda: check_run(out, config))
        initial = with_vocabulary_of(
            initial, config, places, on_bad_image=on_bad_image, quiet=quiet
        )
    result = fit(
        config,
        places,
        out,
        validation=benchmark,
        initial=initial,
        on_bad_image=on_bad_image,
        num_threads=num_threads,
        shard_state=shard_state,
        quiet=quiet,
    )
    if distributed.is_primary():
        save(training_curves(read_metrics(out / "metrics.jsonl")), out / "curves.png")
    return result


def _read_set(
    config: TrainConfig,
    data: Path,
    images: Path | None,
    grouping: Mapping[str, Any],
    on_bad_image: OnBadImage,
) -> Places | QuerySet:
    """Read the training set: places, or queries of which tuples are mined."""
    unused = grouping if config.mines else {"data_images": images}
    given = [f"--{name.replace('_', '-')}" for name, value in unused.items() if value is not None]
    if given:
        what = "mines tuples of queries" if config.mines else "trains on places"
        raise InputError(
            f"{', '.join(given)}: found for a recipe that {what}, expected no such flag"
        )
    if not config.mines:
        return read_places(
            data,
            cities=config.cities,
            min_images=config.min_images_of_place,
            on_bad_image=on_bad_image,
            **grouping,
        )
    return read_query_set(
        data,
        positive_radius=config.mining.positive_radius,
        negative_radius=config.mining.negative_radius,
        images=images,
        on_bad_image=on_bad_image,
    )
