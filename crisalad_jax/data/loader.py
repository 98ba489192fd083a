"""Batches of decoded images, read ahead by threads or processes (grain) in a fixed order."""

import contextlib
import gc
import itertools
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, NamedTuple, TypeVar

import cv2
import grain
import numpy as np
from absl import flags
from jaxtyping import Bool, Int32, Int64, UInt8

from crisalad_jax.config import AugmentConfig, LightAugmentConfig
from crisalad_jax.cores import usable_cores
from crisalad_jax.data.augment import augment as augment_image
from crisalad_jax.data.images import read_image
from crisalad_jax.data.opencv import ONE_THREAD
from crisalad_jax.data.places import Order, Places, epoch_batches
from crisalad_jax.data.resize import resize_image
from crisalad_jax.errors import InputError

OnBadImage = Literal["skip", "stop"]
BATCHES_AHEAD = 2
# Images that a thread makes in one go: grain takes 0.16 ms to hand over what it made.
_TOGETHER = 8
THREADS = min(usable_cores(), 16)
"""OpenCV decodes outside of Python's lock: two cores decode some 500 photographs a second."""

_Image = UInt8[np.ndarray, "h w 3"]
_Item = TypeVar("_Item")


class ImageBatch(NamedTuple):
    """Images of one size; `valid` is False for padding and for images that cannot be read."""

    images: UInt8[np.ndarray, "batch h w 3"]
    """Zeros where not valid."""
    labels: Int32[np.ndarray, " batch"]
    """Place index; position in the list of paths where there are no places; -1 for padding."""
    valid: Bool[np.ndarray, " batch"]
    indices: Int64[np.ndarray, " batch"]
    """Image index, also of an unreadable image; -1 for padding."""


class ImageCache:
    """Keeps decoded and resized images in memory up to a budget; safe to share between threads.

    For sets that fit, which are then decoded once for all epochs. Nothing is dropped for newer
    images once the budget is spent, and a file that changes on disk is not read again.
    """

    def __init__(self, budget_bytes: int = 2**30) -> None:
        """Start empty, with room for `budget_bytes` of pixels."""
        self._room = budget_bytes
        self._images: dict[tuple[str, tuple[int, int], bool], _Image] = {}
        self._lock = threading.Lock()

    def read(
        self, path: str | os.PathLike[str], image_size: tuple[int, int], *, quickly: bool = False
    ) -> _Image:
        """Read an image at (height, width), from memory if it is there; the array is read-only.

        What is read `quickly` may have been decoded at a smaller size; see `read_image`.

        Raises:
            InputError: the image cannot be read.
        """
        key = (os.fspath(path), image_size, quickly)
        image = self._images.get(key)
        if image is None:
            image = _read(path, image_size, quickly=quickly)
            image.setflags(write=False)
            with self._lock:
                if key not in self._images and image.nbytes <= self._room:
                    self._images[key] = image
                    self._room -= image.nbytes
        return image


def _read(
    path: str | os.PathLike[str], image_size: tuple[int, int], *, quickly: bool = False
) -> _Image:
    return resize_image(read_image(path, enough=image_size if quickly else None), image_size)


