"""Tracks: read as gpxpy reads them, interpolated as numpy does, by the times of images."""

import datetime
import json
import pathlib

import gpxpy
import numpy as np
import pytest
from PIL import Image

from crisalad_jax.data.positions import Positions, exif_time, positions_of, read_image_table
from crisalad_jax.data.sources import ImageSource, open_source
from crisalad_jax.data.tracks import Track, is_track, read_track
from tests.conftest import write_picture
from tests.data.benchmarks.trees import refused

START = 1_777_629_600
"""2026-05-01T10:00:00Z."""
POINTS = [(52.2, 21.0), (52.201, 21.002), (52.203, 21.003), (52.204, 21.007)]
SECONDS = [0, 10, 15, 60]


def at(seconds: float) -> str:
    return datetime.datetime.fromtimestamp(START + seconds, datetime.UTC).isoformat()


def gpx(points=POINTS, seconds=SECONDS, version="1.1", head="") -> str:
    """Two tracks, the first one in two segments."""
    each = [
        f'<trkpt lat="{lat}" lon="{lon}"><ele>3</ele><time>{at(time)}</time></trkpt>'
        for (lat, lon), time in zip(points, seconds, strict=True)
    ]
    name = f"http://www.topografix.com/GPX/{version.replace('.', '/')}"
    first = f"<trk><trkseg>{each[0]}</trkseg><trkseg>{''.join(each[1:-1])}</trkseg></trk>"
    return (
        f'<?xml version="1.0"?>{head}<gpx xmlns="{name}" version="{version}" creator="me">'
        f'<wpt lat="1" lon="2"/>{first}<trk><trkseg>{each[-1]}</trkseg></trk></gpx>'
    )


def line(times: object, key: str = "coordTimes", kind: str = "LineString") -> str:
    coordinates: object = [[lon, lat, 3] for lat, lon in POINTS]
    if kind == "MultiLineString":
        coordinates, times = [coordinates], [times]
    geometry = {"type": kind, "coordinates": coordinates}
    feature = {"type": "Feature", "geometry": geometry, "properties": {key: times}}
    return json.dumps({"type": "FeatureCollection", "features": [feature]})


def dots(key: str = "time") -> str:
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [lon, lat]},
            "properties": {key: at(time)},
        }
        for (lat, lon), time in zip(POINTS, SECONDS, strict=True)
    ]
    note = {"type": "Feature", "geometry": {"type": "Point", "coordinates": [0, 0]}}
    return json.dumps(
        {"type": "FeatureCollection", "features": [*features, note | {"properties": None}]}
    )


def table(header: str = "time,lat,lon", scale: int = 1) -> str:
    rows = [
        f"{(START + time) * scale},{lat},{lon}"
        for (lat, lon), time in zip(POINTS, SECONDS, strict=True)
    ]
    return "\n".join([header, *rows])


