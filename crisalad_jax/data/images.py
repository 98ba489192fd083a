"""Pictures from files: decode to 8-bit RGB, resize as Pillow does, list a folder.

JPEG markers are from ITU-T T.81 annex B, PNG chunks from the W3C PNG specification, section 5.
"""

import contextlib
import functools
import os
import pathlib
import re
import threading
from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from crisalad_jax.errors import InputError

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff")
"""What `list_images` takes for an image, in lower case. Reading goes by content, not by suffix."""

_FORMATS = "a JPEG, PNG, WebP, BMP or TIFF image"
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
# Any marker but the stuffed byte FF00, the restarts FFD0..FFD7 and the fill FFFF.
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
# Output rows made by one small matrix product: so few that its matrix is mostly filter, not zero.
_BAND = 8


def read_image(path: str | os.PathLike[str]) -> UInt8[np.ndarray, "h w 3"]:
    """Read an image file as 8-bit RGB, upright.

    - The EXIF orientation is applied.
    - 16 bits become 8 by dropping the low byte (v >> 8), as OpenCV does.
    - Grey is repeated over the channels, a palette is looked up, CMYK is converted (for JPEG in
      Adobe's inverted convention, as Pillow has it).
    - Alpha is dropped, as by Pillow's convert("RGB"): the hidden colours show. TIFF is the
      exception, where transparency shows black (libtiff composites).
    - The first page or frame of several is taken.

    Raises:
        InputError: the file is missing, a folder, empty, cut short, larger than OpenCV's limit of
            2**30 pixels, or no image of the formats above. Never half a picture.
    """
    try:
        data = pathlib.Path(path).read_bytes()
    except OSError as error:
        raise InputError(
            f"{path}: cannot read: {error.strerror}, expected an image file"
        ) from error
    if not data:
        raise InputError(f"{path}: found an empty file, expected {_FORMATS}")
    # Not left to the decoders: OpenCV 4 fills what a JPEG misses with grey, and libpng and libjpeg
    # write their complaints to stderr past OpenCV's log.
    if (data.startswith(b"\xff\xd8") and not _jpeg_is_whole(data)) or (
        data.startswith(_PNG_SIGNATURE) and not _png_is_whole(data)
    ):
        raise InputError(
            f"{path}: found an image cut short after {len(data)} bytes, expected a whole one"
        )
    try:
        with _quiet_opencv():
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    except cv2.error as error:
        reason = " ".join(error.err.split())
        raise InputError(f"{path}: OpenCV cannot decode this image: {reason}") from error
    if image is None:
        raise InputError(f"{path}: found {len(data)} bytes that do not decode, expected {_FORMATS}")
    return image


def _jpeg_is_whole(data: bytes) -> bool:
    """Whether the segments lead to an end-of-image marker; bytes after it do not matter.

    Segments are skipped by their length, so the end of a thumbnail inside EXIF does not count.
    """
    position = 2
    while marker := _JPEG_MARKER.search(data, position):
        code, position = data[marker.end() - 1], marker.end()
        if code == 0xD9:
            return True
        position += int.from_bytes(data[position : position + 2], "big")
    return False


def _png_is_whole(data: bytes) -> bool:
    """Whether the chunks lead to IEND; bytes after it do not matter."""
    position = len(_PNG_SIGNATURE)
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        kind = data[position + 4 : position + 8]
        position += 12 + length
        if kind == b"IEND":
            return True
    return False


class _Quiet:
    """How many threads decode, and the log level to restore after the last of them."""

    lock = threading.Lock()
    users = 0
    level = 0


@contextlib.contextmanager
def _quiet_opencv() -> Iterator[None]:
    """Silence OpenCV's log, which is one per process: our error says what the user needs."""
    with _Quiet.lock:
        if _Quiet.users == 0:
            _Quiet.level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        _Quiet.users += 1
    try:
        yield
    finally:
        with _Quiet.lock:
            _Quiet.users -= 1
            if _Quiet.users == 0:
                cv2.utils.logging.setLogLevel(_Quiet.level)


