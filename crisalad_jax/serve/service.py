"""What the service answers, whatever the protocol: where, what is here, and pictures of the map."""

import asyncio
import concurrent.futures
import functools
import io
import pathlib
import time
from typing import Any

import cv2
import numpy as np

from crisalad_jax.data.images import decode_image, read_image
from crisalad_jax.data.positions import AXES, Positions, exif_position
from crisalad_jax.data.resize import Pixels, resize_image
from crisalad_jax.data.video import file_of
from crisalad_jax.retrieval.maps.query import answer_fields, asked_similarity, position_fields
from crisalad_jax.retrieval.photographs import prepare_image
from crisalad_jax.serve.names import check_new_name
from crisalad_jax.serve.worker import ADDED, Addition, Found, MapWorker, Question
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.host import usable_cores

_DECODERS = 4
"""Largest number of pictures decoded at once: each may have --max-pixels of three bytes."""
_SIDE = 480
"""Largest side of a thumbnail in pixels."""
_THUMBNAILS = 512
"""Number of thumbnails in memory, some 30 kB each."""
_DOTS = 4000
"""Number of places that the page draws at most."""


class MapService:
    """A map's answers. Pictures are decoded by threads of its own, described by its worker's."""

    def __init__(
        self, worker: MapWorker, *, appends: bool, images: pathlib.Path | None = None
    ) -> None:
        """Take the worker of a map.

        Args:
            worker: running.
            appends: whether the map is open for appending.
            images: folder of the map's pictures; None is where they were.
        """
        self.appends = appends
        self._worker, self._images = worker, images
        threads = min(usable_cores(), _DECODERS)
        self._threads = concurrent.futures.ThreadPoolExecutor(threads, "decode")
        self._since = time.monotonic()
        self._small = functools.lru_cache(_THUMBNAILS)(self._thumbnail)

    def close(self) -> None:
        """End the threads."""
        self._threads.shutdown()

    def health(self) -> dict[str, Any]:
        """Tell that the service runs, of which model, how it searches, and since when."""
        places = self._worker.places
        return {
            "status": "ok",
            "images": len(places),
            "model": places.description.model,
            "search": places.search_kind,
            "stale_search": places.stale_search,
            "uptime_s": round(time.monotonic() - self._since, 1),
        }

    def map_fields(self) -> dict[str, Any]:
        """Describe the map for the page, with at most `_DOTS` of its positions, evenly chosen."""
        places = self._worker.places
        known = [
            (number, *image.position)
            for number, image in enumerate(places.images[:])
            if image.position is not None
        ]
        step = -(-len(known) // _DOTS) or 1
        return {
            "name": places.folder.resolve().name,
            "images": len(places),
            "axes": places.axes,
            "zone": places.zone and str(places.zone),
            "positions": known[::step],
            "positions_known": len(known),
            "appends": self.appends,
        }

    async def locate(
        self, data: bytes, name: str, k: int
    ) -> tuple[list[dict[str, Any]], bool | None]:
        """Find the k most similar images of the map to a picture.

        Args:
            data: the picture's file.
            name: the file's name, for messages.
            k: number of answers.

        Returns:
            Fields of each answer as `crisalad query --json` has them, and its number; and whether
            the picture shows a place of the map, None where that is not calibrated.

        Raises:
            InputError: the bytes are no picture that can be read.
            MapFailedError: the map or the model failed.
        """
        picture = await self._prepared(data, name)
        work = Question(picture, k)
        found: list[Found] = await asyncio.wrap_future(self._worker.submit(work))
        places = self._worker.places
        fields = [
            {**answer_fields(answer, places.axes), "number": number} for number, answer in found
        ]
        least = asked_similarity(places, None)
        return fields, None if least is None else found[0][1].similarity >= least

    async def append(
        self,
        data: bytes,
        name: str,
        position: Positions | None,
    ) -> dict[str, Any]:
        """Append a picture to the map, for good once this returns.

        Args:
            data: the picture's file.
            name: its name in the map.
            position: where it was taken; None where that is unknown, and EXIF data may say it.

        Returns:
            Its number, its name, its position, and how many images the map has now.

        Raises:
            InputError: no picture, or a name or position that the map does not take.
            MapFailedError: the map or the model failed.
        """
        check_new_name(name)
        picture = await self._prepared(data, name)
        by_exif = position is None
        if by_exif:
            loop = asyncio.get_running_loop()
            file = io.BytesIO(data)
            said = await loop.run_in_executor(self._threads, exif_position, file)
            position = said and Positions(AXES[1], {name: said})
        work = Addition(picture, data, name, position, by_exif)
        number = await asyncio.wrap_future(self._worker.submit(work))
        places = self._worker.places
        return {
            "number": number,
            "name": name,
            "position": position_fields(places.images[number], places.axes),
            "images": len(places),
        }

    async def thumbnail(self, number: int) -> bytes:
        """Return a small JPEG of an image of the map.

        Raises:
            InputError: the map has no such image, or its file is gone, changed or unreadable.
        """
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._threads, self._small, number)

    async def _prepared(self, data: bytes, name: str) -> Pixels:
        def prepare() -> Pixels:
            config = self._worker.places.description.config
            return prepare_image(decode_image(data, name), config, name)

        return await asyncio.get_running_loop().run_in_executor(self._threads, prepare)

    def _thumbnail(self, number: int) -> bytes:
        images = self._worker.places.images
        if not 0 <= number < len(images):
            raise InputError(f"number: found {number}, expected 0 to {len(images) - 1}")
        image = images[number]
        # The record of a map keeps its names below a folder.
        folders = [pathlib.Path(image.root), self._worker.places.folder / ADDED]
        if self._images is not None:
            folders.insert(0, self._images)
        paths = (folder / image.name for folder in folders)
        # A file of another size is another picture, as `crisalad index` has it.
        path = next((path for path in paths if _has_size(path, image.bytes)), None)
        if path is None:
            raise InputError(f"{image.name}: found no such picture any more, see --map-images")
        try:
            pixels = read_image(path, enough=(_SIDE, _SIDE), bit_depth="contrast-stretch")
        except InputError as error:
            raise InputError(f"{image.name}: found a picture that cannot be read") from error
        return _as_jpeg(pixels)


def _has_size(path: pathlib.Path, size: int) -> bool:
    """Return whether an image's file, of a frame its video, is there and has so many bytes."""
    file = file_of(path)
    return file.is_file() and file.stat().st_size == size


def _as_jpeg(pixels: Pixels) -> bytes:
    factor = _SIDE / max(pixels.shape[:2])
    if factor < 1:
        height, width = (max(1, round(factor * side)) for side in pixels.shape[:2])
        pixels = resize_image(pixels, (height, width))
    whole, data = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]))
    if not whole:
        raise InputError("thumbnail: found a picture that cannot be written as a JPEG")
    return data.tobytes()
