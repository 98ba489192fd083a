"""The one thread that owns an open map and its model: it describes, appends and searches.

Nothing else searches or appends, so every search sees a consistent map. Changes by other processes
are visible from the next batch on.
"""

import collections
import contextlib
import os
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Float32

from crisalad_jax.data.positions import Positions
from crisalad_jax.data.resize import Pixels
from crisalad_jax.retrieval.describe import describe_prepared, prepare_image
from crisalad_jax.retrieval.describer import Describer
from crisalad_jax.retrieval.maps.appending import AppendableMap
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.where import Where
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, real_path
from crisalad_jax.utils.progress import progress_bar
from crisalad_jax.utils.temporaries import made_folder

ADDED = "added"
"""Name of the map's subfolder for images that requests have added."""
_LONGEST_FILE = 3800
"""Maximum bytes of a full path. Linux allows 4,095; the name of a temporary file is longer."""


class NameTakenError(InputError):
    """The name of a new image is already that of an image or a folder of the map."""


class MapFailedError(Exception):
    """The map or the model failed, through no fault of the request."""


class Question(NamedTuple):
    """An image to find in the map."""

    pixels: Pixels
    """The prepared image, as `prepare_image` returns it."""
    k: int
    where: Where | None = None
    """Which images of the map to search; None searches all."""


class Addition(NamedTuple):
    """An image to append to the map."""

    pixels: Pixels
    data: bytes
    """Content of the image file."""
    name: str
    position: Positions | None


