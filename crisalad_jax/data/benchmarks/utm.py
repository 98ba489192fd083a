"""Read sets with `@UTM` file names, as VPR-datasets-downloader and related tools write them.

The fields of a name, between @: east, north, zone number, zone letter, latitude, longitude,
panorama, tile, heading, pitch, roll, height, time, note, suffix. Unused fields are empty.
"""

import os
import pathlib
import re
from collections.abc import Sequence

import numpy as np

from crisalad_jax.data.benchmarks.benchmark import DEFAULT_RADIUS, Benchmark, within
from crisalad_jax.data.benchmarks.msls import msls_title
from crisalad_jax.data.benchmarks.on_disk import find_database, find_split, list_part, shown
from crisalad_jax.data.metres import Zone, on_ellipsoid
from crisalad_jax.data.positions import utm_degrees, utm_position, utm_zones
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import counted
from crisalad_jax.utils.shapes import Float64, Int64

QUERIES = "queries"
"""Default name of the folder of the queries."""
_PLACE_METRES = 1000.0
_PAIRED = {607: "SPED", 1231: "AmsterTime"}
"""Sets whose places have one image on each side, and no coordinates, by their number of places."""
_NORDLANDS = {
    25 / 10.5: "Nordland, Patch-NetVLAD split (summer database, winter queries)",
    25 / 1.5: "Nordland subset of VPR-datasets-downloader (summer database, winter queries)",
}
"""Versions of Nordland by the metres between two frames."""
# Names have one decimal, truncated.
_NAME_METRES = 0.1
_Points = Float64[np.ndarray, "images axis"]
_MSLS_NOTE = re.compile(r"(?:day|night)_[a-z]+_([a-z]+)")


def read_utm(
    root: str | os.PathLike[str],
    split: str | None = None,
    radius: float = DEFAULT_RADIUS,
    *,
    queries: str = QUERIES,
    ignore_zones: bool = False,
) -> Benchmark:
    """Read images named `@UTM_east@UTM_north@zone@letter@...`; positives are within `radius`.

    Distances between images of one UTM zone and hemisphere are those in the zone's plane; other
    distances are those on the ground.

    VPR-datasets-downloader writes placeholder coordinates for Nordland (easting 0, frames
    a few metres apart), SPED and AmsterTime (easting 0, places 1 km apart). The name and the rule
    of the result then say what these stand for. MSLS is recognised by the notes in the file names.

    Args:
        root: a folder with `images/{test,val,train}`, or one that itself holds `database/` and
            `queries/`; SVOX's database is in `gallery/`.
        split: the folder in `images/`; None takes `test` or, if there is no `test`, `val`.
        radius: radius of positives in metres, inclusive.
        queries: name of the folder of the queries, which must begin with `queries`, as SVOX's
            `queries_night` does. The name of the result includes it, unless it is `queries`.
        ignore_zones: whether to compare coordinates of all zones as if in one plane, as the public
            tools do. The name of the result then says so.

    Raises:
        InputError: the split or a folder is missing or has no images; a name lacks coordinates or,
            in a set of several zones, a zone; `queries` begins otherwise; or `radius` is negative.
    """
    root = pathlib.Path(root)
    if not queries.startswith(QUERIES):
        raise InputError(f"queries: found {queries!r}, expected the name of a folder {QUERIES}...")
    folder, name = find_split(root, split)
    database, asking = list_part(find_database(folder)), list_part(folder / queries)
    places, asked = _coordinates(database), _coordinates(asking)
    which = "" if queries == QUERIES else f", {queries}"

    nordland = _nordland(places, asked)
    if nordland is not None:
        metres, there, here = nordland
        # Count in whole frames: the names' truncated decimals would make the radius inexact.
        frames = float(np.floor(radius / metres + 1e-9))
        positives = within(there, here, frames)
        apart = counted(int(frames), "frame")
        name = f"{_NORDLANDS[metres]}{which}, +-{apart}"
        rule = (
            f"at most {apart} apart ({radius:g} m); identified as Nordland by eastings of 0 "
            f"and northings of {metres:.4g} m a frame"
        )
        return Benchmark(name, root, database, asking, positives, rule)

    if radius < _PLACE_METRES and _are_placeholders(places, asked):
        known = _PAIRED.get(len(database)) if len(database) == len(asking) else None
        name = f"{known or name}{which} (@UTM placeholders 1 km apart: a place matches itself only)"
        rule = (
            "the same place; the coordinates, eastings of 0 and northings of whole kilometres, are "
            "placeholders"
        )
        if known:
            rule += f"; identified by its {len(database)} places as {known}"
        return Benchmark(name, root, database, asking, within(places, asked, radius), rule)

    rule = f"UTM distance of at most {radius:g} m"
    paths = [str(path) for path in (*database, *asking)]
    zones = [] if ignore_zones else utm_zones(paths)
    if len(set(zones)) > 1:
        positives, places, asked = _across_zones(paths, zones, places, asked, radius)
        rule += f"; between zones {shown(set(map(str, zones)))} the distance on the ground"
    else:
        positives = within(places, asked, radius)
    ending = f"{radius:g} m{', zones ignored' * ignore_zones}"
    cities = _msls_cities(database + asking)
    if cities is None:
        name = f"{name}{which} (@UTM, {ending})"
    else:
        name = f"{msls_title(cities)}{which}, downloader style, {len(asking)} queries, {ending}"
        rule += f"; identified by the notes in the names as MSLS of {', '.join(sorted(cities))}"
    return Benchmark(name, root, database, asking, positives, rule, places, asked, radius)


