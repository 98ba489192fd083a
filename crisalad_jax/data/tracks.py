"""Read tracks (positions over time): GPX 1.1 (Topografix), GeoJSON (RFC 7946) or a table.

RFC 7946 defines no times. They are read from the properties that togeojson writes: `coordTimes` or
`times` of a line, `time` or `timestamp` of a point.
"""

import contextlib
import datetime
import math
import os
import pathlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.tables import AXES, number_of, read_table
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import LARGEST_TEXT, parse_json, read_bytes, read_text
from crisalad_jax.utils.shapes import Float64

_DEGREES = AXES[1]
_GEOJSON = (".geojson", ".json")
_Point = tuple[object, Any, Any]
"""Time, and latitude and longitude or metres."""


@brief
class Track(NamedTuple):
    """Positions over time: `points[i]` has the two coordinates at `times[i]`."""

    source: str
    """The file, for messages."""
    axes: tuple[str, str]
    """Names of the two coordinates, one of `tables.AXES`."""
    times: Float64[np.ndarray, " point"]
    """Seconds since 1970, ascending."""
    points: Float64[np.ndarray, "point 2"]
    start_time: float | None = None
    """Start of the video that the images come from, in seconds since 1970; None if unknown."""
    time_offset: float = 0.0
    """Seconds that are added to the times of images."""

    def interpolate(
        self, times: Float64[np.ndarray, " image"]
    ) -> tuple[Float64[np.ndarray, "image 2"], Float64[np.ndarray, " image"]]:
        """Interpolate positions linearly in time between the track's points.

        Args:
            times: times in seconds since 1970.

        Returns:
            The positions, NaN before the first point and after the last one; and for each position
            the seconds between the two track points around it, 0 at a point or outside the track.

        Example:
            >>> import numpy as np
            >>> track = Track("a", ("x", "y"), np.array([0.0, 4.0]), np.array([[0.0, 0], [8, 4]]))
            >>> [each.tolist() for each in track.interpolate(np.array([1.0, 4.0]))]
            [[[2.0, 1.0], [8.0, 4.0]], [4.0, 0.0]]
        """
        first, second = self.points.T
        if self.axes == _DEGREES:
            second = np.unwrap(second, period=360)
        found = [
            np.interp(times, self.times, axis, left=math.nan, right=math.nan)
            for axis in (first, second)
        ]
        if self.axes == _DEGREES:
            found[1] = np.round((found[1] + 180) % 360 - 180, 9)
        last = len(self.times) - 1
        before = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, last)
        after = np.clip(np.searchsorted(self.times, times, side="left"), 0, last)
        return np.stack(found, axis=1), np.maximum(self.times[after] - self.times[before], 0)


def is_track(path: str | os.PathLike[str]) -> bool:
    """Return whether a file lists positions by time rather than by the names of images.

    Raises:
        InputError: the file is a table, and cannot be read.
    """
    path = pathlib.Path(path)
    if path.suffix.lower() in (".gpx", *_GEOJSON):
        return True
    columns = read_table(path, any_spelling=True).columns
    return "time" in columns and "name" not in columns


def read_track(
    path: str | os.PathLike[str], *, start_time: str | None = None, time_offset: float = 0.0
) -> Track:
    """Read a track: GPX, GeoJSON, or a table with a column `time` and positions.

    Times are ISO 8601, in UTC if they have no zone, or numbers since 1970: seconds, milliseconds,
    microseconds or nanoseconds, which are distinguished by their size.

    Args:
        path: the file. A .gpx has track points with times. A .geojson or .json has lines with
            `coordTimes` or `times`, or points with `time`. A table has the columns time and
            lat,lon or east,north or x,y, or other usual names of these.
        start_time: when the images' video starts, with its time zone: "2026-05-01T12:00:00+02:00".
        time_offset: seconds that are added to the times of images, for cameras whose clock is wrong
            or shows local time: -7200 if it is two hours ahead of UTC.

    Returns:
        The track, which `index` takes as `positions`.

    Raises:
        InputError: the file cannot be read or has no points; a point has no time or is not in
            range; times go back; `start_time` has no zone; or `time_offset` is not finite.

    Example:
        >>> text = "time,lat,lon\\n2026-05-01T10:00:00Z,52.2,21.0\\n2026-05-01T10:00:10Z,52.3,21.0"
        >>> _ = (folder / "walk.csv").write_text(text)
        >>> read_track(folder / "walk.csv").times.tolist()
        [1777629600.0, 1777629610.0]
    """
    if not math.isfinite(time_offset):
        raise InputError(f"--time-offset: found {time_offset}, expected seconds")
    start = None if start_time is None else _start_of(start_time)
    path = pathlib.Path(path)
    suffix = path.suffix.lower()
    if suffix == ".gpx":
        axes, found = _DEGREES, list(_gpx_points(path))
    elif suffix in _GEOJSON:
        axes, found = _DEGREES, _geojson_points(path)
    else:
        axes, found = _table_points(path)
    without = sum(time is None for time, _, _ in found)
    if without or not found:
        points = f"{without} of {len(found)} points without a time" if found else "no point"
        raise InputError(f"{path}: found {points}, expected track points with times")
    times = np.array([_time_in(path, time) for time, _, _ in found])
    numbers = [point for _, *point in found]
    points = _as_degrees(path, numbers) if axes == _DEGREES else np.array(numbers)
    if (back := np.diff(times) < 0).any():
        at = int(back.argmax())
        raise InputError(
            f"{path}: found point {at + 2} at {utc(times[at + 1])}, after one at {utc(times[at])}, "
            "expected times in order"
        )
    return Track(str(path), axes, times, points, start, float(time_offset))


