"""Pictures from files: decode to 8-bit RGB, resize as Pillow does, list a folder.

JPEG markers are from ITU-T T.81 annex B, PNG chunks from the W3C PNG specification, section 5.
"""

import functools
import os
import pathlib
import re
import threading
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from crisalad_jax.data.opencv import QUIET
from crisalad_jax.errors import InputError

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff")
"""What `list_images` takes for an image, in lower case. Reading goes by content, not by suffix."""

_FORMATS = "a JPEG, PNG, WebP, BMP or TIFF image"
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
# Any marker but the stuffed byte FF00, the restarts FFD0..FFD7 and the fill FFFF.
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_JPEG_FRAMES = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# The flags for grey pictures, beside which the one for colours still holds.
_REDUCED = (
    (8, cv2.IMREAD_REDUCED_GRAYSCALE_8),
    (4, cv2.IMREAD_REDUCED_GRAYSCALE_4),
    (2, cv2.IMREAD_REDUCED_GRAYSCALE_2),
)
# OpenBLAS takes several threads for a product of more than so many multiplications: more than all
# cores have to do, where each decodes an image of its own.
_SERIAL = 2**18
_KEPT = 3 * 2**22
_Band = tuple[slice, slice, np.ndarray]
"""Which outputs are made of which inputs, by which weights."""


def read_image(
    path: str | os.PathLike[str], *, enough: tuple[int, int] | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """Read an image file as 8-bit RGB, upright.

    For a size (height, width) that is `enough`, a JPEG is decoded at a half, a quarter or an eighth
    of its own while that is twice as large at least: in less time, and once resized one or two
    levels of 256 (root mean square) from the picture of all its pixels.

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
        with QUIET:
            flags = cv2.IMREAD_COLOR_RGB | _reduction(data, enough)
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
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
    # Only a file cut off behind the thumbnail ends so too, which has nothing to decode.
    return data.endswith(b"\xff\xd9") or any(code == 0xD9 for code, _ in _jpeg_segments(data))


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, int]]:
    """Markers, and where what they hold begins: with its length."""
    position = 2
    while marker := _JPEG_MARKER.search(data, position):
        position = marker.end()
        yield data[position - 1], position
        position += int.from_bytes(data[position : position + 2], "big")


def _reduction(data: bytes, enough: tuple[int, int] | None) -> int:
    """OpenCV's flag for the smallest size at which a JPEG is decoded, for `read_image`."""
    if enough is None or not data.startswith(b"\xff\xd8"):
        return 0
    start = next((start for code, start in _jpeg_segments(data) if code in _JPEG_FRAMES), None)
    if start is None:
        return 0
    sides = (int.from_bytes(data[start + i : start + i + 2], "big") for i in (3, 5))
    # The shorter side for the longer, because the picture may have to be turned.
    spare = min(sides) / (2 * max(enough))
    return next((flag for factor, flag in _REDUCED if factor <= spare), 0)


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
    pixels = image.reshape(height, 3 * width)
    rows = _scratch("rows", new_height, 3 * width)
    for outputs, inputs, weights in _row_bands(height, new_height, 3 * width):
        band = _scratch("band", inputs.stop - inputs.start, 3 * width)
        band[:] = pixels[inputs]
        np.matmul(weights, band, out=rows[outputs])
    resized = _scratch("resized", new_height, 3 * new_width)
    for outputs, inputs, weights in _column_bands(width, new_width, new_height):
        np.matmul(rows[:, inputs], weights, out=resized[:, outputs])
    return cv2.convertScaleAbs(resized).reshape(new_height, new_width, 3)


_kept = threading.local()


def _scratch(name: str, rows: int, columns: int) -> Float32[np.ndarray, "rows columns"]:
    """Memory of this thread, with anything in it; the same the next time.

    Memory that is new each time the system hands out page by page, which takes longer than the
    products that go into it. What is larger than a photograph of 4 megapixels is not kept.
    """
    size = rows * columns
    if size > _KEPT:
        return np.empty((rows, columns), np.float32)
    memory = getattr(_kept, name, None)
    if memory is None or memory.size < size:
        memory = np.empty(size, np.float32)
        setattr(_kept, name, memory)
    return memory[:size].reshape(rows, columns)


@functools.lru_cache(maxsize=64)
def _row_bands(old: int, new: int, columns: int) -> list[_Band]:
    """To multiply rows of `columns` numbers from the left."""
    return _bands(old, new, columns)


@functools.lru_cache(maxsize=64)
def _column_bands(old: int, new: int, rows: int) -> list[_Band]:
    """To multiply `rows` rows from the right, which hold three numbers for each pixel."""

    def wide(pixels: slice) -> slice:
        return slice(3 * pixels.start, 3 * pixels.stop)

    # Each number is that of its own channel alone: two thirds of the products are with zeros, which
    # takes less time than to turn the picture twice.
    eye = np.eye(3, dtype=np.float32)
    return [
        (wide(outputs), wide(inputs), np.kron(weights.T, eye))
        for outputs, inputs, weights in _bands(old, new, 9 * rows)
    ]


def _bands(old: int, new: int, others: int) -> list[_Band]:
    """The banded matrix that resamples `old` values to `new`, cut into small dense blocks.

    By so many `others` a block is multiplied, in less work than is shared among threads.
    """
    scale = old / new
    radius = max(scale, 1.0)
    centres = (np.arange(new) + 0.5) * scale
    size = next(n for n in (8, 4, 2, 1) if n * (n + 2) * radius * others <= _SERIAL or n == 1)
    bands = []
    for start in range(0, new, size):
        stop = min(start + size, new)
        block = centres[start:stop, None]
        low = max(0, int(block[0, 0] - radius))
        high = min(old, int(np.ceil(block[-1, 0] + radius)))
        distances = np.abs(np.arange(low, high) + 0.5 - block) / radius
        weights = np.maximum(0, 1 - distances)
        weights /= weights.sum(axis=1, keepdims=True)
        bands.append((slice(start, stop), slice(low, high), weights.astype(np.float32)))
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


def names_in(folder: pathlib.PurePath, images: Sequence[pathlib.PurePath]) -> list[str]:
    """Posix paths of images relative to a folder that holds them, each fit to be a line of text.

    Raises:
        InputError: a name has a line break in it, or bytes that are no UTF-8.
    """
    names = [image.relative_to(folder).as_posix() for image in images]
    for name in names:
        if len(name.splitlines()) != 1:
            raise InputError(f"{folder}: found a line break in the name {name!r}, expected none")
        if not name.isprintable() and any("\ud800" <= letter <= "\udfff" for letter in name):
            raise InputError(f"{folder}: found the name {name!r}, expected UTF-8")
    return names


def _holds(folder: pathlib.Path, inner: pathlib.Path) -> bool:
    return inner.resolve().is_relative_to(folder)
