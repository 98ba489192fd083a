"""Samplers, which choose the places, and their images, for the batches of an epoch."""

import abc
import itertools
import pathlib
from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

import numpy as np

from crisalad_jax.config.checks import require
from crisalad_jax.config.part import Part
from crisalad_jax.config.registry import Registry, with_arguments
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.places import Places
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Float, Int

_TURNS = 20
"""Number of calls of a sampler without a batch before giving up."""

Describe = Callable[[Sequence[pathlib.Path]], Float[np.ndarray, "n descriptor"]]
"""Function from image files to their descriptors, NaN for images that cannot be read."""


@brief
class Draw(NamedTuple):
    """The input of a sampler: the size of a batch, the epoch, and random numbers."""

    places_per_batch: int
    images_per_place: int
    epoch: int
    """Index of the epoch, from 0."""
    generator: np.random.Generator
    """Random generator, the same for the same seed and epoch."""
    described: Int[np.ndarray, " n"]
    """Image indices that `Sampler.images_to_describe` returned; empty if `describes` is False."""
    descriptors: Float[np.ndarray, "n descriptor"]
    """The current model's descriptors of these images; NaN for images that cannot be read."""


class Sampler(Part, abc.ABC):
    """A way to draw batches from places: a frozen dataclass with its settings as fields.

    A plain function of (places, draw) can be registered as a sampler without settings.

    Example:
        >>> import numpy as np
        >>> from crisalad_jax import TrainConfig, read_places, register_sampler
        >>> @register_sampler("south-to-north")
        ... def south_to_north(places, draw):
        ...     latitude = places.views[places.place_start[:-1], 0]
        ...     return np.argsort(latitude)
        >>> TrainConfig(sampler="south-to-north").sampler.part_name
        'south-to-north'
    """

    describes: ClassVar[bool] = False
    """Whether the sampler uses descriptors, which the model computes when an epoch begins."""
    regroups: ClassVar[bool] = False
    """Whether the sampler makes groups of images that serve as places: a group may mix images of
    several of the set's places, and use places with few images."""

    def check(self, places: Places) -> None:
        """Raise InputError if the sampler cannot draw from these places; by default never."""

    def images_to_describe(
        self, places: Places, generator: np.random.Generator
    ) -> Int[np.ndarray, " n"]:
        """Return the indices of the images to describe; by default a random one of each place."""
        return generator.integers(places.place_start[:-1], places.place_start[1:])

    @abc.abstractmethod
    def apply(
        self, places: Places, draw: Draw
    ) -> Int[np.ndarray, " order"] | Int[np.ndarray, "steps places images"]:
        """Draw enough batches to use every place about once.

        Args:
            places: the training set.
            draw: the size of a batch, and random numbers.

        Returns:
            Indices of places in an order in which consecutive places make a batch; or indices of
            images, by batch and place. An order may omit a place, or repeat it with other images. A
            place that is `Places.near` another of its batch moves to a later batch.
        """


SAMPLERS = Registry("sampler", Sampler, of_function=with_arguments("places", "draw"))


def epoch_batches(
    places: Places,
    *,
    sampler: Sampler | str,
    places_per_batch: int,
    images_per_place: int,
    seed: int,
    epoch: int,
    steps: int | None = None,
    describe: Describe | None = None,
) -> Int[np.ndarray, "steps places images"]:
    """Draw the images of every batch of an epoch, as a function of (seed, epoch).

    From each place, `images_per_place` images are sampled without replacement. An incomplete last
    batch is dropped. With `steps` the epoch has exactly this number of batches: it is cut short, or
    continued with new draws. Without it, the number may differ from epoch to epoch if places are
    `Places.near` each other.

    Args:
        places: the training set.
        sampler: a registered sampler, or its name.
        places_per_batch: number of places in a batch.
        images_per_place: number of images of each place.
        seed: seed of the draws, together with the epoch.
        epoch: index of the epoch, from 0.
        steps: number of batches; None takes what the sampler draws in one call.
        describe: function from image files to descriptors, for samplers with `describes`.

    Returns:
        Indices of images.

    Raises:
        InputError: a place has too few images; the sampler finds no batch, or returns anything but
            what `Sampler.apply` specifies; there is no such sampler; the seed or epoch is negative;
            `steps` is below 1; or `describe` is missing.
    """
    drawn_by = SAMPLERS.resolve(sampler, "sampler")
    least = 1 if steps is None else steps
    require(
        min(places_per_batch, images_per_place, least, seed + 1, epoch + 1) > 0,
        f"epoch_batches: found {places_per_batch=}, {images_per_place=}, {seed=}, {epoch=} and "
        f"{steps=}, expected numbers from 1, and from 0 for the seed and the epoch",
    )
    counts = places.image_counts
    place = int(counts.argmin())
    require(
        drawn_by.regroups or counts[place] >= images_per_place,
        f"{places.root}: place {places.names[place]} has {counts[place]} images, expected at "
        f"least images_per_place {images_per_place}",
    )
    drawn_by.check(places)

    def generator(turn: int, key: int) -> np.random.Generator:
        # The spawn key makes this stream independent of the loader's from (seed, epoch).
        entropy = (seed, epoch, turn) if turn else (seed, epoch)
        return np.random.default_rng(np.random.SeedSequence(entropy, spawn_key=(key,)))

    described, descriptors = np.zeros(0, np.int64), np.zeros((0, 0), np.float32)
    if drawn_by.describes:
        require(
            describe is not None,
            f"sampler: found {drawn_by.part_name}, which draws by descriptors, and no `describe`",
        )
        assert describe is not None
        described = drawn_by.images_to_describe(places, generator(0, key=4))
        descriptors = describe([places.path(image) for image in described])
    drawn: list[np.ndarray] = []
    for turn in itertools.count():
        # The first call draws the same as in an epoch without `steps`.
        size = places_per_batch, images_per_place
        draw = Draw(*size, epoch, generator(turn, key=0), described, descriptors)
        drawn.append(_draw(places, drawn_by, draw))
        found = sum(map(len, drawn))
        if not found and turn == _TURNS - 1:
            raise InputError(
                f"{places.root}: found {len(counts)} places of which sampler {drawn_by.part_name} "
                f"makes no batch, expected places_per_batch {places_per_batch} "
                "(--places-per-batch) of them, each once, that are not near each other"
            )
        if found >= least:
            break
    return np.concatenate(drawn)[:steps]


