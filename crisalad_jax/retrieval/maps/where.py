"""Conditions on a map's images, to search only some: by folder, time and position."""

import dataclasses
import datetime
import math
import re
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from crisalad_jax.config.short_repr import short_repr
from crisalad_jax.data.positions import AXES
from crisalad_jax.data.tables import number_of
from crisalad_jax.data.tracks import time_of
from crisalad_jax.retrieval.maps.removed import Removed
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Bool

if TYPE_CHECKING:
    from crisalad_jax.retrieval.maps.images import Images

Interval = tuple[float, float]
"""Start (included) and end (excluded) in seconds since 1970, UTC."""
ALWAYS: Interval = (-math.inf, math.inf)
_KEYS = "folder=, added>=, time>= (or >, <, <=, =) or box="
_CONDITION = re.compile(r"((?:folder|box)\s*(?==)|added|time)\s*([<>]=?|=)\s*(.+)", re.S)
_DAY = 86400.0


@short_repr()
@dataclasses.dataclass(frozen=True)
class Where:
    """Conditions on the images of a map; only images that meet all of them are searched.

    Example:
        >>> Where.parse("folder=monday, added>=2026-05-01, box=11.5,48.1,11.6,48.2")
        Where(folder='monday', added=(1777593600.0, inf), box=(11.5, 48.1, 11.6, 48.2))
    """

    folder: str = ""
    """What contains the image, at any depth: a folder, a video, a log, or a log's topic as in
    walk.bag#/camera. With * at the end, a prefix of the image's name. Empty matches all images."""
    added: Interval = ALWAYS
    """When the image was added to the map. Images without a recorded time meet only the default."""
    time: Interval = ALWAYS
    """When the image was taken, if its name says so in seconds since 1970, as names of log frames
    do. Images without such a time meet only the default."""
    box: tuple[float, float, float, float] | None = None
    """Bounds of the position, inclusive: west, south, east and north, in the map's axes (degrees or
    metres). In degrees, west may exceed east: a box across the antimeridian (RFC 7946, 5.2)."""

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse conditions that are separated by commas.

        A date is the whole day, a time the whole second: `added<=2026-05-01` includes images that
        were added on that day. Times without a zone are UTC.

        Args:
            text: such as "folder=monday, added>=2026-05-01, time<2026-05-01T12:00,
                box=11.5,48.1,11.6,48.2". Each key is optional; a time may have two bounds.

        Raises:
            InputError: a key is unknown, `folder` or `box` is repeated, or a value does not parse.
        """
        found: dict[str, Any] = {}
        for part in re.split(r",(?=\s*\w+\s*[<>=])", text):
            match = _CONDITION.fullmatch(part.strip())
            if match is None:
                raise InputError(f"where: found {part.strip()!r}, expected {_KEYS}")
            key, sign, value = (each.strip() for each in match.groups())
            if key in ("added", "time"):
                found[key] = _overlap(found.get(key, ALWAYS), _interval(sign, value))
            elif key in found:
                raise InputError(f"where: found {key} twice, expected it once")
            else:
                found[key] = value if key == "folder" else _box(value)
        return cls(**found)

    @property
    def prefixes(self) -> tuple[str, ...]:
        """Prefixes of matching names; in a frame's name, # follows the video, log or topic."""
        if self.folder.endswith("*"):
            return (self.folder.removesuffix("*"),)
        folder = self.folder.rstrip("/")
        return f"{folder}/", f"{folder}#"

    def left_out(self, images: "Images", axes: tuple[str, str] | None) -> Removed:
        """Find the rows that a search skips: of removed images, and of those that fail a condition.

        Args:
            images: the map's images.
            axes: axes of the images' positions (`positions.AXES`); None without positions.

        Raises:
            InputError: no image is left; a box is given, but the map has no positions; or the west
                of a box in metres is larger than its east.
        """
        masks: dict[str, Bool[np.ndarray, " row"]] = {}
        if self.folder:
            masks["folder"] = images.begin_with(self.prefixes)
        if self.added != ALWAYS:
            masks["added"] = _within(images.added, self.added)
        if self.time != ALWAYS:
            masks["time"] = _within(images.taken, self.time)
        if self.box is not None:
            masks["box"] = self._in_box(images, axes)
        out = images.left_out(np.logical_and.reduce([np.ones(images.rows, bool), *masks.values()]))
        if len(out.rows) == images.rows:
            left = {name: images.rows - len(images.left_out(masks[name]).rows) for name in masks}
            counts = ", ".join(f"{count} by {name}" for name, count in left.items())
            raise InputError(
                f"where: found none of {len(images)} images ({counts}), expected at least one; "
                "`crisalad map list` shows the map's folders and times"
            )
        as_added = self.box is None or not images.has_moved
        return out._replace(asked=(self, images.removed.rows)) if as_added else out

    def _in_box(self, images: "Images", axes: tuple[str, str] | None) -> Bool[np.ndarray, " row"]:
        assert self.box is not None
        west, south, east, north = self.box
        if axes is None:
            raise InputError(
                "where: found a box, expected none: no image of the map has a position"
            )
        x, y = images.positions.T[:: -1 if axes == AXES[1] else 1]
        if west <= east:
            is_between = (x >= west) & (x <= east)
        elif axes == AXES[1]:
            is_between = (x >= west) | (x <= east)
        else:
            raise InputError(f"where: found box {self.box} of {axes[0]}, expected west <= east")
        return is_between & (y >= south) & (y <= north)


def _interval(sign: str, text: str) -> Interval:
    """Return the interval of times that a comparison with a day or a time accepts."""
    try:
        try:
            start = time_of(datetime.date.fromisoformat(text).isoformat())
            end = start + _DAY
        except ValueError:
            start = time_of(text)
            end = start + 1
    except (ValueError, OverflowError) as error:
        raise InputError(
            f"where: found time {text!r}, expected a day such as 2026-05-01, or a time such as "
            "2026-05-01T12:00"
        ) from error
    first = {">=": start, "=": start, ">": end}.get(sign, -math.inf)
    return first, {"<": start, "=": end, "<=": end}.get(sign, math.inf)


def _within(times: np.ndarray, interval: Interval) -> Bool[np.ndarray, " row"]:
    return (times >= interval[0]) & (times < interval[1])  # NaN is in none


def _overlap(one: Interval, other: Interval) -> Interval:
    return max(one[0], other[0]), min(one[1], other[1])


def _box(text: str) -> tuple[float, ...]:
    numbers = tuple(number_of(each.strip()) for each in text.split(","))
    if len(numbers) != 4 or not all(map(math.isfinite, numbers)) or numbers[1] > numbers[3]:
        raise InputError(
            f"where: found box {text!r}, expected four numbers, west,south,east,north, with "
            "south <= north"
        )
    return numbers
