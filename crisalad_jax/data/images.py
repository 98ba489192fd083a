"""Decode image files to 8-bit RGB, and list the images of a folder.

JPEG markers are from ITU-T T.81 annex B, PNG chunks from the W3C PNG specification, section 5.
"""

import collections
import itertools
import os
import pathlib
import re
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Literal

import cv2
import numpy as np

from crisalad_jax.config.checks import PATH, takes
from crisalad_jax.config.preprocessing import BitDepth
from crisalad_jax.data.frames import has_frames, parse_frame
from crisalad_jax.data.prepare import as_rgb
from crisalad_jax.data.remote import address_of, is_remote, list_remote, read_remote
from crisalad_jax.data.resize import resize_image
from crisalad_jax.data.video import read_frame
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_bytes, real_path
from crisalad_jax.utils.output import counted, warn
from crisalad_jax.utils.shapes import UInt8

MAX_PIXELS = "OPENCV_IO_MAX_IMAGE_PIXELS"
"""Environment variable with the maximum number of pixels of an image. OpenCV reads it when imported
and checks it before decoding, because a small file can claim an image that fills the memory. If it
is not set, this package sets it to 2**28, for which an image takes 0.8 GB."""
OnBadImage = Literal["skip", "stop"]
"""What to do about an image that is missing or cannot be read: leave it out, or stop."""
_OF_JPEG = (".jpg", ".jpeg", ".jpe", ".jfif")
_SUFFIXES = (
    *_OF_JPEG,
    *(".png", ".webp", ".bmp", ".tif", ".tiff", ".gif", ".avif", ".jp2"),
    *(".ppm", ".pgm", ".pbm", ".pnm"),
)
# OpenCV does not list what it decodes. It decodes what it encodes, and builds differ in that.
IMAGE_SUFFIXES = tuple(
    suffix for suffix in _SUFFIXES if suffix in _OF_JPEG or cv2.haveImageWriter(suffix)
)
"""Suffixes of images, in lower case, used to find files by name. Decoding depends only on their
content."""
SELF_CHECKED = (*_OF_JPEG, ".png")
"""Suffixes of the formats in which `decode_image` can detect that a file is cut short."""
_FORMATS = f"an image ({' '.join(IMAGE_SUFFIXES)})"
_PNG_SIDE = 1_000_000
"""Largest side that libpng decodes; for larger ones it prints to stderr."""
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_AVIF = (b"ftypavif", b"ftypavis")
_TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_PNM_HEADER = re.compile(
    rb"P[2356]" + 2 * (rb"(?:\s|#[^\n]*\n)+" + rb"\d{1,9}") + rb"(?:\s|#[^\n]*\n)+(\d{1,5})\b"
)
"""Width, height, and the value of white."""
# Any marker except the stuffed byte FF00, the fill FFFF, and FF01 and the restarts FFD0..FFD7,
# which have no segment.
_JPEG_MARKER = re.compile(rb"\xff[^\x00\x01\xd0-\xd7\xff]")
_JPEG_FRAMES = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# OpenCV's flags for reduced grey images; with the colour flag they reduce RGB images too.
_REDUCED = (
    (8, cv2.IMREAD_REDUCED_GRAYSCALE_8),
    (4, cv2.IMREAD_REDUCED_GRAYSCALE_4),
    (2, cv2.IMREAD_REDUCED_GRAYSCALE_2),
)