ISO = [at(time) for time in SECONDS]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.gpx", gpx()),
        ("a.GPX", gpx(version="1.0")),
        ("a.geojson", line(ISO)),
        ("a.json", line(ISO, "times", "MultiLineString")),
        ("a.geojson", line([1000 * (START + time) for time in SECONDS])),
        ("b.geojson", dots()),
        ("b.geojson", dots("timestamp")),
        ("a.csv", table()),
        ("a.csv", table("Timestamp,Latitude,LNG", 1000)),
        ("a.csv", table("t,lat,long", 10**9)),
        ("a.csv", "lon;note;date;lat\n" + "".join(
            f"{str(lon).replace('.', ',')};;{time};{str(lat).replace('.', ',')}\n"
            for (lat, lon), time in zip(POINTS, ISO, strict=True)
        )),
    ],
)  # fmt: skip
def test_every_form_has_the_same_points(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    found = read_track(tmp_path / name)
    assert is_track(tmp_path / name)
    assert found.axes == ("lat", "lon")
    # Times of nanoseconds are rounded to a float's 0.24 microseconds.
    np.testing.assert_allclose(found.times, np.array(SECONDS) + START, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(found.points, POINTS)


def test_gpx_as_gpxpy_reads_it(tmp_path):
    (tmp_path / "a.gpx").write_text(gpx())
    found = read_track(tmp_path / "a.gpx")
    points = [point.point for point in gpxpy.parse(gpx()).get_points_data()]
    assert found.times.tolist() == [point.time.timestamp() for point in points]
    assert found.points.tolist() == [[point.latitude, point.longitude] for point in points]


def test_metres_of_a_table(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,Time\n1,2,0\n3,5,1.5\n")
    found = read_track(tmp_path / "a.csv")
    assert (found.axes, found.times.tolist()) == (("x", "y"), [0, 1.5])
    (tmp_path / "a.csv").write_text("name,x,y,time\na.jpg,1,2,0\n")
    assert not is_track(tmp_path / "a.csv")


def test_interpolated_as_numpy_does_and_across_180_degrees(tmp_path):
    (tmp_path / "a.gpx").write_text(gpx())
    track = read_track(tmp_path / "a.gpx")
    times = np.array([-1, 0, 3, 10, 14, 37.5, 60, 60.1])
    found, gaps = track.interpolate(times + START)
    expected = [np.interp(times, SECONDS, axis) for axis in np.transpose(POINTS)]
    # Longitudes are rounded to 1e-9 degrees, a tenth of a millimetre.
    np.testing.assert_allclose(found[1:-1], np.transpose(expected)[1:-1], rtol=0, atol=1e-9)
    assert np.isnan(found[[0, -1]]).all()
    assert gaps.tolist()[1:-1] == [0, 10, 0, 5, 45, 0]
    around = Track("a", ("lat", "lon"), np.array([0.0, 4]), np.array([[0, 179.0], [0, -179]]))
    points = around.interpolate(np.array([1.0, 3]))[0]
    np.testing.assert_allclose(points, [[0, 179.5], [0, -179.5]], atol=1e-9)


BOMB = '<!DOCTYPE gpx [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>'


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.gpx", gpx(head=BOMB), "found a document type"),
        ("a.gpx", gpx()[:-9], "expected a track in GPX"),
        ("a.gpx", '<gpx xmlns="http://www.topografix.com/GPX/1/1"/>', "found no point, expected"),
        (
            "a.gpx",
            gpx().replace(f"<time>{at(15)}</time>", ""),
            "found 1 of 4 points without a time, expected track points with times",
        ),
        ("a.gpx", gpx().replace(at(15), "noon"), "found time 'noon', expected one such as 2026"),
        ("a.gpx", gpx(seconds=[0, 10, 5, 60]), "point 3 at 2026-05-01T10:00:05Z, after .*10Z"),
        ("a.gpx", gpx([(52, "NaN"), *POINTS[1:]]), r"found \[52.0, nan\] as point 1, expected"),
        ("a.gpx", gpx([*POINTS[:3], (91, 0)]), r"found \[91.0, 0.0\] as point 4, expected"),
        ("a.gpx", gpx([("", 0), *POINTS[1:]]), "found a point that is not two numbers"),
        ("a.geojson", "{}", "found other JSON"),
        ("a.geojson", "[", "found no JSON"),
        ("a.geojson", line(None), "found 4 of 4 points without a time"),
        ("a.geojson", line(ISO[:3]), "found other JSON"),
        ("a.geojson", line([True] * 4), "found time True"),
        ("a.csv", "time,lat\n0,1\n", "found columns time, lat, expected only one of time,east"),
        ("a.csv", "time,x,y\n0,1,oops\n", "line 2: y: found 'oops', expected a number"),
        ("a.csv", "time,x,y\n,1,2\n", "line 2: found no time"),
        ("a.csv", "time,x,y\n", "found no point"),
        ("a.csv", "when,x,y\n0,1,2\n", "missing time"),
        ("gone.gpx", None, "found no such file, expected a track in GPX"),
    ],
)  # fmt: skip
def test_bad_tracks_are_refused_in_a_line(tmp_path, name, text, words):
    if text is not None:
        (tmp_path / name).write_text(text)
    with refused(f"{name}: .*{words}|{name}: {words}"):
        read_track(tmp_path / name)


def test_starts_and_offsets(tmp_path):
    (tmp_path / "a.gpx").write_text(gpx())
    given = {"start_time": "2026-05-01T12:00:00+02:00", "time_offset": 3}
    found = read_track(tmp_path / "a.gpx", **given)
    assert (found.start_time, found.time_offset) == (START, 3)
    for text in ("noon", "2026-05-01 10:00"):
        with refused(f"--start-time: found '{text}', expected a time and its zone: "):
            read_track(tmp_path / "a.gpx", start_time=text)
    with refused("--time-offset: found nan"):
        read_track(tmp_path / "a.gpx", time_offset=float("nan"))


def write_photo(path: pathlib.Path, taken: str | None, zone: str | None = None) -> pathlib.Path:
    exif = Image.Exif()
    fields = {0x9003: taken, 0x9011: zone, 0x9291: "25"}
    exif.get_ifd(0x8769).update({key: value for key, value in fields.items() if value})
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(path, exif=exif)
    return path


@pytest.mark.parametrize(
    ("taken", "zone", "expected"),
    [
        ("2026:05:01 10:00:07", None, (START + 7.25, False)),
        ("2026:05:01 12:00:07", "+02:00", (START + 7.25, True)),
        ("0000:00:00 00:00:00", None, None),
        (None, "+02:00", None),
    ],
)
def test_exif_says_when(tmp_path, taken, zone, expected):
    assert exif_time(write_photo(tmp_path / "a.jpg", taken, zone)) == expected


def test_images_are_placed_by_stamps_exif_and_offset(tmp_path):
    """One with a zone, one without, a stamp in a name, one outside and one without a time."""
    for name, taken, zone in (
        ("a.jpg", "2026:05:01 12:00:04", "+02:00"),
        ("b.jpg", "2026:05:01 10:00:20", None),
        ("c.jpg", None, None),
        ("d.jpg", "2026:05:01 11:00:00", None),
    ):
        write_photo(tmp_path / name, taken, zone)
    write_picture(tmp_path / f"{START + 10}.500.png", 1)
    (tmp_path / "t.gpx").write_text(gpx())
    source = open_source(tmp_path / "*.[jp]*g")
    notes = (
        r"3 of 5 images on the track, .* to .*; 1 were taken before or after it; 1 have no time; "
        r"the largest gap is 45 s, between 2026-05-01T10:00:15Z and 2026-05-01T10:01:00Z; "
        r"the times of 2 are taken as UTC"
    )
    with pytest.warns(UserWarning, match=notes):
        found = source.located(read_track(tmp_path / "t.gpx", time_offset=-1))
    expected = {
        name: [np.interp(seconds, SECONDS, axis) for axis in np.transpose(POINTS)]
        for name, seconds in (("a.jpg", 3.25), ("b.jpg", 19.25), (f"{START + 10}.500.png", 9.5))
    }
    assert found.of == {name: pytest.approx(place, abs=1e-9) for name, place in expected.items()}
    with refused(r"found a track from 2026-05-01T10.* expected the times of the 4 images .*05-02"):
        source.located(read_track(tmp_path / "t.gpx", time_offset=86400))
    (tmp_path / "d.jpg").unlink()
    with refused("found no time of 1 images, expected EXIF data, or names of"):
        positions_of(tmp_path / "t.gpx", ["c.jpg"], [tmp_path / "c.jpg"], "photos")


def test_frames_of_a_video_need_its_start(tmp_path):
    (tmp_path / "t.csv").write_text("time,x,y\n100,0,0\n110,10,20\n")
    names = ["walk.mp4#t=2.000", "walk.mp4#t=5.500"]
    paths = [tmp_path / name for name in names]
    track = read_track(tmp_path / "t.csv", start_time="1970-01-01T00:01:41Z")
    with pytest.warns(UserWarning, match="2 of 2 images"):
        found = positions_of(track, names, paths, "walk.mp4")
    assert found == Positions(("x", "y"), {names[0]: (3, 6), names[1]: (6.5, 13)})
    with refused(r"walk.mp4: found frames of .*walk.mp4, expected .*--start-time"):
        positions_of(tmp_path / "t.csv", names, paths, "walk.mp4")
    with refused("expected those of one video"):
        positions_of(track, [*names, "b"], [*paths, tmp_path / "run.mp4#t=1.000"], "all")


@pytest.mark.parametrize(
    "header",
    ["filename,latitude,longitude", "Path,Lat,Lng", "IMAGE,LATITUDE,Long", "file,lat,lon,time"],
)
def test_usual_names_of_columns(tmp_path, header):
    more = ",7" if header.endswith("time") else ""
    (tmp_path / "a.csv").write_text(f"{header}\na.jpg,52.5,21{more}\n")
    names, positions = read_image_table(tmp_path / "a.csv")
    assert (names, positions) == (["a.jpg"], Positions(("lat", "lon"), {"a.jpg": (52.5, 21)}))


def test_a_column_of_its_own_name_counts_before_others(tmp_path):
    (tmp_path / "a.csv").write_text("path,name,Easting,utm_north\nx,a.jpg,1,2\n")
    assert read_image_table(tmp_path / "a.csv")[1] == Positions(
        ("east", "north"), {"a.jpg": (1, 2)}
    )
    (tmp_path / "a.csv").write_text("name,lat,Lat,lon\na.jpg,1,2,3\n")
    with refused("found columns name, lat, lat, lon, expected each once"):
        read_image_table(tmp_path / "a.csv")


# Keyframes by distance


def source_of(*names: str) -> ImageSource:
    return ImageSource(pathlib.Path("r"), [pathlib.Path("r", name) for name in names], list(names))


def test_spaced_images_by_hand():
    """Two folders: each has its own last one; those without a position stay, and change nothing."""
    easts = {"a/0": 0, "a/1": 0.9, "a/2": 1.0, "b/0": 1.0, "a/4": 1.5, "a/5": 2.1, "b/1": 1.2}
    source = source_of("a/0", "a/1", "a/2", "a/3", "b/0", "a/4", "a/5", "b/1")
    positions = Positions(("x", "y"), {name: (float(east), 7.0) for name, east in easts.items()})
    found = source.spaced(positions, 1)
    assert found.names == ["a/0", "a/2", "a/3", "b/0", "a/5"]
    assert [path.as_posix() for path in found.paths] == [f"r/{name}" for name in found.names]
    assert found.spaced(positions, 1) == found
    with refused("--every-metres: found 0, expected metres above 0"):
        source.spaced(positions, 0)
    with refused("--every-metres: found no position of the 1 images of r, expected some"):
        source_of("c").spaced(positions, 1)


@pytest.mark.parametrize("start", [(-33.9, 18.4), (65.0, 179.9999), (0.0, 6.0)])
def test_spaced_degrees_as_geodesics(start):
    """A walk of 0.4 m a step, laid out by pyproj, also across 180 degrees and a zone's border."""
    pyproj = pytest.importorskip("pyproj")
    geod = pyproj.Geod(ellps="WGS84")
    walk = {}
    for number in range(60):
        lon, lat, _ = geod.fwd(start[1], start[0], 70, 0.4 * number)
        walk[f"{number:02d}"] = (lat, lon)
    found = source_of(*walk).spaced(Positions(("lat", "lon"), walk), 3)
    assert found.names == [f"{number:02d}" for number in range(0, 60, 8)]  # 3.2 m each