def training_batches(
    places: Places,
    *,
    image_size: tuple[int, int],
    places_per_batch: int,
    images_per_place: int,
    order: Order,
    augment: AugmentConfig | None,
    seed: int,
    epoch: int,
    steps: int | None = None,
    start_step: int = 0,
    part: tuple[int, int] = (0, 1),
    on_bad_image: OnBadImage = "stop",
    threads: int = THREADS,
    workers: int = 0,
    cache: ImageCache | None = None,
) -> Iterator[ImageBatch]:
    """Batches of one epoch, places_per_batch x images_per_place images each, place after place.

    The same (seed, epoch, step) gives the same bits, whatever `threads`, `workers`, `start_step`
    and `part`. Images are resized to `image_size` (height, width), large ones from a JPEG's smaller
    scale (see `read_image`), then augmented. An image that cannot be read stops the epoch or, under
    "skip", leaves a slot that is not valid.

    Args:
        places: what to draw from; see `epoch_batches` for the order.
        steps: so many batches; None takes every place once.
        start_step: the first batch to give, to go on with an epoch that was interrupted.
        part: (i, n) gives the i-th of n equal parts of every batch, for the i-th of n processes.
        threads: how many decode ahead; 0 decodes in the caller's thread.
        workers: so many processes decode ahead instead, and keep nothing in `cache`. They start
            anew for each epoch, in some seconds; a program that asks for them is imported by each
            (`if __name__ == "__main__"`).
        cache: keeps decoded images from epoch to epoch.

    Raises:
        InputError: at once for arguments out of range, as in `epoch_batches`; while iterating under
            "stop" for an image that cannot be read.
    """
    chosen = epoch_batches(
        places,
        places_per_batch=places_per_batch,
        images_per_place=images_per_place,
        order=order,
        seed=seed,
        epoch=epoch,
        steps=steps,
    )
    if not 0 <= start_step <= len(chosen):
        raise InputError(f"start_step: found {start_step}, expected 0 to {len(chosen)}")
    batch_size = places_per_batch * images_per_place
    number, parts = part
    if not 0 <= number < parts or batch_size % parts:
        raise InputError(f"part: found {part}, expected the i-th of n, which divides {batch_size}")
    indices = chosen.reshape(-1)
    slots = np.arange(indices.size).reshape(len(chosen), parts, batch_size // parts)
    read = _read if cache is None or workers else cache.read

    def load(position: int) -> _Image:
        image = read(places.path(indices[position]), image_size, quickly=True)
        if augment is None:
            return image
        step, slot = divmod(position, batch_size)
        if isinstance(augment, LightAugmentConfig) and augment.flip > 0:
            # The spawn key keeps this draw, one for each place, apart from those for each image.
            entropy = (seed, epoch, step, slot // images_per_place)
            sequence = np.random.SeedSequence(entropy, spawn_key=(1,))
            if np.random.default_rng(sequence).random() < augment.flip:
                image = cv2.flip(image, 1)
        return augment_image(image, augment, np.random.default_rng((seed, epoch, step, slot)))

    return _batches(
        load,
        labels=places.image_place[indices],
        indices=indices,
        positions=slots[start_step:, number].reshape(-1),
        image_size=image_size,
        batch_size=batch_size // parts,
        on_bad_image=on_bad_image,
        threads=threads,
        workers=workers,
    )


def image_batches(
    paths: Sequence[str | os.PathLike[str]],
    *,
    image_size: tuple[int, int],
    batch_size: int,
    on_bad_image: OnBadImage = "stop",
    threads: int = THREADS,
    cache: ImageCache | None = None,
) -> Iterator[ImageBatch]:
    """Batches of the images in `paths`, in order; the last one is padded to `batch_size`.

    Under "skip" an image that cannot be read is not valid but keeps its index. The other arguments
    are those of `training_batches`.

    Raises:
        InputError: at once for arguments out of range; while iterating under "stop" for an image
            that cannot be read.
    """
    if batch_size < 1:
        raise InputError(f"batch_size: found {batch_size}, expected at least 1")
    read = _read if cache is None else cache.read
    indices = np.arange(len(paths))
    return _batches(
        lambda position: read(paths[position], image_size),
        labels=indices,
        indices=indices,
        positions=indices,
        image_size=image_size,
        batch_size=batch_size,
        on_bad_image=on_bad_image,
        threads=threads,
    )


def one_ahead(stream: Generator[_Item, None, None]) -> Generator[_Item, None, None]:
    """The same items, each made in a thread while the one before it is in use."""
    with contextlib.closing(stream), ThreadPoolExecutor(1) as thread:
        ahead = thread.submit(next, stream, None)
        while (item := ahead.result()) is not None:
            ahead = thread.submit(next, stream, None)
            yield item


def _batches(
    load: Callable[[int], _Image],
    *,
    labels: np.ndarray,
    indices: np.ndarray,
    positions: np.ndarray,
    image_size: tuple[int, int],
    batch_size: int,
    on_bad_image: OnBadImage,
    threads: int,
    workers: int = 0,
) -> Iterator[ImageBatch]:
    """Check the arguments now, rather than when the first batch is asked for; then iterate.

    Each batch holds what `load` makes of the next `batch_size` of `positions`.
    """
    if on_bad_image not in ("skip", "stop"):
        raise InputError(f"on_bad_image: found {on_bad_image!r}, expected one of skip, stop")
    for name, count in (("threads", threads), ("workers", workers)):
        if count < 0:
            raise InputError(f"{name}: found {count}, expected at least 0")
    if min(image_size) < 1:
        raise InputError(
            f"image_size: found {image_size}, expected a height and width of at least 1"
        )

    def load_or_tell(number: int) -> tuple[_Image | None, str]:
        # What grain says of an exception in a process of its own names no file.
        try:
            return load(int(positions[number])), ""
        except InputError as error:
            return None, str(error)

    spans = [
        range(start, min(start + batch_size, len(positions)))
        for start in range(0, len(positions), batch_size)
    ]
    # Smaller than a batch, so that the threads share the batch in hand.
    size = max(1, min(_TOGETHER, batch_size // max(threads, workers, 1)))
    runs = [span[first : first + size] for span in spans for first in range(0, len(span), size)]

    def one_by_one(
        stream: Iterator[list[tuple[_Image | None, str]]],
    ) -> Iterator[tuple[_Image | None, str]]:
        try:
            yield from itertools.chain.from_iterable(stream)
        except RuntimeError as error:
            if not workers:
                raise
            words = f"workers: one of {workers} that read images has ended: {error}"
            if "exit code -7" in str(error):  # SIGBUS
                words += " (likely for want of shared memory: give /dev/shm more, or less workers)"
            raise InputError(words) from error

    def batches() -> Generator[ImageBatch, None, None]:
        dataset = grain.MapDataset.source(runs).map(lambda run: list(map(load_or_tell, run)))
        ahead = -(-BATCHES_AHEAD * batch_size // size)
        stream = iter(_ahead(dataset, ahead, threads, workers))
        # Closing cancels what is queued, so that an abandoned epoch does not go on decoding.
        with ONE_THREAD, contextlib.closing(stream):
            found = one_by_one(stream)
            for span in spans:
                part = positions[span.start : span.stop]
                batch = _empty_batch(batch_size, image_size)
                batch.labels[: len(part)] = labels[part]
                batch.indices[: len(part)] = indices[part]
                for slot, (image, problem) in enumerate(itertools.islice(found, len(part))):
                    if image is not None:
                        batch.images[slot] = image
                        batch.valid[slot] = True
                    elif on_bad_image == "stop":
                        raise InputError(problem)
                yield batch

    return _released(batches()) if workers else batches()


def _ahead(dataset: grain.MapDataset, many: int, threads: int, workers: int) -> grain.IterDataset:
    """Elements made so many ahead, in order."""
    if not workers:
        return dataset.to_iter_dataset(
            grain.ReadOptions(
                num_threads=min(threads, many), prefetch_buffer_size=many if threads else 0
            )
        )
    if not flags.FLAGS.is_parsed():
        flags.FLAGS.mark_as_parsed()  # grain's own, which it hands to its processes
    alone = dataset.to_iter_dataset(grain.ReadOptions(num_threads=0, prefetch_buffer_size=0))
    return alone.mp_prefetch(
        grain.MultiprocessingOptions(workers, per_worker_buffer_size=-(-many // workers)),
        worker_init_fn=_begin_work,
    )


def _released(batches: Generator[ImageBatch, None, None]) -> Iterator[ImageBatch]:
    """The same; the memory shared with processes, held by objects in cycles, is given back."""
    try:
        with contextlib.closing(batches):
            yield from batches
    finally:
        gc.collect()


def _begin_work(_index: int, _count: int) -> None:
    """In a process that reads images: end with the one that it reads for, and not before."""
    cv2.setNumThreads(1)
    for number in (signal.SIGINT, signal.SIGTERM):  # which a terminal, or a scheduler, sends to all
        signal.signal(number, signal.SIG_IGN)
    reader_for = multiprocessing.parent_process()
    assert reader_for is not None

    def end_with_it() -> None:
        reader_for.join()
        os._exit(1)

    threading.Thread(target=end_with_it, daemon=True).start()


def _empty_batch(batch_size: int, image_size: tuple[int, int]) -> ImageBatch:
    return ImageBatch(
        images=np.zeros((batch_size, *image_size, 3), np.uint8),
        labels=np.full(batch_size, -1, np.int32),
        valid=np.zeros(batch_size, np.bool_),
        indices=np.full(batch_size, -1, np.int64),
    )
