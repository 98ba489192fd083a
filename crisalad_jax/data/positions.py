"""Read where images were taken: from @UTM names, a table, or EXIF data (CIPA DC-008, 4.6.6)."""

import contextlib
import os
import pathlib
import warnings
from collections.abc import Iterable, Sequence
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.frames import moment_of
from crisalad_jax.data.metres import Zone
from crisalad_jax.data.remote import for_each, is_remote, open_beginning
from crisalad_jax.data.tables import AXES as AXES
from crisalad_jax.data.tables import MOST_METRES as MOST_METRES
from crisalad_jax.data.tables import matched, number_of, read_table
from crisalad_jax.data.tracks import Track, is_track, read_track, time_of, utc
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.shapes import Float64

_BANDS = "CDEFGHJKLMNPQRSTUVWX"
"""Letters of UTM's bands of latitude, from south to north; N is the first of the north."""
_BAND_S = (3.4e6, 4.6e6)
"""Northings of band S, 32 to 40 degrees, with a margin; elsewhere S means south."""
_NEAR = 9.0
"""Degrees from a zone's central meridian, neighbouring zones included, within which distances in
its plane are correct to about one percent."""


@brief
class Positions(NamedTuple):
    """Positions by image name, in `axes` (one of `AXES`); images without a position are absent."""

    axes: tuple[str, str]
    of: dict[str, tuple[float, float]]
    zone: Zone | None = None
    """UTM zone of east and north; None if unknown, and for other axes."""

    def check(self) -> None:
        """Raise InputError if the axes are unknown, or a position is not two numbers in range."""
        if self.axes not in AXES:
            raise InputError(f"positions: found axes {self.axes}, expected one of {AXES}")
        for name, at in self.of.items():
            is_pair = isinstance(at, Sequence) and len(at) == 2
            if not is_pair or not all(isinstance(x, int | float) for x in at):
                raise InputError(f"{name}: found position {at!r}, expected two Python numbers")
            if not all(abs(each) <= MOST_METRES for each in at):
                raise InputError(
                    f"{name}: found position {at}, expected numbers of at most {MOST_METRES:g}"
                )

    def fitted(
        self, source: object, axes: tuple[str, str] | None, zone: Zone | None
    ) -> "Positions":
        """Return the positions in the axes and zone of a map.

        Degrees, and metres of another zone, become metres of the map's zone, or degrees for a map
        in degrees. Results are rounded to a tenth of a millimetre.

        Args:
            source: the map, for messages.
            axes: the map's axes; None if it has no position yet.
            zone: the map's zone; None if unknown.

        Raises:
            InputError: the positions do not pass `check`; the axes differ and the zone is unknown;
                or a position is far from the map's zone.
        """
        self.check()
        metres, degrees, _ = AXES
        if axes in (None, self.axes) and (
            axes != metres or zone == self.zone or None in (zone, self.zone)
        ):
            return self
        known = self.axes == degrees or self.zone is not None
        if not known or (axes != degrees and (axes != metres or zone is None)):
            raise InputError(
                f"{source}: found positions in {', '.join(self.axes)}, expected "
                f"{', '.join(axes or ())} as in the map"
            )
        points = np.array(list(self.of.values()), np.float64).reshape(-1, 2).T
        latitude, longitude = points if self.zone is None else self.zone.to_degrees(*points)
        if zone is None:
            fitted = np.round([latitude, longitude], 9)
        else:
            away = np.abs((longitude - zone.central + 180) % 360 - 180)
            if (away > _NEAR).any():
                name = list(self.of)[int(away.argmax())]
                raise InputError(
                    f"{source}: found {name!r} {away.max():.3g} degrees of longitude from the "
                    f"middle of zone {zone}, whose metres the map has, expected at most {_NEAR:g}; "
                    "a new map of all images can use lat, lon"
                )
            fitted = np.round(zone.to_metres(latitude, longitude), 4)
        of = dict(zip(self.of, map(tuple, fitted.T.tolist()), strict=True))
        return Positions(axes or metres, of, zone)