def resize_image(
    image: UInt8[np.ndarray, "h w 3"], image_size: tuple[int, int]
) -> UInt8[np.ndarray, "height width 3"]:
    """Resize to `image_size`, (height, width), without keeping the aspect ratio.

    Bilinear, and antialiased where it shrinks: a triangle filter two output pixels wide, which is
    Pillow's BILINEAR and so torchvision's Resize, with which the public models were trained and
    evaluated. Equal to Pillow within one grey level. (OpenCV's INTER_AREA is a box, on photographs
    several times further away; its INTER_LINEAR aliases.)
    """
    height, width = image.shape[:2]
    new_height, new_width = image_size
    if height * new_width < new_height * width:
        # Columns first gives the smaller intermediate, much smaller for extreme aspect ratios.
        turned = resize_image(cv2.transpose(image), (new_width, new_height))
        return cv2.transpose(turned)
    rows = _resample_rows(image.reshape(height, width * 3), new_height)
    columns = cv2.transpose(rows.reshape(new_height, width, 3)).reshape(width, new_height * 3)
    resized = cv2.convertScaleAbs(_resample_rows(columns, new_width))
    return cv2.transpose(resized.reshape(new_width, new_height, 3))


def _resample_rows(
    values: UInt8[np.ndarray, "n m"] | Float32[np.ndarray, "n m"], size: int
) -> Float32[np.ndarray, "size m"]:
    resampled = np.empty((size, values.shape[1]), np.float32)
    for outputs, inputs, weights in _triangle_bands(values.shape[0], size):
        source = values[inputs].astype(np.float32, copy=False)
        np.matmul(weights, source, out=resampled[outputs])
    return resampled


@functools.lru_cache(maxsize=64)
def _triangle_bands(
    old: int, new: int
) -> list[tuple[slice, slice, Float32[np.ndarray, "outputs inputs"]]]:
    """The banded matrix that resamples `old` values to `new`, cut into small dense blocks."""
    scale = old / new
    radius = max(scale, 1.0)
    centres = (np.arange(new) + 0.5) * scale
    bands = []
    for start in range(0, new, _BAND):
        block = centres[start : start + _BAND, None]
        low = max(0, int(block[0, 0] - radius))
        high = min(old, int(np.ceil(block[-1, 0] + radius)))
        distances = np.abs(np.arange(low, high) + 0.5 - block) / radius
        weights = np.maximum(0, 1 - distances)
        weights /= weights.sum(axis=1, keepdims=True)
        bands.append((slice(start, start + _BAND), slice(low, high), weights.astype(np.float32)))
    return bands


def list_images(folder: str | os.PathLike[str]) -> list[pathlib.Path]:
    """Find the images under `folder`, in the order of their posix paths relative to it.

    Recursive, through links to folders too; suffixes in any case; hidden files and folders (a name
    that starts with a dot) are left out.

    Raises:
        InputError: the folder is missing, is a file, or holds no image.
    """
    folder = pathlib.Path(folder)
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing"
        raise InputError(f"{folder}: found {found}, expected a folder of images")
    images = []
    for parent, folders, files in os.walk(folder, followlinks=True):
        # A link to a folder that holds it would be walked for ever.
        here = pathlib.Path(parent)
        folders[:] = [
            name
            for name in folders
            if not name.startswith(".")
            and not ((here / name).is_symlink() and _holds((here / name).resolve(), here))
        ]
        images += [
            here / name
            for name in files
            if not name.startswith(".") and name.lower().endswith(IMAGE_SUFFIXES)
        ]
    if not images:
        raise InputError(
            f"{folder}: found no image, expected files that end in {' '.join(IMAGE_SUFFIXES)}"
        )
    return sorted(images, key=lambda image: image.relative_to(folder).as_posix())


def _holds(folder: pathlib.Path, inner: pathlib.Path) -> bool:
    return inner.resolve().is_relative_to(folder)
