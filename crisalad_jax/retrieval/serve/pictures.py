"""Receive pictures from requests, and make thumbnails of the map's images."""

import asyncio
import io
import math
import os
import pathlib

import cv2
import numpy as np
from fastapi import HTTPException, Request
from PIL import Image
from starlette.datastructures import UploadFile
from starlette.types import Message

from crisalad_jax.config.checks import require
from crisalad_jax.data.frames import frame_time
from crisalad_jax.data.images import IMAGE_SUFFIXES, jpeg_scans, read_image
from crisalad_jax.data.remote import size_of
from crisalad_jax.data.resize import resize_image
from crisalad_jax.retrieval.maps.images import MapImage
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.serve.worker import ADDED
from crisalad_jax.utils.errors import InputError

_PATIENCE = 60.0
"""Seconds within which a picture must arrive."""
_FIELDS = 10
"""Maximum number of files, and of fields, that are read from a form."""
_LONGEST, _LONGEST_PATH = 200, 1000
"""Maximum bytes of each part of a new image's name, and of the full name: file systems allow 255
per part, and the name of a temporary file is longer."""
_LEVELS = 20
"""Maximum number of parts of a new image's name."""
Image.init()
_KNOWN = ("JPEG", "PNG", "WEBP", "BMP", "TIFF", "GIF", "AVIF", "JPEG2000", "PPM")
_FORMATS = [each for each in _KNOWN if each in Image.OPEN]
"""Pillow's names of the accepted formats; OpenCV would decode others too."""
_PLAIN = ("JPEG", "MPO", "PNG", "WEBP", "BMP", "PPM")
"""Formats whose header gives the size to decode; tiles and frames of others have their own."""
_MOST_SCANS = 32
"""Maximum scans of a JPEG: encoders write about ten, and each takes as long as a plain JPEG."""
_SIDE = 480
"""Maximum length of a thumbnail's longer side, in pixels."""
Image.MAX_IMAGE_PIXELS = None  # `check_picture` has its own limit, and decodes nothing


async def receive_picture(request: Request, most_bytes: int) -> tuple[bytes, str]:
    """Receive the bytes and file name of a picture, from the body or the form field `image`.

    Raises:
        HTTPException: the request has too many bytes or is too slow, or a form has other fields.
    """
    received = 0

    async def receive() -> Message:
        nonlocal received
        message = await request.receive()
        received += len(message.get("body", b""))
        if received > most_bytes:
            raise HTTPException(413, f"image: found more than {most_bytes} bytes")
        return message

    limited = Request(request.scope, receive)
    try:
        async with asyncio.timeout(_PATIENCE):
            kind = request.headers.get("content-type", "").lower()
            if not kind.startswith("multipart/form-data"):
                return await limited.body(), "image"
            async with limited.form(max_files=_FIELDS, max_fields=_FIELDS) as form:
                image = form.get("image")
                if len(form.multi_items()) != 1 or not isinstance(image, UploadFile):
                    names = ", ".join(name for name, _ in form.multi_items()) or "nothing"
                    raise HTTPException(
                        400, f"image: found a form of {names}, expected one file of this name"
                    )
                return await image.read(), image.filename or "image"
    except UnicodeError as error:  # from a charset that the form names
        raise HTTPException(400, f"image: found a form of another charset: {error}") from error
    except TimeoutError as error:
        raise HTTPException(408, f"image: found only part of it after {_PATIENCE:g} s") from error


def check_picture(data: bytes, name: str, most_pixels: int) -> float:
    """Check a picture's header, and return its pixel count; infinity if decoding may exceed it.

    Raises:
        InputError: the format is not accepted, or the picture has too many pixels or (JPEG) scans.
    """
    try:
        with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
            pixels, kind = image.width * image.height, image.format
    except Exception as error:  # a damaged file may raise any
        found = f"{len(data)} bytes that do not decode" if data else "an empty file"
        expected = f"an image ({' '.join(IMAGE_SUFFIXES)})"
        raise InputError(f"{name}: found {found}, expected {expected}") from error
    if pixels > most_pixels:
        expected = f"at most {most_pixels} (--max-pixels raises that)"
        raise InputError(f"{name}: found {pixels} pixels, expected {expected}")
    if (scans := jpeg_scans(data)) > _MOST_SCANS:
        raise InputError(f"{name}: found a JPEG of {scans} scans, expected at most {_MOST_SCANS}")
    return pixels if kind in _PLAIN else math.inf


def check_new_name(name: str) -> None:
    """Check that a name is a plain path below a folder, without hidden parts.

    Raises:
        InputError: a part is empty, hidden or too long; there are too many parts; or the name has
            control characters, was not UTF-8, or is that of a frame of a video or robot log.

    Example:
        >>> check_new_name("tuesday/0001.jpg")
    """
    # First, since what cannot be encoded is not printable either.
    plain = name.isprintable() and not set("\\\ufffd") & set(name) and frame_time(name) is None
    plain = plain and len(name.encode()) <= _LONGEST_PATH and name.count("/") < _LEVELS
    if not plain or any(
        not part or part.startswith(".") or part != part.strip() or len(part.encode()) > _LONGEST
        for part in name.split("/")
    ):
        raise InputError(
            f"name: found {name[:80]!r}, expected a path such as 'tuesday/0001.jpg', of parts of "
            f"1 to {_LONGEST} bytes that do not begin with a dot"
        )


def image_in(places: Map, row: int) -> MapImage:
    """Return the image in a row of a map's store; a row is never reused for another image.

    Raises:
        InputError: there is no such row, or its image was removed from the map.
    """
    number = int(places.removed.numbers_of(np.array(row)))
    if not 0 <= number < len(places):
        last = places.removed.rows_of(np.array(len(places) - 1))
        raise InputError(f"number: found {row}, expected 0 to {last}")
    require(not places.removed.has(row), f"number: found {row}, which was removed from the map")
    return places.images[number]


def read_thumbnail(
    image: MapImage, folder: pathlib.Path, images: str | os.PathLike[str] | None
) -> bytes:
    """Return an image of a map as a JPEG of at most 480 pixels on its longer side.

    Args:
        image: the image.
        folder: the folder of the map.
        images: folder to look in before the one from which the image was indexed; None for none.

    Raises:
        InputError: the image's file is missing, of another size, or unreadable.
    """
    # The record of a map ensures that names stay below a folder.
    folders = [*([] if images is None else [images]), image.root, folder / ADDED]
    paths = (pathlib.Path(folder, image.name) for folder in folders)
    path = next((path for path in paths if size_of(path) == image.bytes), None)
    if path is None:
        raise InputError(f"{image.name}: found no such picture any more, see --map-images")
    try:
        pixels = read_image(path, enough=(_SIDE, _SIDE), bit_depth="contrast-stretch")
    except InputError as error:
        raise InputError(f"{image.name}: found a picture that cannot be read") from error
    factor = _SIDE / max(pixels.shape[:2])
    if factor < 1:
        height, width = (max(1, round(factor * side)) for side in pixels.shape[:2])
        pixels = resize_image(pixels, (height, width))
    return cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]))[1].tobytes()
