"""Files of a map's answers: JSON, and tables and layers for mapping programs.

GeoJSON follows RFC 7946, GPX version 1.1 of Topografix's schema, KML version 2.2 of OGC 07-147r2.
"""

import csv
import datetime
import io
import os
import pathlib
import xml.etree.ElementTree as xml
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.data.frames import moment_of
from crisalad_jax.data.metres import Zone
from crisalad_jax.data.positions import AXES, utm_degrees
from crisalad_jax.retrieval.maps.map import Answer
from crisalad_jax.retrieval.maps.query import Answers, answer_fields, json_lines, json_text
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import printable

POSITION_SUFFIXES = (".csv", ".geojson", ".gpx", ".kml")
"""Suffixes of answer files that contain positions."""
_DECIMALS = 9
"""Decimal places of degrees: a tenth of a millimetre."""


class _Place(NamedTuple):
    """A query and its best answer."""

    query: str
    position: tuple[float, float] | None
    """Position of the best answer; None if it has none or is not similar enough."""
    time: str | float | None
    """UTC, as ISO 8601; or seconds into a video; None if the name has no time."""
    known: bool
    answer: dict[str, Any]
    """The best answer's name, its similarity and, with a filter, its probability."""


def format_answers(path: str | os.PathLike[str], answers: Answers) -> tuple[str, int]:
    """Format answers according to the file's suffix.

    JSON holds all answers: one line per query (.jsonl, or any other suffix) or a list (.json). The
    other formats hold the position of each query's best answer: .csv in the map's axes, as
    `--positions` reads it; .geojson, .gpx and .kml in degrees. GPX is a track if the names of all
    its queries contain seconds since 1970. A query of an unknown place, or whose best answer has no
    position, has no geometry in GeoJSON and is left out of CSV, GPX and KML.

    Args:
        path: the file that the text is for; only its suffix matters.
        answers: what `query` found.

    Returns:
        The file's text, and the number of queries in it.

    Raises:
        InputError: the file needs positions that the map lacks (see `check_positions`).
    """
    check_positions(path, answers.axes, answers.zone)
    return _WRITERS.get(_suffix(path), _json_lines)(answers)


def check_positions(
    path: str | os.PathLike[str], axes: tuple[str, str] | None, zone: Zone | None
) -> None:
    """Check that a map has the positions that an answer file needs.

    Args:
        path: the answer file; only its suffix matters.
        axes: axes of the map's positions; None if it has none.
        zone: the map's UTM zone; None if unknown.

    Raises:
        InputError: the map has no positions, or the file needs degrees and the map's UTM zone is
            unknown.
    """
    suffix = _suffix(path)
    if suffix not in POSITION_SUFFIXES:
        return
    if axes is None:
        raise InputError(f"{path}: found no positions in the map, expected some")
    if suffix != ".csv" and axes != AXES[1] and zone is None:
        raise InputError(
            f"{path}: found positions in {', '.join(axes)} without a zone of UTM, expected "
            "degrees, or metres of a known zone; a .csv file takes them as they are"
        )


def _suffix(path: str | os.PathLike[str]) -> str:
    return pathlib.Path(path).suffix.lower()


def _json_lines(answers: Answers) -> tuple[str, int]:
    return "".join(f"{line}\n" for line in json_lines(answers)), len(answers.queries)


def _json_list(answers: Answers) -> tuple[str, int]:
    lines = ",\n".join(json_lines(answers))
    return f"[\n{lines}\n]\n", len(answers.queries)


def _table(answers: Answers) -> tuple[str, int]:
    """Write a table for `read_image_table`: each query's name, and where it was taken."""
    rows = []
    for place in _places(answers, degrees=False):
        if place.position is not None:
            at = dict(zip(answers.axes or (), place.position, strict=True))
            rows.append({"name": place.query, **at, **place.answer, "time": place.time})
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0] if rows else ("name", *(answers.axes or ())))
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue(), len(rows)


def _geojson(answers: Answers) -> tuple[str, int]:
    features = []
    for place in _places(answers):
        geometry = None
        if place.position is not None:
            latitude, longitude = place.position
            geometry = {"type": "Point", "coordinates": [longitude, latitude]}
        more = {"known": place.known} if answers.is_thresholded else {}
        more |= {} if place.time is None else {"time": place.time}
        properties = {"query": place.query, **place.answer, **more}
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    lines = ",\n".join(map(json_text, features))
    return f'{{"type": "FeatureCollection", "features": [\n{lines}\n]}}\n', len(features)


