"""Recordings of Rerun, read back by Rerun's own reader of files and its command line."""

import datetime
import pathlib
import signal
import subprocess
import sys

import cv2
import numpy as np
import pytest

from crisalad_jax.cli import main
from crisalad_jax.data.images import list_images, read_image
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.experiments.rerun_log import record, record_results
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.maps.images import MapImage
from crisalad_jax.retrieval.maps.query import Answers
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.retrieval.verification.results import Verification
from crisalad_jax.utils.errors import InputError, Interrupted
from crisalad_jax.utils.output import Note
from tests.conftest import MODEL, read_options, write_video

rr = pytest.importorskip("rerun")

LEVELS = 12
"""Of 256 that a JPEG of these smooth pictures of noise is from them, on the mean."""


def read(path: pathlib.Path) -> dict[str, list[dict]]:
    """The rows of every entity: its components and times, in the order of frames."""
    found: dict[str, list[dict]] = {}
    for chunk in rr.chunk.RrdReader(path).stream():
        rows = chunk.to_record_batch().to_pylist()
        found.setdefault(chunk.entity_path, []).extend(rows)
    for rows in found.values():
        rows.sort(key=lambda row: row.get("frame", -1))
    return found


def column(rows: list[dict], component: str) -> list:
    """A component's values; a single one without its list."""
    values = [row[component] for row in rows]
    return [value[0] if len(value) == 1 else value for value in values]


def decoded(blob) -> np.ndarray:
    return cv2.imdecode(np.array(blob, np.uint8), cv2.IMREAD_COLOR_RGB)


@pytest.fixture
def answers(shared) -> Answers:
    """Two queries of the town, with positions east and north as large as UTM's."""
    root = shared / "town" / "images" / "test"
    images = [
        MapImage(path.name, 1, (500_000.25 + number, 5_000_000.5 + 2 * number), str(path.parent))
        for number, path in enumerate(list_images(root / "database"))
    ]
    near = Neighbours(
        np.array([[1, 0, 2, 3], [5, 6, 4, 3]]),
        np.array([[0.9, 0.5, 0.25, 0.1], [0.3, 0.2, 0.1, 0.05]], np.float32),
    )
    queries = list_images(root / "queries")[:2]
    axes = ("east", "north")
    return Answers(queries, near, images, axes, min_similarity=0.5, root=root / "queries")


def test_a_recording_has_what_query_found(answers, tmp_path):
    out = tmp_path / "walk.rrd"
    with record(out) as recording:
        recording.add(answers)
    found = read(out)
    for number, path in enumerate(answers.queries):
        shown = decoded(column(found["/query"], "EncodedImage:blob")[number])
        assert np.abs(shown.astype(int) - read_image(path)).mean() < LEVELS
        for rank in range(3):
            image = answers.images[answers.neighbours.indices[number, rank]]
            shown = decoded(column(found[f"/answers/{rank + 1}"], "EncodedImage:blob")[number])
            file = pathlib.Path(image.root, image.name)
            assert np.abs(shown.astype(int) - read_image(file)).mean() < LEVELS
    assert "/answers/4" not in found
    similarities = column(found["/similarity/best"], "Scalars:scalars")
    np.testing.assert_allclose(similarities, [0.9, 0.3], rtol=1e-6)  # as float32
    assert column(found["/similarity/least"], "Scalars:scalars") == [0.5, 0.5]
    words = column(found["/words"], "TextDocument:text")
    assert words[0].splitlines()[0] == answers.names[0]
    assert words[1].splitlines()[0] == f"{answers.names[1]}: unknown"
    assert words[0].splitlines()[1] == f"1. 0.900 {answers.images[1].name}"
    assert [row["frame"] for row in found["/query"]] == [0, 1]
    assert "time" not in found["/query"][0]  # names of the town say none
    # From the middle image, the fourth of seven, whose position is rounded to metres.
    (points,) = column(found["/map/images"], "Points3D:positions")
    offsets = np.arange(7) - 3.0
    expected = np.stack([offsets + 0.25, 2 * offsets + 0.5, np.zeros(7)], axis=1)
    np.testing.assert_array_equal(points, expected)
    # The second query is of an unknown place, and so is not on the way.
    (here,) = column(found["/map/here"], "Points3D:positions")
    np.testing.assert_array_equal(here, expected[1])
    way = column(found["/map/way"], "LineStrips3D:strips")
    np.testing.assert_array_equal(way, [[expected[1]]])
    assert rr.chunk.RrdReader(out).blueprints()