@takes(path=PATH)
def read_image(
    path: str | os.PathLike[str],
    size: tuple[int, int] | None = None,
    *,
    enough: tuple[int, int] | None = None,
    bit_depth: BitDepth = "high-byte",
) -> UInt8[np.ndarray, "h w 3"]:
    """Read an image file as 8-bit RGB, upright.

    With `enough`, a JPEG is decoded at half, a quarter or an eighth of its size, as long as that is
    at least twice `enough`. This is faster. After resizing, the image differs by one or two levels
    of 256 (root mean square) from one decoded at full size.

    - JPEG, PNG, WebP, BMP, TIFF, GIF, AVIF, JPEG 2000 and PPM, PGM, PBM are read.
    - The EXIF orientation is applied, and an AVIF's rotation.
    - 16 bits become 8 by dropping the low byte (v >> 8), unless `bit_depth` says otherwise.
    - Grey is repeated over the channels, a palette is looked up, CMYK is converted (for JPEG in
      Adobe's inverted convention, as in Pillow).
    - Alpha is dropped, as by Pillow's convert("RGB"): the hidden colours show. TIFF and GIF are the
      exceptions: transparency shows as black (libtiff composites), or as the GIF's background.
    - Of several pages or frames, the first is read.

    Args:
        path: the image file, or a frame of a video, as in `walk.mp4#t=12.500` (seconds), or of a
            robot log (see docs/how-to/image-sources.md).
        size: height and width in pixels to resize to, with the defaults of `resize_image`; None
            keeps the file's size. `prepare_image` resizes by a model's configuration.
        enough: height and width in pixels that the image will be resized to; None for full size.
        bit_depth: how more than 8 bits become 8; see `PreprocessingConfig`.

    Returns:
        The image, in red, green and blue.

    Raises:
        InputError: the file is missing, a folder, empty, cut short (no partial image is returned),
            larger than 2**28 pixels (OPENCV_IO_MAX_IMAGE_PIXELS) or in another format; it has
            floats or signed integers without "contrast-stretch"; or a side of `size` is below 1.

    Example:
        >>> read_image(pictures / "0.png").shape
        (60, 80, 3)
        >>> read_image(pictures / "0.png", (224, 224)).shape
        (224, 224, 3)
    """
    image = as_rgb(read_pixels(path, enough=enough), bit_depth, os.fspath(path))
    return image if size is None else resize_image(image, size)


def read_pixels(
    path: str | os.PathLike[str],
    *,
    enough: tuple[int, int] | None = None,
    read_far: Callable[[str | os.PathLike[str]], bytes] = read_remote,
) -> np.ndarray:
    """Read an image file as `read_image` does, but at the file's bit depth; see `decode_image`.

    `read_far` is the function that reads the bytes of a remote file.
    """
    frame = parse_frame(path)
    if frame is None and is_remote(path):
        return decode_image(read_far(path), address_of(path), enough=enough)
    if frame is None:
        return decode_image(read_bytes(path, "an image file"), path, enough=enough)
    if frame.topic is None:
        return read_frame(frame)
    from crisalad_jax.data.logs import open_log  # here, because it imports this module

    return open_log(frame.file).read(frame.topic, frame.nanoseconds, enough=enough)


def decode_image(
    data: bytes, path: str | os.PathLike[str], *, enough: tuple[int, int] | None = None
) -> np.ndarray:
    """Decode the bytes of an image file, at the file's bit depth.

    Args:
        data: all bytes of the file.
        path: the file's name, for messages.
        enough: see `read_image`.

    Returns:
        The image, upright: RGB (height, width, 3), or grey (height, width). PNG, TIFF and PNM may
        have more than 8 bits, which `prepare_image` reduces to 8 by the model's configuration.

    Raises:
        InputError: `data` is empty, cut short, or in another format, or the image is too large.
    """
    # Check before decoding: OpenCV 4 fills missing parts of a JPEG with grey, and libpng and
    # libjpeg write warnings to stderr that OpenCV's log level does not silence.
    is_cut = (data.startswith(b"\xff\xd8") and not _jpeg_is_whole(data)) or (
        data.startswith(_PNG_SIGNATURE) and not _png_is_whole(data)
    )
    image, found = None, f"{len(data)} bytes that do not decode" if data else "an empty file"
    try:
        if is_cut:
            found = f"an image cut short after {len(data)} bytes, or damaged"
        elif data:
            image = _decoded(np.frombuffer(data, np.uint8), data[:12], _reduction(data, enough))
            image = _full_range(image, data)
    except cv2.error as error:
        found = " ".join(error.err.split())
        if "MAX_IMAGE_PIXELS" in found:
            found = f"more than {os.environ.get(MAX_PIXELS)} pixels (--max-pixels raises that)"
    if image is None:
        raise InputError(f"{path}: found {found}, expected {_FORMATS}")
    return _turned(image, data) if data[4:12] in _AVIF else image