def utm_position(name: str) -> tuple[float, float] | None:
    """Read east and north in metres from a name `@UTM_east@UTM_north@...`; None for other names."""
    _, east, north, *_ = [*name.split("@"), "", ""]
    metres = number_of(east), number_of(north)
    return metres if all(abs(each) <= MOST_METRES for each in metres) else None


def utm_zones(names: Sequence[str]) -> list[Zone | None]:
    """Read the zone of each `@UTM_east@UTM_north@zone@letter@...` name.

    The letter is that of the band of latitude, or else N or S for the hemisphere. If all names with
    a zone agree, all images get that zone; None if no name has one.

    Args:
        names: names or paths of images with a `utm_position`.

    Raises:
        InputError: the names have several zones or hemispheres, and one name has none.
    """
    zones = [_zone_of(name.rpartition("/")[2]) for name in names]
    known = set(zones) - {None}
    if len(known) <= 1:
        return [next(iter(known), None)] * len(zones)
    if None in zones:
        raise InputError(
            f"{names[zones.index(None)]}: found no zone with a letter, expected "
            "@east@north@zone@letter@...: the images are of several zones of UTM (evaluate "
            "--ignore-zones takes them as one)"
        )
    return zones


def _zone_of(name: str) -> Zone | None:
    _, _, north, number, letter, *_ = [*name.split("@"), *[""] * 5]
    letter = letter.upper()
    is_number = number.isdecimal() and len(number) <= 3
    if not (is_number and 1 <= int(number) <= 60 and letter and letter in _BANDS):
        return None
    south = letter < "N"
    if letter == "S":
        south = not _BAND_S[0] <= float(north) <= _BAND_S[1]
    return Zone(int(number), south)


def utm_degrees(
    names: Sequence[str], zones: Sequence[Zone | None], metres: Float64[np.ndarray, "image 2"]
) -> Float64[np.ndarray, "image 2"]:
    """Convert east and north in metres to latitude and longitude, each image in its `zones`.

    Raises:
        InputError: metres are out of UTM's range.
    """
    degrees = np.empty_like(metres)
    off = (np.abs(metres - [5e5, 5e6]) > [1e6, 5.1e6]).any(axis=1)
    if off.any():
        first = int(off.argmax())
        raise InputError(f"{names[first]}: found {metres[first].tolist()}, expected metres of UTM")
    for zone in set(zones):
        assert zone is not None
        of = [number for number, each in enumerate(zones) if each == zone]
        degrees[of] = np.stack(zone.to_degrees(*metres[of].T), axis=1)
    return degrees


def utm_positions(names: Sequence[str]) -> Positions:
    """Read the positions of the images with names `@UTM_east@UTM_north@zone@letter@...`.

    Positions are east and north in metres or, if there are several zones, degrees.

    Raises:
        InputError: there are several zones, and a name has no zone or has metres out of range.
    """
    found = ((name, utm_position(name.rpartition("/")[2])) for name in names)
    of = {name: position for name, position in found if position is not None}
    there = list(of)
    zones = utm_zones(there)
    if len(set(zones)) <= 1:
        return Positions(AXES[0], of, zones[0] if zones else None)
    degrees = np.round(utm_degrees(there, zones, np.array(list(of.values()), np.float64)), 9)
    return Positions(AXES[1], dict(zip(there, map(tuple, degrees.tolist()), strict=True)))


def positions_of(
    given: Positions | Track | str | os.PathLike[str],
    names: Sequence[str],
    paths: Sequence[pathlib.Path],
    images: str | os.PathLike[str],
) -> Positions:
    """Return given positions, or those of a file, under the names that images have on disk.

    Args:
        given: positions by name, or a table file with a position in every row (those of other
            images are returned too); or positions by time: a track or its file (`read_track`).
        names: names of the images.
        paths: the files of the images, in the order of `names`.
        images: folder of the images, for messages.

    Raises:
        InputError: none of the images is in the table, or was taken along the track; or the table
            or track is not valid.
    """
    if not isinstance(given, Positions | Track) and is_track(given):
        given = read_track(given)
    if isinstance(given, Track):
        return _along(given, names, paths, images)
    if isinstance(given, Positions):
        source, positions = "positions", given
    else:
        source, (_, positions) = given, read_image_table(given, all_positions=True)
        assert positions is not None
    meant = matched(positions.of, frozenset(names))
    if not meant:
        raise InputError(
            f"{source}: found none of the {len(names)} images of {images}, expected names such as "
            f"{names[0]!r}"
        )
    return positions._replace(of={meant.get(name, name): at for name, at in positions.of.items()})


