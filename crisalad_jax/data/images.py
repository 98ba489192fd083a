"""Decode image files to 8-bit RGB, and list the images of a folder.

JPEG markers are from ITU-T T.81 annex B, PNG chunks from the W3C PNG specification, section 5.
"""

import os
import pathlib
import re
import zlib
from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from crisalad_jax.data.opencv import MAX_PIXELS, QUIET
from crisalad_jax.data.resize import resize_image
from crisalad_jax.data.video import frame_time, read_frame
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_bytes, real_path
from crisalad_jax.utils.notes import tell
from crisalad_jax.utils.shapes import UInt8

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff")
"""Suffixes of images for `list_images`, in lower case. Decoding goes by content, not by suffix."""
_OTHER_SUFFIXES = (
    ".heic",
    ".heif",
    ".avif",
    ".gif",
    ".jp2",
    ".jxl",
    ".dng",
    ".cr2",
    ".nef",
    ".arw",
)
"""Suffixes of images that are not read, so that folders of them are told of."""

_FORMATS = "a JPEG, PNG, WebP, BMP or TIFF image"
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
# Any marker except the stuffed byte FF00, the restarts FFD0..FFD7 and the fill FFFF.
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_JPEG_FRAMES = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# OpenCV's flags for reduced grey images; with the colour flag they reduce RGB images too.
_REDUCED = (
    (8, cv2.IMREAD_REDUCED_GRAYSCALE_8),
    (4, cv2.IMREAD_REDUCED_GRAYSCALE_4),
    (2, cv2.IMREAD_REDUCED_GRAYSCALE_2),
)


