"""Answers in files of other programs: read by gpxpy, expat and our own tables; refusals."""

import csv
import datetime
import json
import math
import pathlib
import xml.dom.minidom

import gpxpy
import numpy as np
import pyproj
import pytest

from crisalad_jax.data.metres import Zone
from crisalad_jax.data.positions import read_image_table
from crisalad_jax.retrieval.maps.answer_files import format_answers
from crisalad_jax.retrieval.maps.images import MapImage
from crisalad_jax.retrieval.maps.query import Answers
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.utils.errors import InputError

METRES = [(448_251.25, 5_411_932.5), (448_300.0, 5_411_999.0), None]
"""Of the Eiffel tower, UTM 31 north; of a place near it; and of an image without a position."""
ZONE = Zone(31, False)
DEGREES = 1e-8
"""A millimetre; files have nine decimals, and Krueger's series is exact to less."""
STAMPS = ["1700000000.250.jpg", "cam/1700000001500.jpg", "1700000002_000000000.jpg"]
NAMES = ['<a> & "b".jpg', "é/ü.jpg", "c.jpg"]


def answered(names=NAMES, *, axes=("east", "north"), zone=ZONE, **changes) -> Answers:
    """Query i has image i of the map as its best answer, of similarity 0.9, 0.8, 0.7."""
    positions = METRES
    if axes == ("lat", "lon"):
        positions = [at and (48.85 + at[0] / 1e9, 2.35) for at in METRES]
    images = [MapImage(f"map & <{i}>.jpg", 1, at, "/m") for i, at in enumerate(positions)]
    similarities = np.array([[0.9], [0.8], [0.7]], np.float32)
    paths = [pathlib.Path("/q", name) for name in names]
    found = Neighbours(np.arange(3)[:, None], similarities)
    given = Answers(paths, found, images, axes, zone=zone, root=pathlib.Path("/q"))
    return given._replace(**changes)


def write_answers(path: pathlib.Path, answers: Answers) -> int:
    """Write answers as `crisalad query --out` does, and return how many."""
    text, count = format_answers(path, answers)
    path.write_text(text, "utf-8", newline="")
    return count


def expected_degrees(number: int) -> tuple[float, float]:
    to_degrees = pyproj.Transformer.from_crs(32631, 4326, always_xy=True)
    longitude, latitude = to_degrees.transform(*METRES[number])
    return latitude, longitude


def test_geojson(tmp_path):
    answers = answered(min_similarity=0.85)
    assert write_answers(tmp_path / "a.geojson", answers) == 3
    found = json.loads((tmp_path / "a.geojson").read_text(encoding="utf-8"))
    assert found["type"] == "FeatureCollection"
    first, second, third = found["features"]
    latitude, longitude = expected_degrees(0)
    assert first["type"] == "Feature"
    assert first["geometry"]["type"] == "Point"
    # RFC 7946: longitude comes first.
    assert first["geometry"]["coordinates"] == pytest.approx([longitude, latitude], abs=DEGREES)
    assert first["properties"] == {
        **{"query": NAMES[0], "answer": "map & <0>.jpg", "similarity": 0.9, "known": True},
    }
    # Not similar enough; and without a position.
    assert (second["geometry"], second["properties"]["known"]) == (None, False)
    assert third["geometry"] is None
    write_answers(tmp_path / "b.geojson", answered(STAMPS, probabilities=np.full((3, 1), 0.5)))
    first = json.loads((tmp_path / "b.geojson").read_text())["features"][0]["properties"]
    assert (first["time"], first["probability"]) == ("2023-11-14T22:13:20.250Z", 0.5)
    assert "known" not in first
    frames = [f"walk.mp4#t={number}.500" for number in range(3)]
    write_answers(tmp_path / "c.geojson", answered(frames))
    second = json.loads((tmp_path / "c.geojson").read_text())["features"][1]
    assert second["properties"]["time"] == 1.5
    assert second["geometry"] is not None


def test_gpx_without_times_is_points(tmp_path):
    assert write_answers(tmp_path / "a.gpx", answered()) == 2
    text = (tmp_path / "a.gpx").read_text(encoding="utf-8")
    found = gpxpy.parse(text, version="1.1")
    assert found.version == "1.1"
    assert [point.name for point in found.waypoints] == NAMES[:2]
    assert found.waypoints[0].description == "answer map & <0>.jpg; similarity 0.9"
    for number, point in enumerate(found.waypoints):
        at = (point.latitude, point.longitude)
        assert at == pytest.approx(expected_degrees(number), abs=DEGREES)
    assert not found.tracks
    # The schema's order of a point's elements: time, name, desc.
    point = xml.dom.minidom.parseString(text.encode()).getElementsByTagName("wpt")[0]
    assert [each.tagName for each in point.childNodes if each.nodeType == 1] == ["name", "desc"]


def test_gpx_with_times_is_a_track(tmp_path):
    assert write_answers(tmp_path / "a.gpx", answered(STAMPS)) == 2
    text = (tmp_path / "a.gpx").read_text(encoding="utf-8")
    found = gpxpy.parse(text, version="1.1")
    assert not found.waypoints
    ((segment,),) = (track.segments for track in found.tracks)
    start = datetime.datetime.fromtimestamp(1_700_000_000, datetime.UTC)
    seconds = [(point.time - start).total_seconds() for point in segment.points]
    assert seconds == [0.25, 1.5]
    assert segment.points[1].latitude == pytest.approx(expected_degrees(1)[0], abs=DEGREES)
    point = xml.dom.minidom.parseString(text.encode()).getElementsByTagName("trkpt")[0]
    order = [each.tagName for each in point.childNodes if each.nodeType == 1]
    assert order == ["time", "name", "desc"]