def labels_of(
    places: Places, sampler: Sampler, chosen: Int[np.ndarray, "steps places images"]
) -> Int[np.ndarray, "steps places images"]:
    """Return each image's place, or its group's number in the batch if the sampler regroups."""
    if sampler.regroups:
        return np.broadcast_to(np.arange(chosen.shape[1], dtype=np.int32)[:, None], chosen.shape)
    return places.image_place[chosen]


def _draw(places: Places, sampler: Sampler, draw: Draw) -> Int[np.ndarray, "steps places images"]:
    """Draw the batches of one call, and check them."""
    found = np.asarray(sampler.apply(places, draw))
    is_order, count = found.ndim == 1, len(places.names if found.ndim == 1 else places.files)
    size = draw.places_per_batch, draw.images_per_place
    where, what = f"sampler {sampler.part_name}", "places" if is_order else "images"
    require(
        np.issubdtype(found.dtype, np.integer) and (is_order or found.shape[1:] == size),
        f"{where}: found {found.dtype} of shape {found.shape}, expected indices of places in an "
        f"order, or of images in the shape (steps, {size[0]}, {size[1]})",
    )
    outside = found[(found < 0) | (found >= count)]
    require(not outside.size, f"{where}: found {what} {outside[:3]}, expected 0 to {count - 1}")
    if is_order:
        return _images_of(places, _apart(found.tolist(), places.near, size[0]), draw)
    ordered = np.sort(found.reshape(len(found), size[0] * size[1]), axis=1)
    again = np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1))
    require(not again.size, f"{where}: found an image twice in batch {again[:1]}")
    labels = labels_of(places, sampler, found)
    mixed = np.flatnonzero((labels != labels[..., :1]).any(axis=(1, 2)))
    require(not mixed.size, f"{where}: found images of two places in a group of batch {mixed[:1]}")
    return found


def _images_of(
    places: Places, chosen: Int[np.ndarray, "steps places"], draw: Draw
) -> Int[np.ndarray, "steps places images"]:
    """Sample images of places without replacement; a repeated place gets its remaining images."""
    # Sorting all images by (place, random key) shuffles the images within each place.
    shuffled = np.lexsort((draw.generator.random(len(places.files)), places.image_place))
    flat = chosen.reshape(-1)
    order = np.argsort(flat, kind="stable")
    _, first, times = np.unique(flat[order], return_index=True, return_counts=True)
    before = np.empty(len(flat), np.int64)
    before[order] = np.arange(len(flat)) - np.repeat(first, times)
    offset = before.reshape(*chosen.shape, 1) * draw.images_per_place
    offset = (offset + np.arange(draw.images_per_place)) % places.image_counts[chosen][..., None]
    return shuffled[places.place_start[chosen][..., None] + offset]


def _apart(
    order: Sequence[int], near: Sequence[np.ndarray] | None, size: int
) -> Int[np.ndarray, "steps places"]:
    """Fill batches with places in this order, so that none is near another of its batch."""
    full: list[list[int]] = []
    unfinished: list[tuple[list[int], set[int]]] = []
    for place in order:
        fitting = (number for number, (_, near_it) in enumerate(unfinished) if place not in near_it)
        number = next(fitting, len(unfinished))
        if number == len(unfinished):
            unfinished.append(([], set()))
        batch, near_it = unfinished[number]
        batch.append(place)
        near_it.add(place)
        if near is not None:
            near_it.update(near[place].tolist())
        if len(batch) == size:
            full.append(unfinished.pop(number)[0])
    return np.array(full, np.int64).reshape(-1, size)