def utc(seconds: Any) -> str:
    """Format a time in seconds since 1970 as ISO 8601 in UTC, for a message.

    Example:
        >>> utc(1777629600.25)
        '2026-05-01T10:00:00.250Z'
    """
    return f"{np.datetime64(round(1000 * seconds), 'ms')}".removesuffix(".000") + "Z"


def time_of(text: str) -> float:
    """Convert a time in ISO 8601, taken as UTC if it has no zone, to seconds since 1970.

    Raises:
        ValueError: the text is not a time.
    """
    time = datetime.datetime.fromisoformat(text)
    return (time if time.tzinfo else time.replace(tzinfo=datetime.UTC)).timestamp()


def _start_of(text: str) -> float:
    with contextlib.suppress(ValueError, TypeError):
        start = datetime.datetime.fromisoformat(text)
        if start.tzinfo is not None:
            return start.timestamp()
    raise InputError(
        f"--start-time: found {text!r}, expected a time and its zone: 2026-05-01T12:00:00+02:00"
    )


def _time_in(path: pathlib.Path, time: object) -> float:
    """Convert ISO 8601 or a number to seconds since 1970."""
    number = number_of(str(time))
    if abs(number) < 1e20:
        # In these years, nanoseconds are about 1e18 and seconds about 1e9.
        return number / 1000 ** sum(number >= most for most in (1e11, 1e14, 1e17))
    try:
        return time_of(str(time))
    except ValueError as error:
        raise InputError(
            f"{path}: found time {time!r}, expected one such as 2026-05-01T12:00:00Z"
        ) from error


def _as_degrees(
    path: pathlib.Path, points: Sequence[Sequence[Any]]
) -> Float64[np.ndarray, "point 2"]:
    try:
        degrees = np.array(points, np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{path}: found a point that is not two numbers ({error})") from error
    right = (np.abs(degrees) <= [90, 180]).all(axis=1)
    if not right.all():
        at = int(right.argmin())
        raise InputError(
            f"{path}: found {degrees[at].tolist()} as point {at + 1}, expected a latitude and a "
            "longitude in degrees"
        )
    return degrees


class _Builder(ElementTree.TreeBuilder):
    """A builder of XML trees without custom entities, which can expand to fill any memory."""

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        """Refuse a document type, which GPX does not have."""
        raise ValueError("a document type (DOCTYPE)")


def _gpx_points(path: pathlib.Path) -> Iterator[_Point]:
    """Yield the points of all tracks, in the file's order."""
    data = read_bytes(path, "a track in GPX", largest=LARGEST_TEXT)
    try:
        root = ElementTree.fromstring(data, ElementTree.XMLParser(target=_Builder()))
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(f"{path}: found {error}, expected a track in GPX") from error
    for point in root.iterfind(".//{*}trkpt"):
        yield point.findtext("{*}time"), point.get("lat"), point.get("lon")


def _geojson_points(path: pathlib.Path) -> list[_Point]:
    """Return the points of lines and of point features; if any have times, only those that do."""
    expected = "GeoJSON of lines with coordTimes, or of points with time"
    value = parse_json(read_text(path, expected), str(path), expected)
    found: list[_Point] = []
    try:
        features = value["features"] if value["type"] == "FeatureCollection" else [value]
        for feature in features:
            geometry, of = feature["geometry"], feature["properties"] or {}
            of = {**of, **of.get("coordinateProperties", {})}
            if geometry["type"] == "Point":
                lines, times = [[geometry["coordinates"]]], [[of.get("time", of.get("timestamp"))]]
            elif geometry["type"] in ("LineString", "MultiLineString"):
                lines, times = geometry["coordinates"], of.get("coordTimes", of.get("times"))
                if geometry["type"] == "LineString":
                    lines, times = [lines], times and [times]
            else:
                continue
            for number, line in enumerate(lines):
                pairs = zip(times[number] if times else [None] * len(line), line, strict=True)
                found += [(time, at[1], at[0]) for time, at in pairs]
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: found other JSON ({error!r}), expected {expected}") from error
    return [point for point in found if point[0] is not None] or found


def _table_points(path: pathlib.Path) -> tuple[tuple[str, str], list[_Point]]:
    table = read_table(path, "time", any_spelling=True)
    axes = table.axes("time", must=True)
    assert axes is not None
    first, second = axes
    rows = table.rows()
    return axes, [(row.text("time"), row.number(first), row.number(second)) for row in rows]