def _across_zones(
    names: Sequence[str],
    zones: Sequence[Zone | None],
    places: _Points,
    asked: _Points,
    radius: float,
) -> tuple[tuple[Int64[np.ndarray, " _"], ...], _Points, _Points]:
    """Find the positives of a set of several zones, and both sides' points on the ellipsoid.

    Images of one zone match by its metres, so that published sets such as MSLS, with one city per
    zone, have the positives that other tools find.
    """
    degrees = utm_degrees(names, zones, np.concatenate([places, asked]))
    there, here = np.split(on_ellipsoid(*degrees.T), [len(places)])
    zone_there, zone_here = np.split(np.array(zones), [len(places)])
    positives = []
    # A zone's scale is at least 0.9996: images close in its plane are about as close on the ground.
    for query, near in enumerate(within(there, here, 1.001 * radius)):
        in_zone = (zone_there[near] == zone_here[query]).all(axis=1)
        plane = np.linalg.norm(places[near] - asked[query], axis=1)
        ground = np.linalg.norm(there[near] - here[query], axis=1)
        positives.append(near[np.where(in_zone, plane, ground) <= radius])
    return tuple(positives), there, here


def has_utm_names(folder: pathlib.Path, queries: str = QUERIES) -> bool:
    """Return whether any image of the database or the queries has a name that begins with @."""
    paths = list_part(find_database(folder)) + list_part(folder / queries)
    return any(path.name.startswith("@") for path in paths)


def _coordinates(paths: tuple[pathlib.Path, ...]) -> _Points:
    """Read each image's east and north in metres from its name."""
    coordinates = [utm_position(path.name) for path in paths]
    if None in coordinates:
        path = paths[coordinates.index(None)]
        raise InputError(f"{path}: found no coordinates, expected a name @UTM_east@UTM_north@...")
    return np.array(coordinates, np.float64)


def _nordland(database: _Points, queries: _Points) -> tuple[float, _Points, _Points] | None:
    """Return the Nordland spacing and (0, frame) for every image; None for other sets."""
    for metres in _NORDLANDS:
        sides = [np.round(side / metres) for side in (database, queries)]
        off = [np.abs(f * metres - c) for f, c in zip(sides, (database, queries), strict=True)]
        # The product's rounding error is at most 1e-9 m.
        if max(side.max() for side in off) > _NAME_METRES + 1e-6:
            continue
        line = np.stack([np.zeros(len(database)), np.arange(len(database))], axis=1)
        in_order = np.array_equal(np.unique(sides[0], axis=0), line) and len(line) > 1
        if in_order and not sides[1][:, 0].any() and np.isin(sides[1][:, 1], line[:, 1]).all():
            return metres, sides[0], sides[1]
    return None


def _are_placeholders(database: _Points, queries: _Points) -> bool:
    """Return whether all eastings are 0 and northings whole kilometres, unique in the database."""
    both = np.concatenate([database, queries])
    whole = not both[:, 0].any() and not (both[:, 1] % _PLACE_METRES).any()
    return whole and len(np.unique(database[:, 1])) == len(database) > 1


def _msls_cities(paths: tuple[pathlib.Path, ...]) -> frozenset[str] | None:
    """Return the cities in the names' notes; None unless all notes are those of MSLS."""
    cities = set()
    for path in paths:
        fields = path.name.split("@")
        note = _MSLS_NOTE.fullmatch(fields[14]) if len(fields) > 14 else None
        if note is None:
            return None
        cities.add(note[1])
    return frozenset(cities)