def _along(
    track: Track,
    names: Sequence[str],
    paths: Sequence[pathlib.Path],
    images: str | os.PathLike[str],
) -> Positions:
    """Interpolate the positions of images along a track; a warning counts those with one.

    Raises:
        InputError: none was taken between the track's ends; or what `_times` raises.
    """
    times, local = _times(paths, track.start_time, images)
    times += track.time_offset
    points, gaps = track.interpolate(times)
    (there,), (timed,) = np.isfinite(points[:, 0]).nonzero(), np.isfinite(times).nonzero()
    ends = f"{utc(track.times[0])} to {utc(track.times[-1])}"
    if not len(there):
        first, last = utc(times[timed].min()), utc(times[timed].max())
        raise InputError(
            f"{track.source}: found a track from {ends}, expected the times of the {len(timed)} "
            f"images of {images} that have one, {first} to {last} (--time-offset shifts them)"
        )
    at = int(there[gaps[there].argmax()])
    words = [f"{len(there)} of {len(names)} images on the track, {ends}"]
    if len(timed) > len(there):
        words.append(f"{len(timed) - len(there)} were taken before or after it")
    if len(names) > len(timed):
        words.append(f"{len(names) - len(timed)} have no time")
    if gaps[at]:
        before = track.times[track.times < times[at]].max()
        between = f"{utc(before)} and {utc(before + gaps[at])}"
        words.append(f"the largest gap is {gaps[at]:.3g} s, between {between}")
    if local:
        words.append(f"the times of {local} are taken as UTC (--time-offset)")
    warn(f"{track.source}: {'; '.join(words)}")
    of = {names[i]: (float(points[i, 0]), float(points[i, 1])) for i in there.tolist()}
    return Positions(track.axes, of)


def _times(
    paths: Sequence[pathlib.Path], start: float | None, images: str | os.PathLike[str]
) -> tuple[Float64[np.ndarray, " image"], int]:
    """Read when images were taken: a time in the name, or else in EXIF data.

    Returns:
        Seconds since 1970, NaN if unknown; and how many are local times of an unknown zone.

    Raises:
        InputError: frames of a video without a start, or of several videos; or no image has a time.
    """
    times, local = np.full(len(paths), np.nan), 0
    moments = [moment_of(path) for path in paths]
    unnamed = [number for number, moment in enumerate(moments) if moment is None]
    taken = for_each(exif_time, [paths[number] for number in unnamed])
    for number, found in zip(unnamed, taken, strict=True):
        times[number], has_zone = found or (np.nan, True)
        local += not has_zone
    for number, moment in enumerate(moments):
        if moment is not None:
            times[number] = moment.seconds + ((start or 0) if moment.clock else 0)
    clocks = {moment.clock for moment in moments if moment is not None and moment.clock}
    if len(clocks) > 1 or (clocks and start is None):
        raise InputError(
            f"{images}: found frames of {', '.join(sorted(clocks)[:2])}, expected those of one "
            "video, and when it began (--start-time 2026-05-01T12:00:00+02:00)"
        )
    if np.isnan(times).all():
        raise InputError(
            f"{images}: found no time of {len(paths)} images, expected EXIF data, or names of "
            "seconds since 1970"
        )
    return times, local


