"""One thread that owns an open map and its model: whatever waits is described together.

Nothing else searches or appends, so that every search sees a whole map.
"""

import contextlib
import pathlib
import queue
import threading
from collections.abc import Iterable, Sequence
from concurrent.futures import Future
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float32

from crisalad_jax.data.positions import Positions
from crisalad_jax.data.resize import Pixels
from crisalad_jax.nn.model import Crisalad
from crisalad_jax.retrieval.alone import describe_prepared
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.query import Answer
from crisalad_jax.retrieval.photographs import prepare_image
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, real_path
from crisalad_jax.utils.progress import progress_bar

ADDED = "added"
"""Folder in the map's own of the pictures that were added by requests."""


class NameTakenError(InputError):
    """The map has an image of this name already."""


class MapFailedError(Exception):
    """The map or the model failed, through no fault of the request."""


class Question(NamedTuple):
    """A picture to find among the map's."""

    picture: Pixels
    """As `prepare_image` returns it."""
    k: int


class Addition(NamedTuple):
    """A picture to append to the map."""

    picture: Pixels
    data: bytes
    """Its file."""
    name: str
    position: Positions | None
    """Its position; None where that is unknown."""
    by_exif: bool = False
    """Whether the position is what EXIF data says, which a map in other axes leaves out."""


class Found(NamedTuple):
    """An answer to a question, and its number in the map."""

    number: int
    answer: Answer


class _Waiting(NamedTuple):
    work: Question | Addition
    result: "Future[Any]"