def test_small_degrees_have_no_exponent_in_gpx(tmp_path):
    answers = answered(axes=("lat", "lon"), zone=None)
    images = [answers.images[0]._replace(position=(1e-6, -2e-7)), *answers.images[1:]]
    write_answers(tmp_path / "a.gpx", answers._replace(images=images))
    assert 'lat="0.000001" lon="-0.0000002"' in (tmp_path / "a.gpx").read_text()


def test_kml(tmp_path):
    assert write_answers(tmp_path / "a.kml", answered(STAMPS)) == 2
    document = xml.dom.minidom.parseString((tmp_path / "a.kml").read_bytes())
    assert document.documentElement.namespaceURI == "http://www.opengis.net/kml/2.2"

    def texts(tag: str) -> list[str]:
        return [each.firstChild.data for each in document.getElementsByTagName(tag)]

    assert texts("name") == STAMPS[:2]
    assert texts("description")[0] == "answer map & <0>.jpg; similarity 0.9"
    assert texts("when") == ["2023-11-14T22:13:20.250Z", "2023-11-14T22:13:21.500Z"]
    longitude, latitude = map(float, texts("coordinates")[0].split(","))
    assert (latitude, longitude) == pytest.approx(expected_degrees(0), abs=DEGREES)
    write_answers(tmp_path / "b.kml", answered())
    document = xml.dom.minidom.parseString((tmp_path / "b.kml").read_bytes())
    assert texts("name") == NAMES[:2]
    assert not texts("when")


@pytest.mark.parametrize("axes", [("east", "north"), ("lat", "lon"), ("x", "y")])
def test_a_table_that_positions_are_read_from(tmp_path, axes):
    answers = answered(axes=axes, zone=None)
    assert write_answers(tmp_path / "a.csv", answers) == 2
    names, positions = read_image_table(tmp_path / "a.csv", all_positions=True)
    assert names == NAMES[:2]
    assert positions is not None
    assert positions.axes == axes
    assert positions.of == {name: answers.images[i].position for i, name in enumerate(NAMES[:2])}
    with (tmp_path / "a.csv").open(newline="", encoding="utf-8") as file:
        first = next(csv.DictReader(file))
    assert list(first) == ["name", *axes, "answer", "similarity", "time"]
    assert (first["answer"], first["similarity"], first["time"]) == ("map & <0>.jpg", "0.9", "")


@pytest.mark.parametrize("suffix", ["csv", "geojson", "gpx", "kml"])
def test_all_of_unknown_places(tmp_path, suffix):
    """A file without a place is a whole one all the same."""
    file = tmp_path / f"a.{suffix}"
    written = write_answers(file, answered(min_similarity=1.0))
    assert written == (3 if suffix == "geojson" else 0)
    if suffix == "csv":
        assert read_image_table(file)[0] == []
    elif suffix == "geojson":
        assert all(each["geometry"] is None for each in json.loads(file.read_text())["features"])
    else:
        xml.dom.minidom.parse(str(file))


@pytest.mark.parametrize("suffix", ["csv", "geojson", "gpx", "kml"])
def test_a_name_that_no_text_shows_is_escaped(tmp_path, suffix):
    names = ["a\x01.jpg", "caf\udce9.jpg", "c.jpg"]
    file = tmp_path / f"a.{suffix}"
    write_answers(file, answered(names))
    text = file.read_text(encoding="utf-8")
    assert "\x01" not in text
    assert r"caf\udce9.jpg".replace("\\", "\\\\" if suffix == "geojson" else "\\") in text
    if suffix in ("gpx", "kml"):
        xml.dom.minidom.parse(str(file))


@pytest.mark.parametrize("name", ["a.geojson", "a.GPX", "a.kml", "a.csv"])
@pytest.mark.parametrize(
    ("axes", "words"),
    [
        (None, "found no positions in the map"),
        (("x", "y"), "found positions in x, y without a zone of UTM, expected degrees"),
        (("east", "north"), "found positions in east, north without a zone of UTM"),
    ],
)
def test_positions_that_a_format_has_no_place_for(tmp_path, name, axes, words):
    answers = answered()._replace(axes=axes, zone=None)
    if axes is not None and name == "a.csv":
        assert write_answers(tmp_path / name, answers) == 2
        return
    with pytest.raises(InputError, match=f"{name}: {words}"):
        write_answers(tmp_path / name, answers)
    assert list(tmp_path.iterdir()) == []


def test_southern_metres(tmp_path):
    """Sydney, UTM 56 south."""
    answers = answered(zone=Zone(56, True))
    images = [each._replace(position=(334_786.0, 6_252_080.0)) for each in answers.images]
    write_answers(tmp_path / "a.geojson", answers._replace(images=images))
    feature = json.loads((tmp_path / "a.geojson").read_text())["features"][0]
    found = feature["geometry"]["coordinates"]
    expected = pyproj.Transformer.from_crs(32756, 4326, always_xy=True).transform(
        334_786, 6_252_080
    )
    assert found == pytest.approx(expected, abs=DEGREES)
    assert math.floor(found[1]) == -34
