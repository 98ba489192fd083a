"""Batches of decoded images, read ahead by threads in a fixed order."""

import collections
import contextlib
import dataclasses
import itertools
import os
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeVar

import cv2
import numpy as np

from crisalad_jax.config.checks import NonNegativeInt, check_count, check_types, takes
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.config.short_repr import brief, with_field_docs
from crisalad_jax.data.images import OnBadImage, read_pixels
from crisalad_jax.data.places import JoinedPlaces, Places
from crisalad_jax.data.prepare import Preparation
from crisalad_jax.data.remote import AT_ONCE, is_remote, read_remote
from crisalad_jax.data.resize import Pixels
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.host import usable_cores
from crisalad_jax.utils.shapes import Bool, Float32, Int, Int32, Int64, UInt8

if TYPE_CHECKING:  # lazy, because reading images needs none of them
    from crisalad_jax.data.augmentations.base import Augmentation
    from crisalad_jax.data.query_set import QuerySet
    from crisalad_jax.data.samplers.base import Describe, Sampler

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
BATCHES_AHEAD = 2
THREADS = usable_cores()
"""One thread per core, as OpenCV releases the GIL: two decode about 500 photographs a second."""


_SMALL = 16
"""Batches of up to this many images are padded to a power of two, to compile few sizes."""


@brief
class ImageBatch(NamedTuple):
    """Images of one size; `valid` is False for padding and for images that cannot be read."""

    images: UInt8[np.ndarray, "batch h w 3"] | Float32[np.ndarray, "batch h w 3"]
    """8-bit pixels, or normalised floats; zeros where not valid."""
    labels: Int32[np.ndarray, " batch"]
    """In training, index of the image's place or group, or, for mined tuples, tuple and role in one
    number (`losses.pairs.tuple_labels`); otherwise, index in the list of paths. -1 for padding."""
    valid: Bool[np.ndarray, " batch"]
    indices: Int64[np.ndarray, " batch"]
    """Index of the image in its set or list, also for unreadable images; -1 for padding."""