def read_image_table(
    path: str | os.PathLike[str], *, all_positions: bool = False
) -> tuple[list[str], Positions | None]:
    """Read a table with a column `name`, and optionally positions: east,north or lat,lon or x,y.

    Columns may be in capitals, or have other usual names, such as filename and latitude. Decimals
    may have commas if semicolons separate the fields. x and y count only if there is neither of the
    other pairs. A row whose two coordinates are both empty has no position. Other columns are
    ignored.

    Args:
        path: the file.
        all_positions: whether every row must have a position.

    Returns:
        The images' names in the table's order, and their positions; None without such columns.

    Raises:
        InputError: the file cannot be read; a column is missing or ambiguous; a name is missing or
            repeated; or a value is not a finite number, latitude or longitude.
    """
    table = read_table(pathlib.Path(path), "name", any_spelling=True)
    axes = table.axes("name", must=all_positions)
    rows = list(table.named_rows())
    positions = None
    if axes is not None:
        of = {
            name: (row.number(axes[0]), row.number(axes[1]))
            for name, row in rows
            if all_positions or any(row.fields[axis] for axis in axes)
        }
        positions = Positions(axes, of)
    return [name for name, _ in rows], positions


_GPS, _EXIF = 0x8825, 0x8769
_LATITUDE, _LONGITUDE, _STATUS = (1, 2, b"NS"), (3, 4, b"EW"), 9
_VOID = "V"
"""Status of a receiver without a fix."""
_TAKEN, _ZONE, _DECIMALS = 0x9003, 0x9011, 0x9291
"""DateTimeOriginal, OffsetTimeOriginal, SubSecTimeOriginal."""


def _exif(path: str | os.PathLike[str] | BinaryIO, group: int) -> dict[int, Any]:
    from PIL import Image

    if isinstance(path, str | os.PathLike) and is_remote(path):
        with open_beginning(path) as file:
            return _exif(file, group)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with Image.open(path, formats=("JPEG", "MPO")) as image:
            return image.getexif().get_ifd(group)


def exif_position(path: str | os.PathLike[str] | BinaryIO) -> tuple[float, float] | None:
    """Read a JPEG's latitude and longitude in degrees; None if it has none that are valid."""
    # EXIF data of any maker may be wrong in any way, and is then ignored.
    with contextlib.suppress(Exception):
        fields = _exif(path, _GPS)
        if fields.get(_STATUS) == _VOID:
            return None
        latitude, longitude = _degrees(fields, *_LATITUDE), _degrees(fields, *_LONGITUDE)
        # Cameras without a fix write zeros.
        right = abs(latitude) <= 90 and abs(longitude) <= 180 and (latitude, longitude) != (0, 0)
        return (latitude, longitude) if right else None
    return None


def exif_time(path: str | os.PathLike[str] | BinaryIO) -> tuple[float, bool] | None:
    """Read when a JPEG was taken.

    Returns:
        Seconds since 1970, and whether the time zone is known; if not, the time is taken as UTC.
        None if the file has no valid time.
    """
    with contextlib.suppress(Exception):
        fields = _exif(path, _EXIF)
        day, time = fields[_TAKEN].strip("\0 ").split(" ")
        zone = fields.get(_ZONE, "").strip("\0 ")
        text = f"{day.replace(':', '-')} {time}.{fields.get(_DECIMALS, '').strip(chr(0) + ' ')}"
        return time_of(f"{text.rstrip('.')}{zone}"), bool(zone)
    return None


def _degrees(fields: dict[int, Any], reference: int, value: int, signs: bytes) -> float:
    """Convert degrees, minutes and seconds to degrees; NaN if a fraction is 0 / 0."""
    degrees, minutes, seconds = (float(part) for part in fields[value])
    sign = 1 - 2 * signs.decode().index(fields[reference].strip("\0 ").upper())
    return sign * (degrees + minutes / 60 + seconds / 3600)


def exif_positions(images: Iterable[tuple[str, pathlib.Path]]) -> Positions:
    """Read the positions in the EXIF data of images; images without a position are absent.

    Args:
        images: name and file of each image.
    """
    each = list(images)
    found = for_each(exif_position, [path for _, path in each])
    of = {name: position for (name, _), position in zip(each, found, strict=True) if position}
    return Positions(AXES[1], of)
