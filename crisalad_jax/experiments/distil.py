"""Train a small model to reproduce the descriptors of a larger one, on any images."""

import dataclasses
import os
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from crisalad_jax.config.checks import PATH, require, takes
from crisalad_jax.data.benchmarks import open_benchmark
from crisalad_jax.data.file_cache import CACHE_GB
from crisalad_jax.data.frames import file_of
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.data.places import Places, places_of_images, read_places
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.remote import for_each, state_of
from crisalad_jax.data.sources import open_sources
from crisalad_jax.experiments.report import save_chart, training_curves
from crisalad_jax.nn.model import Crisalad, Model, parameter_shapes
from crisalad_jax.retrieval.describer import describer_of
from crisalad_jax.retrieval.descriptor_files import read_descriptors
from crisalad_jax.retrieval.extract import extract
from crisalad_jax.retrieval.segments import digest_of
from crisalad_jax.training.callbacks import Callback
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.log import read_metrics
from crisalad_jax.training.loop import FitResult, fit
from crisalad_jax.training.losses.distil import DistilConfig
from crisalad_jax.training.run_files import check_run, write_data
from crisalad_jax.utils.files import user_cache, wrap_os_errors
from crisalad_jax.utils.shapes import Float32

Path = str | os.PathLike[str]


@takes(config=TrainConfig, teacher=Model, out=PATH)
def distil(
    config: TrainConfig,
    teacher: Model,
    images: Path | Sequence[Path] | None,
    out: Path,
    *,
    data: Path | None = None,
    initial: Crisalad | None = None,
    validation: Path | None = None,
    validation_images: Path | None = None,
    reading: Reading = Reading(),
    cache_gb: float = CACHE_GB,
    callbacks: Sequence[Callback | str] = (),
    say: Callable[[str], None] = lambda line: None,
) -> FitResult:
    """Train a student on a teacher's descriptors of the same images, or resume the run in `out`.

    The teacher describes each image once, at its own image size and without augmentation. Its
    descriptors are cached (folder `teachers` of this package's cache), so other students reuse
    them. The student trains on augmented images.

    Args:
        config: how the student trains, usually `recipe(preset, "distil")`. The teacher's descriptor
            length is filled in.
        teacher: the model to learn from.
        images: one source of images or several, as `extract` takes them; None with `data`.
        data: labelled places instead, in a layout that `read_places` reads; the loss's term
            `labels` uses them.
        out: folder of the run; see `fit`.
        initial: parameters of the student to start from; None draws them by the run's seed.
        validation: evaluation set for early stopping.
        validation_images: folder of the images that a file at `validation` names.
        reading: how images are read.
        cache_gb: most gigabytes of images at addresses that are cached on this host's disk.
        callbacks: see `fit`.
        say: called with each line to print.

    Returns:
        How the run ended.

    Raises:
        InputError: both or neither of `images` and `data`; a loss that learns from no teacher; what
            `open_sources`, `read_places`, `extract`, `open_benchmark` and `fit` raise.
        Interrupted: the same call resumes.

    Example:
        >>> import dataclasses, jax
        >>> from crisalad_jax import init_crisalad, load, recipe
        >>> config = dataclasses.replace(recipe("tiny", "distil"), epochs=1, places_per_batch=4)
        >>> quiet = Reading(quiet=True)
        >>> distil(config, load("hog"), pictures, folder / "student", reading=quiet).steps
        1
    """
    kind = config.loss.kind
    require(
        isinstance(kind, DistilConfig),
        f"loss: found {kind.part_name}, expected distil (recipe distil)",
    )
    require((images is None) != (data is None), "--images, --data: expected one of the two")
    skip: OnBadImage = reading.on_bad_image
    if data is not None:
        places = read_places(data, min_images=config.min_images, on_bad_image=skip)
    else:
        assert images is not None  # checked above
        places = places_of_images(open_sources(images, on_bad_image=skip))
    taught = dataclasses.replace(kind, teacher_dim=teacher.config.descriptor_dim)
    config = dataclasses.replace(config, loss=dataclasses.replace(config.loss, kind=taught))
    out = pathlib.Path(out)
    check_run(out, config)
    how: Any = {"images": validation_images, "on_bad_image": skip}
    benchmark = None if validation is None else open_benchmark(validation, **how)
    shapes = (parameter_shapes(each) for each in (config.model, teacher.config))
    numbers = [sum(leaf.size for leaf in jax.tree.leaves(each)) for each in shapes]
    say(
        f"{len(places.files)} images; the student has {numbers[0]:,} parameters, "
        f"the teacher {numbers[1]:,}"
    )
    if numbers[0] > numbers[1] > 0:
        say("Note: the student is larger than its teacher.")
    result = fit(
        config,
        places,
        out,
        validation=benchmark,
        initial=initial,
        on_bad_image=skip,
        num_threads=reading.threads,
        cache_gb=cache_gb,
        callbacks=callbacks,
        quiet=reading.quiet,
        targets=teachers_descriptors(teacher, places, reading=reading),
    )
    if result.steps:
        save_chart(training_curves(read_metrics(out / "metrics.jsonl")), out / "curves.png")
        write_data(out, places.cities[0], places, benchmark)
    return result


def teachers_descriptors(
    teacher: Model, places: Places, *, reading: Reading = Reading()
) -> Float32[np.ndarray, "image descriptor"]:
    """Compute a teacher's descriptors of all training images, or load them from the cache.

    Args:
        teacher: the model.
        places: the training set.
        reading: how images are read.

    Returns:
        One descriptor for each image, in order, as a memory map or array; zeros for an unreadable
        image.

    Raises:
        InputError: what `extract` raises.
    """
    paths = [places.path(image) for image in range(len(places.files))]
    states = for_each(lambda path: state_of(file_of(path)), paths)
    files = [f"{path} {state}" for path, state in zip(paths, states, strict=True)]
    digest = digest_of(files, {"teacher": describer_of(teacher).digest})
    file = user_cache() / "teachers" / f"{digest[:16]}.npy"
    if file.exists():
        listed, found = read_descriptors(file)
    else:
        with wrap_os_errors(file):
            file.parent.mkdir(parents=True, exist_ok=True)
        listed, found, _ = extract(teacher, paths, file, reading=reading)
    if len(listed) == len(paths):
        return found
    rows = dict(zip(listed, found, strict=True))
    nothing = np.zeros(found.shape[1], np.float32)
    return np.stack([rows.get(path.as_posix(), nothing) for path in paths])