def _decoded(data: np.ndarray, start: bytes, reduction: int) -> np.ndarray | None:
    """Decode with the flags that OpenCV needs for a format; None if it cannot."""
    is_tiff, is_avif = start[:4] in _TIFF_SIGNATURES, start[4:] in _AVIF
    # With its RGB flag, OpenCV 5.0 mixes up red and blue in 16-bit TIFF and in AVIF with alpha.
    is_bgr = is_tiff or is_avif
    flags = (cv2.IMREAD_COLOR if is_bgr else cv2.IMREAD_COLOR_RGB) | reduction
    # AVIF and JPEG 2000 may have 10 or 12 bits, which OpenCV itself converts to 8.
    if is_tiff or start.startswith((_PNG_SIGNATURE, b"P")):
        flags |= cv2.IMREAD_ANYDEPTH
    image = cv2.imdecode(data, flags)
    if image is None and is_tiff:  # floats and 32-bit integers
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim == 2 or not is_bgr:
        return image
    return np.ascontiguousarray(image[..., 2::-1])


def _full_range(image: np.ndarray | None, data: bytes) -> np.ndarray | None:
    """Scale a PNM's values to its full 8 or 16 bits: its header has the value of white (Netpbm)."""
    header = _PNM_HEADER.match(data)
    if image is None or header is None:
        return image
    white, most = int(header[1]), np.iinfo(image.dtype).max
    is_text = data[1] in b"23"  # OpenCV itself scales these in 8 bits
    if not 0 < white < most or (is_text and most == 255):
        return image
    return np.rint(np.minimum(image, white) / white * most).astype(image.dtype)  # as Pillow


def _jpeg_is_whole(data: bytes) -> bool:
    """Return whether a JPEG's segments reach an end-of-image marker; later bytes do not matter.

    Segments are skipped by their length, so the end of a thumbnail inside EXIF does not count.
    """
    # A file cut off after its thumbnail passes too, but has no pixels to decode.
    return data.endswith(b"\xff\xd9") or any(code == 0xD9 for code, _ in _jpeg_segments(data))


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield each marker and the offset of its payload, which begins with its length."""
    position = 2
    while marker := _JPEG_MARKER.search(data, position):
        position = marker.end()
        yield data[position - 1], position
        position += int.from_bytes(data[position : position + 2], "big")


def jpeg_scans(data: bytes) -> int:
    """Count the scans of a JPEG; return 0 for other files."""
    codes = (code for code, _ in _jpeg_segments(data)) if data.startswith(b"\xff\xd8") else ()
    return sum(code == 0xDA for code in itertools.takewhile(0xD9.__ne__, codes))


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
    """Return whether a PNG has a decodable size, and chunks up to IEND with correct checksums.

    Chunks whose name begins with a lower-case letter are not needed for the pixels.
    """
    position = len(_PNG_SIGNATURE)
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        kind = data[position + 4 : position + 8]
        end = position + 8 + length
        if kind[:1].isupper() and zlib.crc32(data[position + 4 : end]) != int.from_bytes(
            data[end : end + 4], "big"
        ):
            return False
        position = end + 4
        if kind == b"IEND":
            sides = (int.from_bytes(data[at : at + 4], "big") for at in (16, 20))
            return all(0 < side <= _PNG_SIDE for side in sides)
    return False


def _turned(image: np.ndarray, data: bytes) -> np.ndarray:
    """Rotate and mirror an AVIF as its properties irot and imir say (ISO/IEC 23008-12, 6.5)."""
    for kind, payload in _boxes(data, b"ipco"):
        if kind == b"irot":
            image = np.rot90(image, payload[0] & 3)
        elif kind == b"imir":
            image = image[:, ::-1] if payload[0] & 1 else image[::-1]
    return np.ascontiguousarray(image)


def _boxes(data: bytes, holder: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield the type and content of each box in the first box of type `holder`."""
    place = data.find(holder)
    end = place - 4 + int.from_bytes(data[place - 4 : place], "big")
    at = place + 4
    while place > 0 and at + 8 < end:
        size = int.from_bytes(data[at : at + 4], "big")
        if size < 8:  # up to the end of the file, or a 64-bit size: not a property
            return
        yield data[at + 4 : at + 8], data[at + 8 : at + size]
        at += size