class _OneThread:
    """A context that turns off OpenCV's own threads; any number of threads may enter it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = self._before = 0

    def __enter__(self) -> None:
        with self._lock:
            if self._users == 0:
                self._before = cv2.getNumThreads()
                cv2.setNumThreads(1)
            self._users += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0:
                cv2.setNumThreads(self._before)


_ONE_THREAD = _OneThread()
"""Used where images are already decoded on all cores."""


class ImageCache:
    """A cache of decoded and resized images in memory, up to a budget; threads may share it.

    A set that fits is decoded once for all epochs. The cache never evicts an image: once the budget
    is spent it stores no more. A file that changes on disk is not read again.
    """

    def __init__(
        self,
        budget_bytes: int = 2**30,
        read_far: Callable[[str | os.PathLike[str]], bytes] = read_remote,
    ) -> None:
        """Create a cache for up to `budget_bytes` of pixels; `read_far` reads remote files."""
        self._room, self._read_far = budget_bytes, read_far
        self._images: dict[tuple[str, Preparation, bool], Pixels] = {}
        self._lock = threading.Lock()

    def read(
        self, path: str | os.PathLike[str], how: Preparation, *, quickly: bool = False
    ) -> Pixels:
        """Read and prepare an image, from memory if it is cached; the array is read-only.

        With `quickly`, a large JPEG is decoded at a smaller size (`enough` of `read_image`).

        Raises:
            InputError: the image cannot be read.
        """
        key = (os.fspath(path), how, quickly)
        image = self._images.get(key)
        if image is None:
            enough = how.image_size if quickly else None
            pixels = read_pixels(path, enough=enough, read_far=self._read_far)
            image = how.prepare(pixels, os.fspath(path))
            image.setflags(write=False)
            with self._lock:
                if key not in self._images and image.nbytes <= self._room:
                    self._images[key] = image
                    self._room -= image.nbytes
        return image

    def fill(self, paths: Iterable[str | os.PathLike[str]], how: Preparation) -> None:
        """Cache images in this order until the budget is spent; `read` reports unreadable ones."""
        for path in paths if self._room else ():
            with contextlib.suppress(InputError):
                if self.read(path, how, quickly=True).nbytes > self._room:
                    return


@with_field_docs
@dataclasses.dataclass(frozen=True, kw_only=True)
class Reading:
    """Options for reading images: batch size, threads and what to do about unreadable images.

    Example:
        >>> Reading(batch_size=32, on_bad_image="skip").batch_size
        32
    """

    batch_size: int = 16
    """Number of images described together."""
    on_bad_image: OnBadImage = "stop"
    """"stop" at an unreadable image, or "skip" it."""
    threads: NonNegativeInt = THREADS
    """Number of threads that decode ahead; 0 decodes in the caller's thread."""
    cache: ImageCache | None = None
    """Cache of decoded images; None caches none."""
    quiet: bool = False
    """Whether to hide progress bars."""

    def __post_init__(self) -> None:
        """Check the fields."""
        check_types(self)
        check_count("batch size", self.batch_size)

    def fitted(self, images: int) -> Self:
        """Return these options with the batch size reduced to suit a small number of images.

        Example:
            >>> [Reading(batch_size=32).fitted(count).batch_size for count in (1, 3, 12, 20, 50)]
            [1, 4, 16, 20, 32]
        """
        padded = images if images > _SMALL else 1 << max(0, images - 1).bit_length()
        return dataclasses.replace(self, batch_size=min(self.batch_size, padded))

    def batches(
        self, paths: Sequence[str | os.PathLike[str]], preparation: Preparation
    ) -> Iterator[ImageBatch]:
        """Yield batches of image files, in order; the last one is padded.

        If prepared images differ in size, a batch holds consecutive images of one size, and every
        change of size ends and pads a batch: if most sizes differ, a `batch_size` of 1 saves work.
        Under "skip", an unreadable image is marked as not valid, but has its index.

        Args:
            paths: the image files.
            preparation: how the model's images are resized and normalised.

        Raises:
            InputError: while iterating, for an unreadable image under "stop".
        """
        cache = self.cache or ImageCache(0)
        slots = np.arange(len(paths))

        def load(slot: int) -> Pixels:
            return cache.read(paths[slot], preparation)

        where: Any = {"has_frames": _has_frames(paths), "far": any(map(is_remote, paths))}
        return self.read(load, slots, slots, slots, preparation, **where)

    def read(
        self,
        load: Callable[[int], Pixels],
        slots: np.ndarray,
        indices: np.ndarray,
        labels: np.ndarray,
        preparation: Preparation,
        *,
        has_frames: bool,
        far: bool,
    ) -> Iterator[ImageBatch]:
        """Yield batches of the images `load(slot)` for `slots`, with their `indices` and `labels`.

        A batch holds the next `batch_size` images, or fewer if the size changes. With `has_frames`
        at most one thread reads, because each would read the video from its beginning. Remote
        images (`far`) get more threads, which mostly wait.
        """
        least = AT_ONCE if far and self.threads else 0
        threads = min(self.threads, 1) if has_frames else max(self.threads, least)

        def load_or_skip(slot: int) -> Pixels | None:
            try:
                return load(slot)
            except InputError as error:
                if self.on_bad_image == "stop":
                    raise InputError(f"{error} (--on-bad-image skip leaves it out)") from error
                return None

        ahead = max(BATCHES_AHEAD * self.batch_size, threads)
        read = read_ahead(load_or_skip, slots.tolist(), ahead=ahead, threads=threads)
        with _ONE_THREAD, contextlib.closing(read):
            start = 0
            for run in _same_size_runs(read, self.batch_size):
                batch = _padded_batch(run, self.batch_size, preparation)
                batch.indices[: len(run)] = indices[start : start + len(run)]
                batch.labels[: len(run)] = labels[start : start + len(run)]
                start += len(run)
                yield batch


def _has_frames(files: Iterable[str | os.PathLike[str]]) -> bool:
    return any("#t=" in os.fspath(file) for file in files)


