"""Train a small model to reproduce the descriptors of a larger one, on any images."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from crisalad_jax.config.checks import PATH, require, takes
from crisalad_jax.config.io import to_plain
from crisalad_jax.data.file_cache import CACHE_GB
from crisalad_jax.data.frames import file_of
from crisalad_jax.data.places import Places, group_images
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.remote import for_each, state_of
from crisalad_jax.data.sources import join_sources, open_sources
from crisalad_jax.experiments.train import Path, finish_run
from crisalad_jax.nn.config import check_unit_length
from crisalad_jax.nn.model import Model, parameter_shapes
from crisalad_jax.retrieval.describer import describer_of
from crisalad_jax.retrieval.descriptor_files import read_descriptors
from crisalad_jax.retrieval.extract import extract
from crisalad_jax.retrieval.segments import digest_of
from crisalad_jax.training.callbacks import Callback
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.loop import FitResult, fit
from crisalad_jax.training.losses.distil import DistilConfig
from crisalad_jax.training.start import read_inputs
from crisalad_jax.utils.files import real_path, user_cache, wrap_os_errors
from crisalad_jax.utils.shapes import Float32


@takes(config=TrainConfig, teacher=Model, out=PATH)
def distil(
    config: TrainConfig,
    teacher: Model,
    images: Path | Sequence[Path] | None,
    out: Path,
    *,
    data: Path | None = None,
    weights: Path | None = None,
    validation: Path | None = None,
    validation_images: Path | None = None,
    fps: float | None = None,
    topic: str | None = None,
    reading: Reading = Reading(),
    cache_gb: float = CACHE_GB,
    callbacks: Sequence[Callback | str] = (),
    say: Callable[[str], None] = lambda line: None,
) -> FitResult:
    """Train a student on a teacher's descriptors of the same images, or resume the run in `out`.

    The teacher describes the images once, at its own image size and without augmentation. Its
    descriptors are cached (folder `teachers` of this package's cache), so later runs on the
    same images reuse them. The student trains on augmented images.

    Args:
        config: how the student trains, usually `recipe(preset, "distil")`. The length of the
            teacher's descriptors is filled in.
        teacher: the model to learn from.
        images: one source of images or several, as `extract` takes them; None with `data`.
        data: labelled places instead of `images`, in a layout that `read_places` reads; only
            the term `labels` of the loss uses the labels.
        out: folder of the run; see `fit`.
        weights: weights to start from, or a published model's name; None for random weights.
        validation: evaluation set that selects the best weights and, with `config.patience`, stops
            early; in any layout that `open_benchmark` reads.
        validation_images: folder of the images, if `validation` is a .mat file or .npy lists.
        fps: frames per second taken from videos and robot logs; None for 1.
        topic: the topic of images in a robot log; None if it has only one.
        reading: how images are read.
        cache_gb: maximum gigabytes of remote images cached on this host's disk.
        callbacks: see `fit`.
        say: called with each line of progress, for instance `print`.

    Returns:
        The student's final parameters, and how the run ended.

    Raises:
        InputError: both or neither of `images` and `data` are given; the loss is not `distil`, or
            uses `labels` without `data` or with one image per place; the student has a cross-image
            encoder; images are too few or unreadable; or `open_benchmark` or `fit` raises it.
        Interrupted: a signal stopped the run; the same call resumes it.

    Example:
        >>> import dataclasses
        >>> from crisalad_jax import load, recipe
        >>> config = dataclasses.replace(recipe("tiny", "distil"), epochs=1, places_per_batch=4)
        >>> quiet = Reading(quiet=True)
        >>> distil(config, load("hog"), pictures, folder / "student", reading=quiet).steps
        1
    """
    kind, skip = config.loss.kind, reading.on_bad_image
    require(
        isinstance(kind, DistilConfig),
        f"loss: found {kind.part_name}, expected distil (recipe distil)",
    )
    assert isinstance(kind, DistilConfig)  # for pyright
    found = "none" if images is None else "both"
    require((images is None) != (data is None), f"--images, --data: found {found}, expected one")
    pairs = kind.labels == 0 or (config.images_per_place > 1 and data is not None)
    require(pairs, f"labels: found weight {kind.labels} for single images, expected 0, or --data")
    encoder = config.model.cross_image
    require(
        not encoder.attends,
        f"student: found cross-image encoder {encoder.part_name}, expected none: a teacher's "
        "descriptors are of single images",
    )
    for name, model in (("--teacher", teacher.config), ("--student", config.model)):
        check_unit_length(model, name)
    taught = dataclasses.replace(kind, teacher_dim=teacher.config.descriptor_dim)
    config = dataclasses.replace(config, loss=dataclasses.replace(config.loss, kind=taught))
    source: Any = data
    frames: Any = {"fps": fps, "topic": topic}
    if images is not None:
        listed = open_sources(images, **frames, on_bad_image=skip)
        source = group_images(join_sources(listed))
    how: Any = {"on_bad_image": skip, "quiet": reading.quiet}
    sets: Any = {"validation": validation, "validation_images": validation_images}
    sets |= frames if images is None else {}  # for `read_places` to reject
    places, benchmark, initial = read_inputs(config, source, out, weights=weights, **sets, **how)
    assert isinstance(places, Places)
    count, batch = len(places.names), config.places_per_batch
    kinds = "images" if images is not None else "places"
    require(
        count >= batch,
        f"--images, --data: found {count} {kinds}, expected at least {batch} (--places-per-batch)",
    )
    shapes = (parameter_shapes(each) for each in (config.model, teacher.config))
    numbers = [sum(leaf.size for leaf in jax.tree.leaves(each)) for each in shapes]
    say(
        f"{len(places.files)} images; the student has {numbers[0]:,} parameters, "
        f"the teacher {numbers[1]:,}"
    )
    if numbers[0] > numbers[1]:
        say("Note: the student is larger than its teacher.")
    result = fit(
        config,
        places,
        out,
        validation=benchmark,
        initial=initial,
        num_threads=reading.threads,
        cache_gb=cache_gb,
        callbacks=callbacks,
        targets=teachers_descriptors(teacher, places, reading=reading),
        **how,
    )
    if result.steps:
        finish_run(out, real_path(places.root).name, places, benchmark)
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
        A unit descriptor of each image, in order, as a memory map or array; a row of zeros for an
        unreadable image.

    Raises:
        InputError: an image cannot be read, or the cache cannot be written (see `extract`).
    """
    paths = [places.path(image) for image in range(len(places.files))]
    states = for_each(lambda path: state_of(file_of(path)), paths)
    files = [f"{path} {state}" for path, state in zip(paths, states, strict=True)]
    config = to_plain(teacher.config)  # the model's hash leaves out image size and types
    digest = digest_of(files, {"teacher": describer_of(teacher).digest, "config": config})
    file = user_cache() / "teachers" / f"{digest[:16]}.npy"
    listed, found = read_descriptors(file) if file.exists() else ([], None)
    if found is None or len(listed) < len(paths):  # an image may be readable now
        with wrap_os_errors(file):
            file.parent.mkdir(parents=True, exist_ok=True)
        listed, found, _ = extract(teacher, paths, file, reading=reading)
    if len(listed) == len(paths):
        return found
    rows = dict(zip(listed, found, strict=True))
    nothing = np.zeros(found.shape[1], np.float32)
    return np.stack([rows.get(path.as_posix(), nothing) for path in paths])
