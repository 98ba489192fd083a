"""Split the images of a map: places to train on, and held-out frames that query the rest."""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from crisalad_jax.config.checks import require
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.benchmarks.benchmark import within
from crisalad_jax.data.frames import by_sequence
from crisalad_jax.data.images import OnBadImage, read_pixels
from crisalad_jax.data.metres import comparable
from crisalad_jax.data.places import Places, group_images
from crisalad_jax.data.positions import AXES
from crisalad_jax.data.prepare import Preparation
from crisalad_jax.data.sources import ImageSource, join_sources
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, wrap_os_errors

SHARE, MOST = 0.2, 100
"""Share of a map's images that is held out, and the maximum number of held-out images."""
CHOOSING, JUDGING = range(2), range(2, 4)
"""Numbers of the augmented copies of a held-out image that decide when training stops, and of the
others that measure the gain: the best of several validations would be biased upwards."""


class Split(NamedTuple):
    """The images of a map and its environment after the split; numbers are indices in `source`."""

    source: ImageSource
    """All images, those of the map first."""
    training: Places
    """Places made of the images that are not held out."""
    answers: dict[int, list[int]]
    """Correct answers to each held-out image in the rest of the map; the image itself if none."""
    database: list[int]
    """Images of the map that the held-out images query."""
    rule: str
    """Description of what makes an answer correct."""


def split_images(
    sources: Sequence[ImageSource],
    seed: int,
    *,
    place_radius: float | None = None,
    place_frames: int | None = None,
) -> Split:
    """Hold out some of a map's images, and group the rest into places.

    Args:
        sources: the images of the map, then any others of its environment.
        seed: random seed for drawing the held-out images.
        place_radius: metres within which images show the same place.
        place_frames: number of consecutive images of a place; with neither, each image is a place.

    Raises:
        InputError: the map has one image, or no place is left.
    """
    source, inside = join_sources(sources), len(sources[0].names)
    require(inside > 1, f"{source.root}: found a map of one image, expected several")
    if place_radius is not None:
        near, rule = _near(source, place_radius), f"at most {place_radius:g} m away"
    elif place_frames is not None:
        near, rule = _consecutive(source, place_frames), f"within {place_frames - 1} frames"
    else:
        near, rule = [[] for _ in source.names], "the image itself"
    count = min(MOST, max(1, round(SHARE * inside)))
    held = np.random.default_rng(seed).permutation(inside)[:count].tolist()
    away = set(held)
    answers = {
        image: [each for each in near[image] if each < inside and each not in away] or [image]
        for image in sorted(held)
    }
    database = [each for each in range(inside) if answers.get(each, [each]) == [each]]
    rest = [each for each in range(len(source.names)) if each not in away]
    training = group_images(_chosen(source, rest), place_radius, place_frames)
    return Split(source, training, answers, database, rule)


def _chosen(source: ImageSource, numbers: Sequence[int]) -> ImageSource:
    paths, names = ([of[number] for number in numbers] for of in (source.paths, source.names))
    return source._replace(paths=paths, names=names)


def _near(source: ImageSource, radius: float) -> list[list[int]]:
    """List the others within a radius of each image; none for an image without a position."""
    near: list[list[int]] = [[] for _ in source.names]
    if source.positions is None:
        return near
    of = source.positions.of
    placed = [number for number, name in enumerate(source.names) if name in of]
    points = np.array([of[source.names[number]] for number in placed], np.float64)
    if source.positions.axes == AXES[1]:
        points = comparable(*points.T)
    for image, others in zip(placed, within(points, points, radius), strict=True):
        near[image] = [placed[other] for other in others if placed[other] != image]
    return near


def _consecutive(source: ImageSource, frames: int) -> list[list[int]]:
    """List the others of each image's sequence that are less than `frames` frames away."""
    near: list[list[int]] = [[] for _ in source.names]
    for numbers in by_sequence(source.paths):
        for place, image in enumerate(numbers):
            window = numbers[max(0, place - frames + 1) : place + frames]
            near[image] = [each for each in window if each != image]
    return near


def with_repeats(places: Places, images: int) -> Places:
    """Repeat the images of each smaller place, in turn, until it has `images` images.

    A batch then has several augmentations of the same image.
    """
    counts = np.maximum(places.image_counts, images)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    files = []
    for start, own, count in zip(places.place_start, places.image_counts, counts, strict=False):
        files += [places.files[start + turn % own] for turn in range(count)]
    return dataclasses.replace(places, files=tuple(files), place_start=starts, views=None)


def count_apart(places: Places) -> int:
    """Count places that can share a batch: in order, those not near an already counted one."""
    taken = set[int]()
    for place in range(len(places.names)):
        if places.near is None or taken.isdisjoint(places.near[place].tolist()):
            taken.add(place)
    return len(taken)


def held_out_benchmark(
    config: TrainConfig,
    split: Split,
    folder: pathlib.Path,
    copies: Sequence[int],
    on_bad_image: OnBadImage = "stop",
) -> Benchmark:
    """Write augmented copies of the held-out images; return a benchmark in which they are queries.

    Args:
        config: configuration of the run; the copies are augmented as training images are.
        split: the images. Its `database` is the database of the benchmark.
        folder: where the copies are written, as PNG files.
        copies: numbers of the copies to make of each image, which seed the augmentation.
        on_bad_image: "stop" at an unreadable image, or "skip" it.

    Raises:
        InputError: an image cannot be read, or none can, or the folder cannot be written to.
    """
    model, seed = config.model, config.seed
    how = Preparation(model.input_size, model.preprocessing.for_training())
    queries: list[pathlib.Path] = []
    positives: list[np.ndarray] = []
    number = {image: row for row, image in enumerate(split.database)}
    with wrap_os_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    for image, answers in split.answers.items():
        path = split.source.paths[image]
        try:
            pixels = how.prepare(read_pixels(path), str(path))
        except InputError:
            if on_bad_image == "skip":
                continue
            raise
        files = [folder / f"{image:06d}-{copy}.png" for copy in copies]
        queries += files
        positives += [np.array([number[each] for each in answers])] * len(files)
        for copy, file in zip(copies, files, strict=True):
            generator = np.random.default_rng((seed, image, copy))
            changed = config.augmentation.apply(pixels, generator, of_place=generator)
            with atomic_path(file) as temporary:
                cv2.imwrite(str(temporary), cv2.cvtColor(changed, cv2.COLOR_RGB2BGR))
    require(bool(queries), f"{split.source.root}: found no readable image among those held out")
    return Benchmark(
        name="held-out frames",
        root=folder,
        database=tuple(split.source.paths[image] for image in split.database),
        queries=tuple(queries),
        positives=tuple(positives),
        rule=split.rule,
    )