def read_image(
    path: str | os.PathLike[str],
    size: tuple[int, int] | None = None,
    *,
    enough: tuple[int, int] | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """Read an image file as 8-bit RGB, upright.

    With `enough`, a JPEG is decoded at a half, a quarter or an eighth of its size, as long as that
    is at least twice `enough`. Decoding is faster. After resizing, the image differs by one or two
    levels of 256 (root mean square) from one decoded at full size.

    - The EXIF orientation is applied.
    - 16 bits become 8 by dropping the low byte (v >> 8), as OpenCV does.
    - Grey is repeated over the channels, a palette is looked up, CMYK is converted (for JPEG in
      Adobe's inverted convention, as Pillow has it).
    - Alpha is dropped, as by Pillow's convert("RGB"): the hidden colours show. TIFF is the
      exception, where transparency shows black (libtiff composites).
    - The first page or frame of several is taken.

    Args:
        path: the image file, or a frame of a video, as in `walk.mp4#t=12.500` (seconds).
        size: height and width in pixels to resize to, by the default of `resize_image`; None keeps
            the file's. Where a model has another way, `prepare_image` follows it.
        enough: height and width in pixels that the image will be resized to; None for full size.

    Returns:
        The image, in red, green and blue.

    Raises:
        InputError: the file is missing, a folder, empty, cut short, larger than 2**28 pixels
            (`opencv.MAX_PIXELS`), or no image of the formats above; never half a picture. Or a
            `size` without a pixel.

    Example:
        >>> read_image(pictures / "0.png").shape
        (60, 80, 3)
        >>> read_image(pictures / "0.png", (224, 224)).shape
        (224, 224, 3)
    """
    if frame_time(path) is None:
        image = decode_image(read_bytes(path, "an image file"), path, enough=enough)
    else:
        image = read_frame(path)
    return image if size is None else resize_image(image, size)


def decode_image(
    data: bytes, path: str | os.PathLike[str], *, enough: tuple[int, int] | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """Decode the bytes of an image file as `read_image` does.

    Args:
        data: all bytes of the file.
        path: the file's name, for messages.
        enough: as of `read_image`.

    Returns:
        The image, in red, green and blue.

    Raises:
        InputError: as `read_image`.
    """
    if not data:
        raise InputError(f"{path}: found an empty file, expected {_FORMATS}")
    # Check before decoding: OpenCV 4 fills missing parts of a JPEG with grey, and libpng and
    # libjpeg write warnings to stderr that OpenCV's log level does not silence.
    if (data.startswith(b"\xff\xd8") and not _jpeg_is_whole(data)) or (
        data.startswith(_PNG_SIGNATURE) and not _png_is_whole(data)
    ):
        raise InputError(
            f"{path}: found an image cut short after {len(data)} bytes, or damaged, expected a "
            "whole one"
        )
    if data.startswith(_PNG_SIGNATURE):
        _check_png_size(data, path)
    try:
        with QUIET:
            flags = cv2.IMREAD_COLOR_RGB | _reduction(data, enough)
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        reason = " ".join(error.err.split())
        if "MAX_IMAGE_PIXELS" in reason:
            reason = (
                f"found more than {os.environ.get(MAX_PIXELS)} pixels, expected fewer "
                "(--max-pixels raises that)"
            )
        raise InputError(f"{path}: OpenCV cannot decode this image: {reason}") from error
    if image is None:
        raise InputError(f"{path}: found {len(data)} bytes that do not decode, expected {_FORMATS}")
    return image


def _jpeg_is_whole(data: bytes) -> bool:
    """Return whether a JPEG's segments reach an end-of-image marker; later bytes do not matter.

    Segments are skipped by their length, so the end of a thumbnail inside EXIF does not count.
    """
    # A file cut off behind its thumbnail passes too, but has no pixels to decode.
    return data.endswith(b"\xff\xd9") or any(code == 0xD9 for code, _ in _jpeg_segments(data))


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield each marker and the offset of its payload, which begins with its length."""
    position = 2
    while marker := _JPEG_MARKER.search(data, position):
        position = marker.end()
        yield data[position - 1], position
        position += int.from_bytes(data[position : position + 2], "big")


def _reduction(data: bytes, enough: tuple[int, int] | None) -> int:
    """Return OpenCV's flag for the smallest size at which `read_image` decodes a JPEG."""
    if enough is None or not data.startswith(b"\xff\xd8"):
        return 0
    start = next((start for code, start in _jpeg_segments(data) if code in _JPEG_FRAMES), None)
    if start is None:
        return 0
    sides = (int.from_bytes(data[start + i : start + i + 2], "big") for i in (3, 5))
    # Compare the shorter side with the longer, because EXIF may rotate the image.
    spare = min(sides) / (2 * max(enough))
    return next((flag for factor, flag in _REDUCED if factor <= spare), 0)


def _png_is_whole(data: bytes) -> bool:
    """Return whether a PNG has a size, and chunks up to IEND with right checksums.

    Chunks whose name begins with a small letter are not needed for the pixels.
    """
    position = len(_PNG_SIGNATURE)
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        kind = data[position + 4 : position + 8]
        end = position + 8 + length
        if kind[:1].isupper() and data[end : end + 4] != _crc(data[position + 4 : end]):
            return False
        position = end + 4
        if kind == b"IEND":
            return bytes(4) not in (data[16:20], data[20:24])
    return False


_PNG_SIDE = 1_000_000
"""Largest side that libpng decodes; of a larger one it writes lines of its own."""


def _check_png_size(data: bytes, path: str | os.PathLike[str]) -> None:
    width, height = (int.from_bytes(data[at : at + 4], "big") for at in (16, 20))
    if max(width, height) > _PNG_SIDE:
        raise InputError(
            f"{path}: found {width} x {height} pixels, expected sides of at most {_PNG_SIDE}"
        )


def _crc(data: bytes) -> bytes:
    return zlib.crc32(data).to_bytes(4, "big")


def list_images(folder: str | os.PathLike[str]) -> list[pathlib.Path]:
    """Find the images under `folder`, in the order of their posix paths relative to it.

    The search is recursive and follows links to folders. Suffixes may have any case. Hidden files
    and folders (a name that starts with a dot) are left out.

    Raises:
        InputError: the folder is missing, is a file, or holds no image.
    """
    if not os.fspath(folder):
        raise InputError("images: found an empty name, expected a folder of images")
    folder = pathlib.Path(folder)
    if not folder.is_dir():
        kind = "a file" if folder.exists() else "nothing"
        raise InputError(f"{folder}: found {kind}, expected a folder of images")
    images, others = [], []
    # Real paths from the top to each folder: a link to one of them would make the walk endless.
    above = {folder: frozenset({real_path(folder)})}
    for parent, folders, files in os.walk(folder, followlinks=True):
        here = pathlib.Path(parent)
        inside = []
        for name in folders:
            real = real_path(here / name)
            loops = any(each.is_relative_to(real) for each in above[here])
            if not name.startswith(".") and not loops:
                above[here / name] = above[here] | {real}
                inside.append(name)
        folders[:] = inside
        for name in files:
            if name.lower().endswith(IMAGE_SUFFIXES) and not name.startswith("."):
                images.append(here / name)
            elif name.lower().endswith(_OTHER_SUFFIXES) and not name.startswith("."):
                others.append(here / name)
    if others:
        tell(
            f"{folder}: left out {len(others)} images of types that are not read, as "
            f"{min(others).name!r}, expected files that end in {' '.join(IMAGE_SUFFIXES)}"
        )
    if not images:
        raise InputError(
            f"{folder}: found no image, expected files that end in {' '.join(IMAGE_SUFFIXES)}"
        )
    return sorted(images, key=lambda image: image.relative_to(folder).as_posix())


def names_in(folder: pathlib.PurePath, images: Sequence[pathlib.PurePath]) -> list[str]:
    """Return the images' posix paths relative to their folder, each checked to fit a line of text.

    Raises:
        InputError: a name has a line break in it, or bytes that are no UTF-8.
    """
    names = [image.relative_to(folder).as_posix() for image in images]
    check_lines(names, folder)
    return names


def check_lines(names: Sequence[str], source: object) -> None:
    """Check that each name fits in one line of text.

    Args:
        names: the names of images.
        source: what the message begins with, such as their folder.

    Raises:
        InputError: a name has a line break in it, or bytes that are no UTF-8.

    Example:
        >>> check_lines(["street/a.jpg"], "images")
    """
    for name in names:
        if len(name.splitlines()) != 1:
            raise InputError(f"{source}: found a line break in the name {name!r}, expected none")
        if not name.isprintable() and any("\ud800" <= letter <= "\udfff" for letter in name):
            raise InputError(f"{source}: found the name {name!r}, expected UTF-8")