@takes(places=Places)
def training_batches(
    places: Places,
    *,
    image_size: tuple[int, int],
    places_per_batch: int,
    images_per_place: int,
    sampler: "Sampler | str",
    augmentation: "Augmentation | str",
    seed: int,
    epoch: int,
    preprocessing: PreprocessingConfig = PreprocessingConfig(),
    steps: int | None = None,
    start_step: int = 0,
    part: tuple[int, int] = (0, 1),
    on_bad_image: OnBadImage = "stop",
    threads: int = THREADS,
    cache: ImageCache | None = None,
    describe: "Describe | None" = None,
) -> Iterator[ImageBatch]:
    """Yield the training batches of one epoch.

    The same (seed, epoch, step) gives bit-identical batches for any `threads`, `start_step` and
    `part`. Images are resized to `image_size` (height, width), then augmented; large JPEGs are
    decoded at a smaller scale first (see `read_image`). An unreadable image stops the epoch or,
    under "skip", is marked as not valid.

    Args:
        places: the places to draw from.
        image_size: height and width in pixels that images are resized to.
        places_per_batch: number of places in a batch.
        images_per_place: number of images of each place.
        sampler: draws the batches; a registered sampler, or its name.
        augmentation: changes each image; a registered augmentation, or its name.
        seed: seed of all random draws, together with the epoch and the step.
        epoch: index of the epoch, from 0.
        preprocessing: how to resize; always to `image_size`, antialiased, as bytes.
        steps: number of batches; None takes what the sampler draws: every place about once.
        start_step: the first batch to yield, to resume an interrupted epoch.
        part: (i, n) yields part i, from 0, of n equal parts of every batch, for one of n processes.
        on_bad_image: "stop" at an unreadable image, or "skip" it.
        threads: number of threads that decode ahead; 0 decodes in the caller's thread.
        cache: cache of decoded images between epochs.
        describe: function from image files to descriptors, for samplers that need descriptors.

    Yields:
        The batches: pixels, labels, and which images are valid.

    Raises:
        InputError: immediately, for arguments out of range or a sampler that finds no batch; while
            iterating, for an unreadable image under "stop".

    Example:
        >>> from crisalad_jax import read_places
        >>> batches = training_batches(
        ...     read_places(places, min_images=3),
        ...     image_size=(98, 98),
        ...     places_per_batch=2,
        ...     images_per_place=3,
        ...     sampler="shuffled",
        ...     augmentation="none",
        ...     seed=0,
        ...     epoch=0,
        ... )
        >>> next(batches).images.shape
        (6, 98, 98, 3)
    """
    from crisalad_jax.data.samplers.base import SAMPLERS, epoch_batches, labels_of

    sampler = SAMPLERS.resolve(sampler, "sampler")
    size: Any = {"places_per_batch": places_per_batch, "images_per_place": images_per_place}
    chosen = epoch_batches(
        places, sampler=sampler, seed=seed, epoch=epoch, steps=steps, describe=describe, **size
    )
    how: Any = {"image_size": image_size, "preprocessing": preprocessing, "seed": (seed, epoch)}
    how |= {"augmentation": augmentation, "start_step": start_step, "part": part}
    how |= {"on_bad_image": on_bad_image, "threads": threads, "cache": cache}
    return batches_of_groups(places, chosen, labels_of(places, sampler, chosen), **how)


