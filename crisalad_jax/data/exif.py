"""Where a JPEG was taken, by its EXIF data (CIPA DC-008, section 4.6.6: GPS)."""

import contextlib
import math
import os
import pathlib
import warnings
from collections.abc import Iterable
from typing import Any, BinaryIO

from crisalad_jax.data.positions import AXES, Positions

_GPS = 0x8825
_LATITUDE, _LONGITUDE, _STATUS = (1, 2, b"NS"), (3, 4, b"EW"), 9
_VOID = "V"
"""Status of a receiver without a fix."""


def exif_position(path: str | os.PathLike[str] | BinaryIO) -> tuple[float, float] | None:
    """Read latitude and longitude in degrees; None where a file says none that can be right."""
    from PIL import Image

    # EXIF data of any maker may be wrong in any way, and then tells nothing.
    with contextlib.suppress(Exception), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with Image.open(path, formats=("JPEG", "MPO")) as image:
            fields = image.getexif().get_ifd(_GPS)
        if fields.get(_STATUS) == _VOID:
            return None
        latitude, longitude = _degrees(fields, *_LATITUDE), _degrees(fields, *_LONGITUDE)
        # Cameras without a fix write zeros.
        right = abs(latitude) <= 90 and abs(longitude) <= 180 and (latitude, longitude) != (0, 0)
        return (latitude, longitude) if right else None
    return None


def _degrees(fields: dict[int, Any], reference: int, value: int, signs: bytes) -> float:
    """Return degrees of degrees, minutes and seconds; NaN where a fraction is 0 / 0."""
    degrees, minutes, seconds = (float(part) for part in fields[value])
    sign = 1 - 2 * signs.decode().index(fields[reference].strip("\0 ").upper())
    total = sign * (degrees + minutes / 60 + seconds / 3600)
    return total if math.isfinite(total) else math.nan


def exif_positions(images: Iterable[tuple[str, pathlib.Path]]) -> Positions:
    """Read the positions of images that have any.

    Args:
        images: the name and the file of each.
    """
    found = ((name, exif_position(path)) for name, path in images)
    return Positions(AXES[1], {name: position for name, position in found if position is not None})