def list_images(folder: str | os.PathLike[str]) -> list[pathlib.Path]:
    """Find the images under `folder`, sorted by their posix paths relative to it.

    The search is recursive and follows links to folders. Files are matched by `IMAGE_SUFFIXES`, in
    upper or lower case. Hidden files and folders (a name that starts with a dot) are left out; a
    warning counts the other files.

    Raises:
        InputError: the folder is missing, is a file, or holds no image.
    """
    folder = pathlib.Path(folder)
    if is_remote(folder):
        return images_below(folder, list_remote(folder), folder)
    check_folder(folder, "a folder of images")
    found = []
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
        found += [here / name for name in files]
    return images_below(folder, found, folder)


def images_below(
    folder: pathlib.Path, files: Iterable[pathlib.Path], source: pathlib.Path
) -> list[pathlib.Path]:
    """Return the images among the files below a folder, without hidden ones, sorted by path.

    Args:
        folder: the folder, local or remote.
        files: the files in it.
        source: prefix of messages, such as the folder.

    Raises:
        InputError: none of them is an image.
    """
    named = {each.relative_to(folder).as_posix(): each for each in files}
    shown = [named[name] for name in sorted(named) if "/." not in f"/{name}"]
    return only_images(shown, address_of(source))


def check_folder(folder: pathlib.Path, expected: str) -> None:
    """Raise InputError unless the folder exists; `expected` is what the message calls it."""
    if not folder.is_dir():
        kind = "a file" if folder.exists() else "nothing"
        raise InputError(f"{folder}: found {kind}, expected {expected}")


def is_image(path: str | os.PathLike[str]) -> bool:
    """Return whether a name has the suffix of a readable image format."""
    return os.fspath(path).lower().endswith(IMAGE_SUFFIXES)


def only_images(
    files: Sequence[pathlib.Path], source: object, *, frames: bool = False
) -> list[pathlib.Path]:
    """Return the images among files, and count the others by suffix in a warning.

    Args:
        files: the files.
        source: prefix of messages, such as their folder.
        frames: whether to return videos and robot logs, which have frames, too.

    Raises:
        InputError: none of them is an image.
    """
    images, others = [], []
    for file in files:
        (images if is_image(file) or (frames and has_frames(file)) else others).append(file)
    # Sidecars of images, such as 1.json or 1.jpg.xmp of 1.jpg, and tables need no warning.
    known = {name for image in images for name in (image, image.with_suffix(""))}
    skipped = collections.Counter(
        sorted(
            file.suffix.lower() or "without a suffix"
            for file in others
            if not known & {file, file.with_suffix("")} and file.suffix != ".csv"
        )
    )
    kinds = ", ".join(f"{count:,} {kind}" for kind, count in skipped.most_common())
    if not images:
        raise InputError(
            f"{source}: found no image{f' among {kinds}' if kinds else ''}, expected files that "
            f"end in {' '.join(IMAGE_SUFFIXES)}"
        )
    if skipped:
        warn(f"{source}: skipped {counted(skipped.total(), 'other file')}: {kinds}")
    return images


def names_in(folder: pathlib.PurePath, images: Sequence[pathlib.PurePath]) -> list[str]:
    """Return the images' posix paths relative to their folder, if each fits in one line of text.

    Raises:
        InputError: a name contains a line break, or bytes that are not UTF-8.
    """
    names = [image.relative_to(folder).as_posix() for image in images]
    check_lines(names, folder)
    return names


def check_lines(names: Sequence[str], source: object) -> None:
    """Check that each name fits in one line of text.

    Args:
        names: the names of images.
        source: prefix of the message, such as their folder.

    Raises:
        InputError: a name contains a line break, or bytes that are not UTF-8.

    Example:
        >>> check_lines(["street/a.jpg"], "images")
    """
    for name in names:
        if len(name.splitlines()) != 1:
            raise InputError(f"{source}: found a line break in the name {name!r}, expected none")
        if not name.isprintable() and any("\ud800" <= letter <= "\udfff" for letter in name):
            raise InputError(f"{source}: found the name {name!r}, expected UTF-8")