def batches_of_groups(
    files: "Places | JoinedPlaces | QuerySet",
    chosen: Int[np.ndarray, "steps groups images"],
    labels: Int[np.ndarray, "steps groups images"],
    *,
    image_size: tuple[int, int],
    augmentation: "Augmentation | str",
    seed: tuple[int, ...],
    preprocessing: PreprocessingConfig = PreprocessingConfig(),
    start_step: int = 0,
    part: tuple[int, int] = (0, 1),
    on_bad_image: OnBadImage = "stop",
    threads: int = THREADS,
    cache: ImageCache | None = None,
) -> Iterator[ImageBatch]:
    """Yield batches of chosen images: groups of images of a place, or mined tuples.

    Args:
        files: the set of the images.
        chosen: indices in `files` of the images of every batch, in groups.
        labels: labels of these images.
        image_size: height and width in pixels that images are resized to.
        augmentation: changes each image; the images of a group share what is drawn for their place.
        seed: numbers that seed the augmentation, together with the step.
        preprocessing: see `training_batches`, also for the arguments below.
        start_step: the first batch to yield.
        part: (i, n) yields part i, from 0, of n equal parts of every batch.
        on_bad_image: "stop" at an unreadable image, or "skip" it.
        threads: number of threads that decode ahead.
        cache: cache of decoded images.

    Yields:
        The batches.

    Raises:
        InputError: `start_step` or `part` is out of range; an image is unreadable, under "stop".
    """
    _, groups, images_per_group = chosen.shape
    batch_size = groups * images_per_group
    mine, parts = part
    if not (0 <= start_step <= len(chosen) and 0 <= mine < parts and batch_size % parts == 0):
        raise InputError(
            f"start_step, part: found {start_step} and {part}, expected 0 to {len(chosen)}, and "
            f"the i-th of n equal parts of {batch_size} images"
        )
    from crisalad_jax.data.augmentations.base import AUGMENTATIONS

    augment = AUGMENTATIONS.resolve(augmentation, "augmentation")
    reading = Reading(batch_size=batch_size // parts, on_bad_image=on_bad_image, threads=threads)
    how = Preparation(image_size, preprocessing.for_training())
    cache = cache or ImageCache(0)
    if has_frames := _has_frames(files.files):
        # Read in order, because the frames of a batch are far apart in the video.
        cache.fill(map(files.path, np.unique(chosen)), how)
    indices = chosen.reshape(-1)
    slots = np.arange(indices.size).reshape(len(chosen), parts, batch_size // parts)

    def load(number: int) -> Pixels:
        image = cache.read(files.path(indices[number]), how, quickly=True)
        step, slot = divmod(number, batch_size)
        # The spawn key makes each place's stream independent of the streams of the images.
        place = (*seed, step, slot // images_per_group)
        of_place = np.random.default_rng(np.random.SeedSequence(place, spawn_key=(1,)))
        generator = np.random.default_rng((*seed, step, slot))
        augmented = np.asarray(augment.apply(image, generator, of_place=of_place))
        if augmented.shape != image.shape or augmented.dtype != np.uint8:
            raise InputError(
                f"augmentation {augment.part_name}: found to return {augmented.dtype} of shape "
                f"{augmented.shape}, expected uint8 of {image.shape}"
            )
        return augmented

    own = slots[start_step:, mine].reshape(-1)
    far = any(is_remote(files.path(image)) for image in indices[:1])
    where: Any = {"has_frames": has_frames, "far": far}
    return reading.read(load, own, indices[own], labels.reshape(-1)[own], how, **where)


def read_ahead(
    work: Callable[[_Item], _Result], items: Iterable[_Item], *, ahead: int, threads: int
) -> Generator[_Result, None, None]:
    """Yield the result of `work` for each item, in the order of the items.

    Closing the generator cancels work that has not started.

    Args:
        work: the function to apply to each item.
        items: the arguments of `work`.
        ahead: number of items to work on before they are requested.
        threads: number of threads; 0 works in the caller's thread.
    """
    if not threads:
        yield from map(work, items)
        return
    executor = ThreadPoolExecutor(threads)
    waiting: collections.deque[Future[_Result]] = collections.deque()
    rest = iter(items)
    try:
        waiting.extend(executor.submit(work, item) for item in itertools.islice(rest, ahead))
        while waiting:
            result = waiting.popleft().result()
            waiting.extend(executor.submit(work, item) for item in itertools.islice(rest, 1))
            yield result
    finally:
        executor.shutdown(cancel_futures=True)


def one_ahead(stream: Generator[_Item, None, None]) -> Generator[_Item, None, None]:
    """Yield a stream's items, computing each one in a thread while the previous one is in use.

    The first two are computed directly: for a single item, as in a search of a small map, starting
    a thread would take longer than the search.
    """
    with contextlib.closing(stream):
        yield from itertools.islice(stream, 1)
        item = next(stream, None)
        if item is None:
            return
        with ThreadPoolExecutor(1) as thread:
            while item is not None:
                ahead = thread.submit(next, stream, None)
                yield item
                item = ahead.result()


def _same_size_runs(
    images: Iterable[Pixels | None], batch_size: int
) -> Iterator[list[Pixels | None]]:
    """Yield runs of at most `batch_size` consecutive images of one size; None fits any size."""
    run: list[Pixels | None] = []
    for image in images:
        if len({each.shape for each in (*run, image) if each is not None}) > 1:
            yield run
            run = []
        run.append(image)
        if len(run) == batch_size:
            yield run
            run = []
    if run:
        yield run


def _padded_batch(run: Sequence[Pixels | None], batch_size: int, how: Preparation) -> ImageBatch:
    """Pad images to a batch; if none of them can be read, they get the model's image size."""
    sizes = (image.shape[:2] for image in run if image is not None)
    batch = ImageBatch(
        images=np.zeros((batch_size, *next(sizes, how.size_of(how.image_size)), 3), how.dtype),
        labels=np.full(batch_size, -1, np.int32),
        valid=np.zeros(batch_size, np.bool_),
        indices=np.full(batch_size, -1, np.int64),
    )
    for slot, image in enumerate(run):
        if image is not None:
            batch.images[slot], batch.valid[slot] = image, True
    return batch