def test_matches_join_the_same_points_of_two_images(answers, tmp_path):
    """By hand: the query is 70 x 50 pixels; an answer of 960 x 480 is shown at half its size."""
    wide = np.zeros((480, 960, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "wide.png"), wide)
    images = [image._replace(name="wide.png", root=str(tmp_path)) for image in answers.images]
    points = np.array([[3.0, 4], [60, 40]]), np.array([[100.0, 30], [900, 480]])
    none = Verification(0, 3, 0.0, np.zeros((0, 2)), np.zeros((0, 2)))
    checks = [[Verification(2, 9, 0.5, *points)], [none]]
    with record(tmp_path / "a.rrd") as recording:
        recording.add(answers._replace(images=images, checks=checks))
    found = read(tmp_path / "a.rrd")
    both = decoded(column(found["/matches/images"], "EncodedImage:blob")[0])
    assert both.shape == (240, 70 + 480, 3)
    lines = [row["LineStrips2D:strips"] for row in found["/matches/lines"]]
    assert lines == [[[[3, 4], [70 + 50, 15]], [[60, 40], [70 + 450, 240]]], []]
    assert column(found["/inliers"], "Scalars:scalars") == [2, 0]


def test_its_times_are_those_of_names(answers, tmp_path):
    """Frames of a video by seconds into it; of a camera, dates."""
    video = write_video(tmp_path / "walk.avi", 2)
    stamps = [f"{tmp_path}/1767225600.5.png", f"{tmp_path}/1767225601.25.png"]
    named = {
        "video": [pathlib.Path(f"{video}#t=0.000"), pathlib.Path(f"{video}#t=0.100")],
        "dates": [pathlib.Path(name) for name in stamps],
    }
    pixels = [np.zeros((4, 5, 3), np.uint8)] * 2
    times = {}
    for name, queries in named.items():
        with record(tmp_path / f"{name}.rrd") as recording:
            for number in range(2):
                one = Neighbours(*(part[number : number + 1] for part in answers.neighbours))
                asked = [queries[number]]
                part = answers._replace(queries=asked, neighbours=one, root=tmp_path)
                recording.add(part, pixels[:1])
        rows = read(tmp_path / f"{name}.rrd")["/query"]
        assert [row["frame"] for row in rows] == [0, 1]
        times[name] = [row["time"] for row in rows]
    assert [time.total_seconds() for time in times["video"]] == [0, 0.1]
    begun = datetime.datetime(2026, 1, 1)  # 1767225600 seconds since 1970
    seconds = [(time.replace(tzinfo=None) - begun).total_seconds() for time in times["dates"]]
    assert seconds == pytest.approx([0.5, 1.25], abs=1e-6)  # 64-bit floats of today's seconds


def test_degrees_are_on_a_globe(answers, tmp_path):
    """As 64-bit numbers: 32 bits of a longitude are metres."""
    spots = [(52.229676 + 1e-7 * number, 21.012229) for number in range(7)]
    images = [
        image._replace(position=spot) for image, spot in zip(answers.images, spots, strict=True)
    ]
    with record(tmp_path / "a.rrd") as recording:
        recording.add(answers._replace(images=images, axes=("lat", "lon")))
    found = read(tmp_path / "a.rrd")
    (points,) = column(found["/map/images"], "GeoPoints:positions")
    assert [tuple(point) for point in points] == spots
    assert tuple(column(found["/map/here"], "GeoPoints:positions")[0]) == spots[1]


def test_a_map_without_positions_has_no_map(answers, tmp_path):
    images = [image._replace(position=None) for image in answers.images]
    with record(tmp_path / "a.rrd") as recording:
        recording.add(answers._replace(images=images, axes=None))
    assert not [name for name in read(tmp_path / "a.rrd") if name.startswith("/map")]


def test_pictures_of_the_map_that_are_gone_are_left_out(answers, tmp_path):
    images = [image._replace(root="/nowhere") for image in answers.images]
    moved = answers._replace(images=images)
    words = r"6 pictures left out \(first: /nowhere/.*\); --map-images"
    with pytest.warns(Note, match=words), record(tmp_path / "a.rrd") as recording:
        recording.add(moved)
    assert len(read(tmp_path / "a.rrd")["/query"]) == 2
    root = pathlib.Path(answers.images[0].root)
    with record(tmp_path / "b.rrd", root=root) as recording:
        recording.add(moved)
    assert len(column(read(tmp_path / "b.rrd")["/answers/1"], "EncodedImage:blob")) == 2