class MapWorker:
    """A thread that answers questions in batches and appends images; close it at the end."""

    def __init__(self, places: Map, describer: Describer, *, batch_size: int) -> None:
        """Take the map, and the model that made it.

        Args:
            places: the map, which the thread owns until `close`; for additions, an `AppendableMap`.
            describer: the model that made the map.
            batch_size: maximum number of images described together.
        """
        self.places, self._describer, self._batch_size = places, describer, batch_size
        # Each size is a program to compile before the first answer, so there are few.
        powers = (4**i for i in range(batch_size.bit_length()))
        self._sizes = [*(size for size in powers if size < batch_size), batch_size]
        self._waiting = collections.deque[tuple[Question | Addition, Future[Any]]]()
        self._thread = ThreadPoolExecutor(1, "map")

    def close(self) -> None:
        """End the thread, once all submitted work is done."""
        self._thread.shutdown()

    def compile(self, *, quiet: bool = False) -> None:
        """Compile the programs that describe one, a few and `batch_size` images, and search once.

        Raises:
            InputError: the store is damaged or missing.
        """
        config = self.places.config
        blank = prepare_image(np.zeros((*config.image_size, 3), np.uint8), config)
        with progress_bar("compiling", len(self._sizes), "programs", quiet=quiet) as bar:
            for size in self._sizes:
                descriptors = self._describe([blank] * size)
                bar.advance(1)
        self.places.search(descriptors[:1], 1)

    def submit(self, work: Question | Addition) -> "Future[Any]":
        """Queue a question or an addition.

        Returns:
            A future. For a question, its result is (the searched map, [(number, similarity), ...])
            of the k most similar images, best first; for an addition, the new image's number. The
            future raises `InputError` if no image meets the conditions or the map refuses the
            addition (`NameTakenError` for its name), and `MapFailedError` for everything else.
        """
        result: Future[Any] = Future()
        self._waiting.append((work, result))
        self._thread.submit(self._work)
        return result

    def _work(self) -> None:
        """Process a batch of queued work; an earlier call may have left nothing."""
        count = min(len(self._waiting), self._batch_size)
        taken = [self._waiting.popleft() for _ in range(count)]
        batch = [each for each in taken if each[1].set_running_or_notify_cancel()]
        if not batch:
            return
        try:
            self.places = self.places.refreshed()
            descriptors = self._describe([work.pixels for work, _ in batch])
            jobs = [_Job(*each, row) for each, row in zip(batch, descriptors, strict=True)]
            # Additions first: an answer includes what arrived with its question.
            self._append([job for job in jobs if isinstance(job.work, Addition)])
            self._search([job for job in jobs if isinstance(job.work, Question)])
        except Exception as error:
            for _, result in batch:
                if not result.done():
                    result.set_exception(MapFailedError(str(error)))

    def _describe(self, images: Sequence[Pixels]) -> Float32[np.ndarray, "n d"]:
        padded = list(images)
        if len({image.shape for image in images}) == 1:
            size = next(size for size in self._sizes if size >= len(images))
            padded += padded[:1] * (size - len(images))
        described = describe_prepared(self._describer, padded, self._batch_size)
        return self.places.shorten(described)[: len(images)]

    def _append(self, jobs: "Sequence[_Job]") -> None:
        """Append images together, or one by one if that fails, so that only a bad one fails."""
        if not jobs:
            return
        first = len(self.places)
        try:
            self._commit([job.work for job in jobs], np.stack([job.descriptor for job in jobs]))
        except Exception as error:
            if len(jobs) > 1:
                for job in jobs:
                    self._append([job])
            else:
                jobs[0].result.set_exception(error)
            return
        for number, job in enumerate(jobs, first):
            job.result.set_result(number)

    def _commit(self, works: Sequence[Addition], descriptors: Float32[np.ndarray, "n d"]) -> None:
        """Write the files of images, and append the images to the map: all of them, or none."""
        places, root = cast(AppendableMap, self.places), self.places.folder / ADDED
        for work in works:
            self._check_name(work.name)
        fitted = [
            work.position.fitted("position", places.axes, places.zone)
            for work in works
            if work.position is not None
        ]
        if len({(each.axes, each.zone) for each in fitted}) > 1:
            raise MapFailedError("positions in several axes or zones, to be appended one by one")
        known = {name: at for each in fitted for name, at in each.of.items()}
        try:
            with contextlib.ExitStack() as folders, contextlib.ExitStack() as undo:
                for work in works:
                    folders.enter_context(made_folder((root / work.name).parent))
                    with atomic_path(root / work.name, durable=True) as temporary:
                        temporary.write_bytes(work.data)
                    undo.callback((root / work.name).unlink, missing_ok=True)
                names, sizes = [work.name for work in works], [len(work.data) for work in works]
                where = fitted[0]._replace(of=known) if fitted else None
                holder = real_path(root).as_posix()
                places.append(names, sizes, descriptors, root=holder, positions=where)
                undo.pop_all()
        except Exception as error:
            raise MapFailedError(str(error)) from error

    def _check_name(self, name: str) -> None:
        """Raise `NameTakenError` if the name is in the map or conflicts with another's path."""
        path = self.places.folder / ADDED / name
        if len(os.fsencode(path.absolute())) > _LONGEST_FILE:
            raise InputError(f"name: found {len(name.encode())} bytes, expected fewer in this map")
        crossed = os.path.isdir(path) or any(map(os.path.isfile, path.parents))
        if crossed or self.places.image(name) is not None:
            expected = "expected one that neither an image nor a folder of the map has"
            raise NameTakenError(f"name: found {name!r}, {expected}")

    def _search(self, jobs: "Sequence[_Job]") -> None:
        """Search for all questions with the same conditions at once."""
        for where in {job.work.where for job in jobs}:
            some = [job for job in jobs if job.work.where == where]
            try:
                _ = where and self.places.left_out(where)
            except InputError as error:  # no image is left
                for job in some:
                    job.result.set_exception(error)
                continue
            rows = np.stack([job.descriptor for job in some])
            found = self.places.search(rows, max(job.work.k for job in some), where=where)
            for job, numbers, similarities in zip(some, *found, strict=True):
                k = job.work.k
                best = zip(numbers[:k].tolist(), similarities[:k].tolist(), strict=True)
                job.result.set_result((self.places, list(best)))


class _Job(NamedTuple):
    """A piece of work in progress."""

    work: Any
    result: "Future[Any]"
    descriptor: Float32[np.ndarray, " d"]