class MapWorker:
    """A thread that describes, appends and searches; a context manager that ends with its work."""

    def __init__(self, places: Map, params: Crisalad, *, batch_size: int) -> None:
        """Take the map, open for appending if pictures shall be added, and the model that made it.

        Args:
            places: the map, which the thread owns until the end.
            params: its model.
            batch_size: largest number of pictures described together.
        """
        self.places, self._params, self._batch_size = places, params, batch_size
        # Each is a program to compile before the first answer, so that they are few.
        powers = (4**i for i in range(batch_size.bit_length()))
        self._sizes = [*(size for size in powers if size < batch_size), batch_size]
        self._waiting: queue.SimpleQueue[_Waiting | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="map", daemon=True)

    def __enter__(self) -> Self:
        """Start the thread."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End the thread after all that was submitted is done."""
        self._waiting.put(None)
        self._thread.join()

    def compile(self, *, quiet: bool = False) -> None:
        """Compile what describes one picture, a few, and `batch_size` of them, and search once.

        Raises:
            InputError: the store is damaged or gone.
        """
        config = self.places.description.config
        blank = prepare_image(np.zeros((*config.image_size, 3), np.uint8), config)
        with progress_bar("compiling", len(self._sizes), "programs", quiet=quiet) as bar:
            for size in self._sizes:
                descriptors = self._describe([blank] * size)
                bar.advance(1)
        self.places.search(descriptors[:1], 1)

    def submit(self, work: Question | Addition) -> "Future[Any]":
        """Queue work; a question's result is a list of `Found`, an addition's the image's number.

        The result raises `InputError` for an addition that the map does not take, `NameTakenError`
        among them, and `MapFailedError` for all else.
        """
        result: Future[Any] = Future()
        self._waiting.put(_Waiting(work, result))
        return result

    def _run(self) -> None:
        while batch := self._next():
            self._work(batch)

    def _next(self) -> list[_Waiting]:
        """Wait for work, and take all that is there, up to a batch; nothing at the end."""
        batch: list[_Waiting] = []
        while len(batch) < self._batch_size:
            try:
                each = self._waiting.get(block=not batch)
            except queue.Empty:
                break
            if each is None:
                self._waiting.put(None)  # ends the next call
                break
            batch.append(each)
        return batch

    def _work(self, batch: Sequence[_Waiting]) -> None:
        try:
            descriptors = self._describe([each.work.picture for each in batch])
            # Additions first: an answer sees what came in with its question.
            self._append(batch, descriptors)
            self._search(batch, descriptors)
        except Exception as error:
            for each in batch:
                if not each.result.done():
                    each.result.set_exception(MapFailedError(str(error)))

    def _describe(self, pictures: Sequence[Pixels]) -> Float32[np.ndarray, "n d"]:
        count, padded = len(pictures), list(pictures)
        if len({picture.shape for picture in pictures}) == 1:
            size = next(size for size in self._sizes if size >= count)
            padded += padded[:1] * (size - count)
        config = self.places.description.config
        described = describe_prepared(self._params, config, padded, batch_size=self._batch_size)
        return self.places.shorten(described)[:count]

    def _append(self, batch: Sequence[_Waiting], descriptors: Float32[np.ndarray, "n d"]) -> None:
        """Append the additions of a batch together, without those that the map does not take."""
        axes, zone = self.places.axes, self.places.zone
        names, rows, works = set[str](), list[int](), list[Addition]()
        of: dict[str, tuple[float, float]] = {}
        for row, (work, result) in enumerate(batch):
            if not isinstance(work, Addition):
                continue
            position = work.position
            if work.by_exif and position and axes not in (None, position.axes):
                position = None
            try:
                position = position and position.fitted("position", axes, zone)
            except InputError as error:
                result.set_exception(error)
                continue
            if work.name in names or self.places.image(work.name) is not None:
                found = f"name: found {work.name!r}, which the map has already, expected a new one"
                result.set_exception(NameTakenError(found))
            elif _is_crossed(self.places.folder / ADDED, work.name, names):
                found = f"name: found {work.name!r}, a folder or below a file of the map's"
                result.set_exception(NameTakenError(f"{found}, expected a new name"))
            else:
                if position is not None:
                    axes, zone = axes or position.axes, zone or position.zone
                    of |= position.of
                names.add(work.name)
                rows.append(row)
                works.append(work)
        if not rows:
            return
        root = self.places.folder / ADDED
        first = len(self.places)
        with _kept(root, works):
            self.places.append(
                [work.name for work in works],
                [len(work.data) for work in works],
                descriptors[rows],
                root=real_path(root).as_posix(),
                positions=axes and Positions(axes, of, zone),
            )
        for number, row in enumerate(rows, first):
            batch[row].result.set_result(number)

    def _search(self, batch: Sequence[_Waiting], descriptors: Float32[np.ndarray, "n d"]) -> None:
        """Search for the questions of a batch at once."""
        rows = [row for row, each in enumerate(batch) if isinstance(each.work, Question)]
        if not rows:
            return
        works = [work for row in rows if isinstance(work := batch[row].work, Question)]
        neighbours = self.places.search(descriptors[rows], max(work.k for work in works))
        images = self.places.images
        for row, work, indices, similarities in zip(rows, works, *neighbours, strict=True):
            pairs = zip(indices[: work.k], similarities, strict=False)
            found = [
                Found(int(number), Answer(rank, float(similarity), images[number]))
                for rank, (number, similarity) in enumerate(pairs, 1)
            ]
            batch[row].result.set_result(found)


def _is_crossed(root: pathlib.Path, name: str, others: Iterable[str]) -> bool:
    """Return whether a file of this name needs a folder where a file is, or the reverse."""
    path = root / name
    above = [parent for parent in path.parents if parent.is_relative_to(root)]
    return (
        path.is_dir()
        or any(parent.exists() and not parent.is_dir() for parent in above)
        or any(
            f"{one}/".startswith(f"{two}/") for o in others for one, two in ((o, name), (name, o))
        )
    )


@contextlib.contextmanager
def _kept(root: pathlib.Path, works: Sequence[Addition]) -> Any:
    """Write the files of pictures; remove them again where the block fails."""
    written: list[pathlib.Path] = []
    try:
        for work in works:
            with atomic_path(root / work.name, durable=True) as temporary:
                temporary.write_bytes(work.data)
            written.append(root / work.name)
        yield
    except BaseException:
        for path in written:
            path.unlink(missing_ok=True)
        raise
