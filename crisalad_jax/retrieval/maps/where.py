"""Conditions on the images of a map that a search is of: their folder, times and positions."""

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
"""Seconds since 1970, of which the first counts and the last does not."""
ALWAYS: Interval = (-math.inf, math.inf)
_KEYS = "folder=, added>=, time>= (or >, <, <=, =) or box="
_CONDITION = re.compile(r"((?:folder|box)\s*(?==)|added|time)\s*([<>]=?|=)\s*(.+)", re.S)
_DAY = 86400.0


@short_repr()
@dataclasses.dataclass(frozen=True)
class Where:
    """Conditions on images of a map; an image counts that meets all of them.

    Example:
        >>> Where.parse("folder=monday, added>=2026-05-01, box=11.5,48.1,11.6,48.2")
        Where(folder='monday', added=(1777593600.0, inf), box=(11.5, 48.1, 11.6, 48.2))
    """

    folder: str = ""
    """Folder, video, or log and its topic, that the names are in, with all below it; with * at the
    end, what the names begin with. Empty is any."""
    added: Interval = ALWAYS
    """When the image was added to the map, as its record says."""
    time: Interval = ALWAYS
    """When the image was taken, where its name says that in seconds since 1970, as those of frames
    of logs do. Images that say no time count with any interval only."""
    box: tuple[float, float, float, float] | None = None
    """West, south, east and north of the position, ends included: in the map's axes, so degrees or
    metres. In degrees the west may be the larger: a box over the antimeridian (RFC 7946, 5.2)."""

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read conditions, with commas between them.

        A day stands for all of it, a time for its second: `added<=2026-05-01` takes what was added
        on that day. Times without a zone are UTC.

        Args:
            text: such as "folder=monday, added>=2026-05-01, time<2026-05-01T12:00,
                box=11.5,48.1,11.6,48.2", of which any may be left out, and times be said twice.

        Raises:
            InputError: another key, no or a second value, or one that is no time or no box.
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
        """What names begin with, one of these; a frame's has # behind its video, log or topic."""
        if self.folder.endswith("*"):
            return (self.folder.removesuffix("*"),)
        folder = self.folder.rstrip("/")
        return f"{folder}/", f"{folder}#"

    def left_out(self, images: "Images", axes: tuple[str, str] | None) -> Removed:
        """Find the rows that do not count: of images that do not meet all conditions, or removed.

        Args:
            images: the map's.
            axes: of their positions; None where they have none.

        Raises:
            InputError: no image counts; a box where there are no positions, or in metres with its
                west larger than its east.
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
                "`crisalad map list` has the map's folders and times"
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
    """Return the times that a comparison with a day or a time takes."""
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