def _gpx(answers: Answers) -> tuple[str, int]:
    places = _in_degrees(answers)
    root = xml.Element("gpx", version="1.1", creator="crisalad-jax")
    root.set("xmlns", "http://www.topografix.com/GPX/1/1")
    is_track = bool(places) and all(isinstance(place.time, str) for place, *_ in places)
    parent = xml.SubElement(xml.SubElement(root, "trk"), "trkseg") if is_track else root
    for place, latitude, longitude in places:
        tag = "trkpt" if is_track else "wpt"
        point = xml.SubElement(parent, tag, lat=latitude, lon=longitude)
        if isinstance(place.time, str):
            xml.SubElement(point, "time").text = place.time
        xml.SubElement(point, "name").text = place.query
        xml.SubElement(point, "desc").text = _words(place.answer)
    return _xml(root), len(places)


def _kml(answers: Answers) -> tuple[str, int]:
    places = _in_degrees(answers)
    root = xml.Element("kml", xmlns="http://www.opengis.net/kml/2.2")
    document = xml.SubElement(root, "Document")
    for place, latitude, longitude in places:
        mark = xml.SubElement(document, "Placemark")
        xml.SubElement(mark, "name").text = place.query
        xml.SubElement(mark, "description").text = _words(place.answer)
        if isinstance(place.time, str):
            xml.SubElement(xml.SubElement(mark, "TimeStamp"), "when").text = place.time
        point = xml.SubElement(mark, "Point")
        xml.SubElement(point, "coordinates").text = f"{longitude},{latitude}"
    return _xml(root), len(places)


_WRITERS: Mapping[str, Callable[[Answers], tuple[str, int]]] = {
    ".json": _json_list,
    ".csv": _table,
    ".geojson": _geojson,
    ".gpx": _gpx,
    ".kml": _kml,
}
"""Writers by file suffix; each returns the text and the number of queries in it."""


def _places(answers: Answers, *, degrees: bool = True) -> list[_Place]:
    """Return each query in order with its best answer, in degrees or in the map's axes."""
    best = [found[0] for _, found in answers.rows()]
    positions = [answer.image.position for answer in best]
    if degrees and answers.axes != AXES[1]:
        positions = _to_degrees(answers, positions)
    names, known = map(printable, answers.names), answers.known.tolist()
    columns = zip(names, answers.queries, positions, known, best, strict=True)
    return [
        _Place(name, at if is_known else None, _time(path), is_known, _answer_fields(answer))
        for name, path, at, is_known, answer in columns
    ]


def _answer_fields(answer: Answer) -> dict[str, Any]:
    fields = answer_fields(answer, None)
    known = {name: fields[name] for name in ("similarity", "probability") if name in fields}
    return {"answer": printable(answer.image.name), **known}


def _to_degrees(
    answers: Answers, positions: list[tuple[float, float] | None]
) -> list[tuple[float, float] | None]:
    """Convert metres of a known UTM zone to latitude and longitude."""
    there = [number for number, at in enumerate(positions) if at is not None]
    names = [answers.names[number] for number in there]
    metres = np.array([positions[number] for number in there], np.float64).reshape(-1, 2)
    found = np.round(utm_degrees(names, [answers.zone] * len(there), metres), _DECIMALS)
    converted = dict(zip(there, map(tuple, found.tolist()), strict=True))
    return [converted.get(number) for number in range(len(positions))]


def _time(query: pathlib.Path) -> str | float | None:
    moment = moment_of(query)
    if moment is None or moment.clock:
        return None if moment is None else moment.seconds
    time = datetime.datetime.fromtimestamp(moment.seconds, datetime.UTC)
    return time.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _in_degrees(answers: Answers) -> list[tuple[_Place, *tuple[str, ...]]]:
    """Return the queries with positions, and their latitude and longitude as text for XML."""
    known = [place for place in _places(answers) if place.position]
    return [(place, *map(_degrees, place.position or ())) for place in known]


def _degrees(value: float) -> str:
    """Format degrees without an exponent, which GPX does not allow."""
    return f"{value:.{_DECIMALS}f}".rstrip("0").rstrip(".")


def _words(fields: Mapping[str, Any]) -> str:
    return "; ".join(f"{name} {value}" for name, value in fields.items())


def _xml(root: xml.Element) -> str:
    xml.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{xml.tostring(root, encoding="unicode")}\n'