def test_a_signal_leaves_a_whole_recording_and_an_error_none(answers, tmp_path):
    """How a camera ends, and how other work does."""

    def end(number: int) -> None:
        with record(tmp_path / "a.rrd") as recording:
            recording.add(answers)
            raise Interrupted(number)

    with pytest.raises(Interrupted):
        end(signal.SIGINT)
    assert len(read(tmp_path / "a.rrd")["/query"]) == 2
    lost = answers._replace(queries=[answers.queries[0], tmp_path / "none.jpg"], root=None)
    with pytest.raises(InputError, match=r"none\.jpg"), record(tmp_path / "b.rrd") as recording:
        recording.add(lost)
    assert [path.name for path in tmp_path.iterdir()] == ["a.rrd"]


def test_an_evaluation_is_recorded_by_grouping(benchmark, params, tmp_path):
    groupings = ["single", "sequential"]
    options = read_options({})
    results = evaluate(Model(params, MODEL), benchmark, groupings=groupings, **options)
    record_results(tmp_path / "a.rrd", benchmark, results)
    found = read(tmp_path / "a.rrd")
    for result in results:
        at = f"/{rr.escape_entity_path_part(result.label)}"
        best = column(found[f"{at}/similarity/best"], "Scalars:scalars")
        np.testing.assert_allclose(best, result.neighbours.similarities[:, 0], rtol=1e-6)
        colours = column(found[f"{at}/map/found"], "Points3D:colors")[0]
        truth = benchmark.ground_truth()
        firsts = result.neighbours.indices[:, 0]
        right = [first in of for first, of in zip(firsts, truth, strict=True)]
        # Packed as red, green, blue and alpha: what is right has more green than red.
        channels = [((colour >> 24) & 255, (colour >> 16) & 255) for colour in colours]
        assert [green > red for red, green in channels] == right


def test_rerun_opens_it(answers, tmp_path):
    """Its command line, which is in the wheel: each message decodes."""
    out = tmp_path / "a.rrd"
    with record(out) as recording:
        recording.add(answers)
    command = [sys.executable, "-m", "rerun", "rrd", "verify", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "1 file verified without error" in done.stdout + done.stderr
    out.write_bytes(out.read_bytes()[:3000])
    assert subprocess.run(command, capture_output=True, check=False).returncode


def test_query_and_evaluate_write_recordings(shared, tmp_path, capfd):
    weights, town = shared / "weights.safetensors", shared / "town"
    images, out = town / "images" / "test", tmp_path / "map"
    quiet = ("--batch-size", 4, "--quiet")

    def crisalad(*given: object) -> tuple[str, str]:
        assert main([*map(str, given)]) == 0
        return capfd.readouterr()

    crisalad("index", "--weights", weights, "--images", images / "database", "--out", out, *quiet)
    asked = ("query", "--map", out, *quiet, "--k", 2)
    said, _ = crisalad(*asked, images / "queries", "--rerun", tmp_path / "q.rrd")
    assert f"{tmp_path}/q.rrd: 5 queries in a map of 7 images" in said
    found = read(tmp_path / "q.rrd")
    assert len(found["/query"]) == 5
    assert len(column(found["/map/images"], "Points3D:positions")[0]) == 7
    video = write_video(tmp_path / "walk.avi", 5)
    said, _ = crisalad(*asked, "--camera", video, "--rate", 4, "--rerun", tmp_path / "c.rrd")
    rows = read(tmp_path / "c.rrd")["/query"]
    assert len(rows) == len(said.splitlines()) >= 1
    assert rows[-1]["time"].total_seconds() == 0.4
    given = ("evaluate", "--weights", weights, "--data", town, "--grouping", "single", *quiet)
    crisalad(*given, "--rerun", tmp_path / "e.rrd")
    assert len(read(tmp_path / "e.rrd")["/single/query"]) == 5


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("a.jpg", "--rerun", "a.png"), "--rerun: found a.png"),
        (("a.jpg", "--rate", "2"), "--rate: found without --camera, expected both"),
        (("--watch", ".", "--rate", "2"), "--rate: found with --watch, expected only one"),
        (
            ("a.jpg", "--map-images", "."),
            "--map-images: found without --gallery, --rerun or",
        ),
    ],
)
def test_what_query_refuses(given, words, capfd, tmp_path):
    assert main(["query", "--map", str(tmp_path), *given]) == 2
    assert words in capfd.readouterr().err


def test_without_rerun_one_line_says_what_to_install(monkeypatch, capfd, tmp_path):
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.delitem(sys.modules, "crisalad_jax.experiments.rerun_log", raising=False)
    asked = (["query", "a.jpg", "--map", "m"], ["evaluate", "--data", "d", "--preset", "tiny"])
    for given in asked:
        assert main([*given, "--rerun", str(tmp_path / "a.rrd")]) == 2
        error = capfd.readouterr().err
        assert error.count("\n") == 1
        assert "pip install 'crisalad-jax[robot]'" in error
