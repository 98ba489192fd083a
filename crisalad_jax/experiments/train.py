"""A training run: read the data, train, and draw the curves."""

import os
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from crisalad_jax.config.checks import PATH, takes
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.file_cache import CACHE_GB
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.data.places import Places
from crisalad_jax.data.query_set import QuerySet
from crisalad_jax.data.remote import address_of
from crisalad_jax.experiments.report import save_chart, training_curves
from crisalad_jax.training.batches import TrainingSet
from crisalad_jax.training.callbacks import Callback
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.distributed import is_primary
from crisalad_jax.training.log import read_metrics
from crisalad_jax.training.loop import FitResult, fit
from crisalad_jax.training.run_files import write_data
from crisalad_jax.training.start import read_inputs
from crisalad_jax.utils.files import real_path

Path = str | os.PathLike[str]


@takes(config=TrainConfig, data=(*PATH, Mapping), out=PATH)
def train(
    config: TrainConfig,
    data: Path | Mapping[str, Path],
    out: Path,
    *,
    place_radius: float | None = None,
    place_frames: int | None = None,
    positions: Path | None = None,
    fps: float | None = None,
    topic: str | None = None,
    images: Path | None = None,
    validation: Path | None = None,
    validation_images: Path | None = None,
    weights: Path | None = None,
    backbone: Path | None = None,
    on_bad_image: OnBadImage = "stop",
    num_threads: int | None = None,
    shard_state: bool = False,
    cache_gb: float = CACHE_GB,
    callbacks: Sequence[Callback | str] = (),
    quiet: bool = False,
    say: Callable[[str], None] = lambda line: None,
) -> FitResult:
    """Train on a folder of places, or resume the run in `out`, and draw its curves.

    Args:
        config: the training configuration.
        data: places, in a layout that `read_places` reads, local or remote; or the sets of
            `config.mixture` by name, in such layouts; or, for a recipe that mines tuples, a set
            that `open_benchmark` reads, such as pitts30k_train.mat.
        place_radius: radius of a place in metres; see `read_places` for this and the next four
            arguments.
        place_frames: number of consecutive images of a place.
        positions: table or track of positions.
        fps: frames per second taken from videos and robot logs.
        topic: the topic of images in a robot log.
        images: folder of the images that a file such as pitts30k_train.mat names.
        out: folder of the run; see `fit`.
        validation: evaluation set that selects the best weights and, with `config.patience`, stops
            early; in any layout that `open_benchmark` reads.
        validation_images: folder of the images, if `validation` is a .mat file or .npy lists.
        weights: a complete model to start from, or a published model's name. It must fit
            `config.model`; `recipe(model=load(weights).config)` makes a `config` that does.
        backbone: a checkpoint to start the backbone from, or a published model's name.
        on_bad_image: "stop" at an unreadable image, or "skip" it: mask it out, and count it.
        num_threads: number of threads that read the training images; None for one per usable core.
        shard_state: whether to shard trainable parameters and optimiser moments over the devices.
        cache_gb: maximum gigabytes of remote images cached on this host's disk.
        callbacks: see `fit`.
        quiet: whether to hide progress bars.
        say: called with each line of progress, for instance `print`.

    Returns:
        The final parameters, and how the run ended.

    Raises:
        InputError: the data or weights cannot be read or do not fit; `out` holds something other
            than a run with this configuration; or `open_benchmark` or `fit` raises it.
        Interrupted: a signal stopped the run; the same call resumes it.

    Example:
        >>> import dataclasses
        >>> from crisalad_jax import recipe
        >>> config = dataclasses.replace(recipe("tiny"), epochs=1, places_per_batch=4)
        >>> train(config, places, folder / "run", quiet=True).steps
        2
    """
    how: Any = {"on_bad_image": on_bad_image, "quiet": quiet}
    sets: Any = {"images": images, "validation": validation, "validation_images": validation_images}
    start: Any = {"weights": weights, "backbone": backbone}
    grouping: Any = {"place_radius": place_radius, "place_frames": place_frames}
    grouping |= {"positions": positions, "fps": fps, "topic": topic}
    places, benchmark, initial = read_inputs(config, data, out, **sets, **start, **how, **grouping)
    if (weights, backbone) == (None, None) and config.trainable != "all":
        say(
            "Note: no --weights or --backbone, so the frozen part of the model "
            f"({config.trainable} trains) is random. --trainable all trains everything."
        )
    on = "" if benchmark is None else f"; validation on {benchmark.name}"
    roots = data if isinstance(data, Mapping) else {"": data}
    for name, each in (places if isinstance(places, Mapping) else {"": places}).items():
        groups = f"{len(each.names)} places" if isinstance(each, Places) else ""
        if isinstance(each, QuerySet):
            groups = f"{len(each.queries)} queries with positives"
        root = f"{name}{': ' if name else ''}{address_of(roots[name])}"
        say(f"{root}: {groups}, {len(each.files)} images{on}")
        on = ""
    result = fit(
        config,
        places,
        out,
        validation=benchmark,
        initial=initial,
        num_threads=num_threads,
        shard_state=shard_state,
        cache_gb=cache_gb,
        callbacks=callbacks,
        **how,
    )
    if is_primary() and result.steps:
        names = [real_path(pathlib.Path(root)).name for root in roots.values()]
        finish_run(out, ", ".join(names), places, benchmark)
    return result


def finish_run(out: Path, name: str, places: TrainingSet, benchmark: Benchmark | None) -> None:
    """Draw a run's curves.png, and record what it trained on for a model card (`write_data`)."""
    out = pathlib.Path(out)
    save_chart(training_curves(read_metrics(out / "metrics.jsonl")), out / "curves.png")
    write_data(out, name, places, benchmark)
