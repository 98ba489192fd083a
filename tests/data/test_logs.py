"""Robot logs: bags by two writers, whose images and positions are known beforehand."""

import pathlib
import shutil
import sys

import cv2
import numpy as np
import pytest
from mcap.writer import CompressionType as McapCompression
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode

from crisalad_jax.data.frames import moment_of, parse_frame, stored_bytes
from crisalad_jax.data.images import decode_image, read_image, read_pixels
from crisalad_jax.data.logs import Log, open_log
from crisalad_jax.data.reading import image_batches
from crisalad_jax.data.sources import open_source, open_sources
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note
from tests.data.bags import (
    BEGIN,
    FORMS,
    SECOND,
    compressed,
    fix,
    image,
    pose,
    text,
    write_bag,
)
from tests.data.benchmarks.trees import refused

TENTH = SECOND // 10
COUNT = 30
PIXELS = np.random.default_rng(0).integers(0, 256, (COUNT, 6, 8, 3), np.uint8)
COLOUR = np.array([200, 100, 50], np.uint8)
"""Red, green and blue of flat images."""


def walk(**fields):
    """Ten images a second for three seconds, logged a little later."""
    return [
        image(BEGIN + number * TENTH, PIXELS[number], logged=BEGIN + number * TENTH + 7, **fields)
        for number in range(COUNT)
    ]


@pytest.fixture(scope="module")
def bags(tmp_path_factory) -> pathlib.Path:
    """Files to read only: the same walk in each of `FORMS`."""
    folder = tmp_path_factory.mktemp("bags")
    for form in FORMS:
        write_bag(folder / form, walk())
    return folder


def name(file: str, tenths: int, topic: str = "/camera/image_raw") -> str:
    seconds, rest = divmod(BEGIN + tenths * TENTH, SECOND)
    return f"{file}#{topic}#t={seconds}.{rest:09d}"


@pytest.mark.parametrize("form", FORMS)
def test_images_are_those_that_were_written(bags, form, recwarn):
    source = open_source(bags / form, fps=5)
    assert source.names == [name(form, tenths) for tenths in range(0, COUNT, 2)]
    assert (source.root, source.positions) == (bags, None)
    assert source.paths == [bags / each for each in source.names]
    assert not recwarn
    # Forwards, again, backwards, far ahead, and a time between two: the later one.
    order = [0, 2, 2, 8, 4, 28, 0]
    for number in order:
        np.testing.assert_array_equal(read_image(bags / name(form, number)), PIXELS[number])
    between = f"{bags / form}#/camera/image_raw#t=1700000000.25"
    np.testing.assert_array_equal(read_image(between), PIXELS[3])
    assert open_source(between).names == [name(form, 3)]
    with refused(r"t=1700000009\.0+: found no image there, expected a stamp in the log"):
        read_image(f"{bags / form}#/camera/image_raw#t=1700000009")
    played = list(open_log(bags / form).images())
    assert [stamp for stamp, _ in played] == [BEGIN + i * TENTH for i in range(COUNT)]
    np.testing.assert_array_equal(np.stack([each for _, each in played]), PIXELS)


def test_frames_in_order_open_a_log_once(bags, monkeypatch):
    """By whatever number of threads, in batches too: a bag has gigabytes."""
    opened = []
    messages = Log._messages
    monkeypatch.setattr(
        Log, "_messages", lambda *given: opened.append(given[1:]) or messages(*given)
    )
    shutil.copy(bags / "walk.bag", bags / "again.bag")  # that no other test has opened
    paths = open_source(bags / "again.bag", fps=1000).paths
    batches = list(image_batches(paths, image_size=(6, 8), batch_size=4, threads=3))
    found = np.concatenate([batch.images[batch.valid] for batch in batches])
    np.testing.assert_array_equal(found, PIXELS)
    assert len(opened) == 2  # for the stamps, and for the images


def test_the_default_rate_is_said(bags):
    with pytest.warns(Note, match=r"walk.bag: took 3 of 30 frames, 1 per second .--fps"):
        assert open_source(bags / "walk.bag").names == [name("walk.bag", i) for i in (0, 10, 20)]


# What images may be


def bayer(pattern: str) -> np.ndarray:
    """A mosaic of one colour: whatever fills it in, it must come back."""
    tile = np.array([COLOUR["rgb".index(letter)] for letter in pattern]).reshape(2, 2)
    return np.tile(tile, (3, 4))


DEEP = np.arange(48, dtype=np.uint16).reshape(6, 8) * 1000
RED = np.tile(np.array([[90, 81], [240, 81]], np.uint8), (6, 4, 1))
"""Pairs of U, Y and V, Y: the red of ITU-R BT.601 in 8 bits."""


@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("rgb8", PIXELS[0], PIXELS[0]),
        ("bgr8", PIXELS[0], PIXELS[0, ..., ::-1]),
        ("8UC3", PIXELS[0], PIXELS[0, ..., ::-1]),
        ("rgba8", np.dstack([PIXELS[0], PIXELS[1, ..., 0]]), PIXELS[0]),
        ("bgra8", np.dstack([PIXELS[0], PIXELS[1, ..., 0]]), PIXELS[0, ..., ::-1]),
        ("mono8", PIXELS[0, ..., 0], PIXELS[0, ..., 0]),
        ("mono16", DEEP, DEEP),
        ("16UC1", DEEP, DEEP),
        ("rgb16", np.dstack([DEEP, DEEP + 1, DEEP + 2]), np.dstack([DEEP, DEEP + 1, DEEP + 2])),
        ("bgr16", np.dstack([DEEP, DEEP + 1, DEEP + 2]), np.dstack([DEEP + 2, DEEP + 1, DEEP])),
        ("32FC1", DEEP / np.float32(7), DEEP / np.float32(7)),
        ("bayer_rggb8", bayer("rggb"), np.tile(COLOUR, (6, 8, 1))),
        ("bayer_bggr8", bayer("bggr"), np.tile(COLOUR, (6, 8, 1))),
        ("bayer_gbrg8", bayer("gbrg"), np.tile(COLOUR, (6, 8, 1))),
        ("bayer_grbg8", bayer("grbg"), np.tile(COLOUR, (6, 8, 1))),
        ("yuv422", RED, np.tile([255, 0, 0], (6, 8, 1))),
        ("yuv422_yuy2", RED[..., ::-1], np.tile([255, 0, 0], (6, 8, 1))),
    ],
)
@pytest.mark.parametrize("big", [False, True])
def test_an_encoding(tmp_path, encoding, pixels, expected, big):
    """In rows with and without padding, and in both orders of bytes."""
    bag = write_bag(tmp_path / "walk.bag", [image(BEGIN, pixels, encoding, padding=5, big=big)])
    (path,) = open_source(bag, fps=1).paths
    found = read_pixels(path)
    assert found.dtype == expected.dtype or encoding.startswith("yuv")
    # Fixed-point arithmetic of YUV may be off by some levels; others are copied.
    np.testing.assert_allclose(found, expected, rtol=0, atol=3 if encoding.startswith("yuv") else 0)
    if encoding == "mono16":
        np.testing.assert_array_equal(read_image(path)[..., 1], DEEP // 256)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_compressed_image(tmp_path, suffix):
    data = cv2.imencode(suffix, cv2.resize(PIXELS[0], (64, 48)))[1].tobytes()
    message = compressed(BEGIN, data, "bgr8; jpeg compressed bgr8")
    bag = write_bag(tmp_path / "other.mcap", [message])
    (path,) = open_source(bag, fps=1).paths
    np.testing.assert_array_equal(read_pixels(path), decode_image(data, "a"))
    reduced = decode_image(data, "a", enough=(6, 8))
    np.testing.assert_array_equal(read_pixels(path, enough=(6, 8)), reduced)


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (image(BEGIN, PIXELS[0], "nv12"), "found an image of encoding 'nv12', expected one of"),
        (image(BEGIN, PIXELS[0], step=20), "found 144 bytes of 6 rows of 20, expected rows of"),
        (image(BEGIN, PIXELS[0], height=7), "found 144 bytes of 7 rows of 24, expected rows of"),
        (image(BEGIN, PIXELS[0], height=0), "found 144 bytes of 0 rows of 24, expected rows of"),
        (image(BEGIN, PIXELS[0, :, :7, :2], "yuv422"), r"t=1700000000.0+: found .*"),
        (compressed(BEGIN, b"\0" * 12, "compressedDepth png"), r"\('compressedDepth png'\): found"),
    ],
)
def test_an_image_that_cannot_be_decoded(tmp_path, message, words):
    bag = write_bag(tmp_path / "walk.mcap", [message, message._replace(logged=BEGIN + 1)])
    with pytest.warns(Note, match="left out 1 of 2 images"):  # of one stamp
        (path,) = open_source(bag, fps=1).paths
    with refused(words):
        read_image(path)
    with refused(words):
        list(open_log(bag).images())


# Topics and stamps

CAMERAS = (
    image(BEGIN, PIXELS[0], topic="/left"),
    image(BEGIN, PIXELS[1], topic="/right"),
    text(BEGIN),
)
LISTED = r"/left \(Image, 1\), /right \(Image, 1\)"


@pytest.mark.parametrize(
    ("messages", "topic", "words"),
    [
        (CAMERAS, None, f"found 2 topics of images, expected --topic with one of {LISTED}"),
        (CAMERAS, "/none", f"found --topic /none, expected a topic of images: {LISTED}"),
        (CAMERAS, "/chatter", f"found --topic /chatter, expected a topic of images: {LISTED}"),
        (CAMERAS[2:], None, r"found no topic of images among /chatter \(String, 1\), expected one"),
        (CAMERAS[2:], "/left", r"found no topic of images among /chatter \(String, 1\)"),
    ],
)
@pytest.mark.parametrize("form", ["walk.bag", "walk"])
def test_topics_are_listed_where_one_must_be_chosen(tmp_path, form, messages, topic, words):
    with refused(words):
        open_source(write_bag(tmp_path / form, messages), topic=topic)


def test_a_topic_is_chosen(tmp_path):
    bag = write_bag(tmp_path / "walk.bag", CAMERAS)
    (path,) = open_source(bag, topic="/right").paths
    assert path.as_posix().endswith("walk.bag#/right#t=1700000000.000000000")
    np.testing.assert_array_equal(read_image(path), PIXELS[1])
    np.testing.assert_array_equal(read_image(bag.parent / name("walk.bag", 0, "/left")), PIXELS[0])
    for flag in ({"topic": "/right"}, {"position_topic": "/gps"}):
        picture = tmp_path / "a.png"
        cv2.imwrite(str(picture), PIXELS[0])
        with refused("--(position-)?topic: found /.* without a ROS bag among the images"):
            open_sources(picture, **flag)


def test_stamps_that_are_zero_go_back_or_come_twice(tmp_path):
    """By hand: logged at 5, 6, 7, 8 and 9 s; stamps are none, 4, 3, 3 and 8 s."""
    stamps, logged = (0, 4, 3, 3, 8), (5, 6, 7, 8, 9)
    bag = write_bag(
        tmp_path / "walk.mcap",
        [
            image(stamp * SECOND, PIXELS[i], logged=when * SECOND)
            for i, (stamp, when) in enumerate(zip(stamps, logged, strict=True))
        ],
    )
    with pytest.warns(Note) as notes:
        source = open_source(bag, fps=1000)
    said = [str(note.message) for note in notes]
    assert "stamps of /camera/image_raw go back 2 times, by up to 1 s: its images are in" in said[0]
    assert "left out 1 of 5 images of /camera/image_raw, whose stamps repeat earlier" in said[1]
    assert [parse_frame(each).nanoseconds // SECOND for each in source.paths] == [3, 4, 5, 8]
    for path, number in zip(source.paths, (2, 1, 0, 4), strict=True):
        np.testing.assert_array_equal(read_image(path), PIXELS[number])


def test_names_of_frames():
    assert parse_frame("a#b.mp4#t=1.5")[:2] == ("a#b.mp4", None)
    assert parse_frame("a/walk#/cam#t=3") == ("a/walk", "/cam", 3 * SECOND)
    assert parse_frame("a/walk.jpg#t=3") is None
    assert parse_frame("a b/walk.bag#/a topic#t=3") is None
    # A simulation's clock begins at 0, and says nothing of another log's.
    assert moment_of("a.bag#/cam#t=12.000000000") == ("a.bag#/cam", 12.0)
    assert moment_of(name("a.bag", 5)) == ("", 1_700_000_000.5)


# Positions

FIXES = ((0, 50.0, 20.0), (1, 51.0, 22.0), (2, 50.0, 21.0))
"""Seconds after the first image, latitude and longitude."""


def positions_of(bag: pathlib.Path, **flags: str) -> dict[int, tuple[float, float]] | None:
    """Positions by tenths of a second."""
    source = open_source(bag, fps=1000, **flags)
    if source.positions is None:
        return None
    tenths = {each: (parse_frame(each).nanoseconds - BEGIN) // TENTH for each in source.names}
    return {tenths[each]: at for each, at in source.positions.of.items()}


@pytest.mark.parametrize("kind", ["Odometry", "PoseStamped", "PoseWithCovarianceStamped"])
@pytest.mark.parametrize("form", ["walk.bag", "other.mcap"])
def test_poses_are_interpolated(tmp_path, form, kind):
    track = [pose(BEGIN + when * SECOND, x, y, kind) for when, x, y in FIXES]
    bag = write_bag(tmp_path / form, [*walk(), *track])
    with pytest.warns(Note, match=r"/odom has positions of 21 of 30 images, 9 are outside its"):
        found = positions_of(bag)
    with pytest.warns(Note, match="/odom has positions of 3 of 3 images"):
        source = open_source(bag, fps=1)
    assert source.positions.axes == ("x", "y")
    times, xs, ys = np.transpose(FIXES)
    assert list(found) == list(range(21))
    tenths = np.arange(21) / 10
    expected = np.stack([np.interp(tenths, times, xs), np.interp(tenths, times, ys)], axis=1)
    # Seconds since 1970 in 64 bits are right to 2.4e-7.
    np.testing.assert_allclose(list(found.values()), expected, rtol=0, atol=1e-6)


def test_fixes_come_first_and_those_without_one_are_left_out(tmp_path):
    """Around 180 degrees of longitude; the fixes that count are at 0 s and 2 s."""
    messages = [
        *walk(),
        pose(BEGIN, 1.0, 2.0),
        fix(BEGIN, 0.0, 179.0),
        fix(BEGIN + 5 * TENTH, 9.0, 9.0, status=-1),
        fix(BEGIN + 6 * TENTH, float("nan"), 9.0),
        fix(BEGIN + 7 * TENTH, 91.0, 9.0),
        fix(BEGIN + 2 * SECOND, 2.0, -177.0),
    ]
    bag = write_bag(tmp_path / "walk.db3", messages)
    with pytest.warns(Note, match=r"/gps/fix has positions of 21 of 30 .*; the largest gap is 2 s"):
        found = positions_of(bag)
    # 4 degrees in 2 s: 180 after 0.5 s. As above, 2.4e-7 s.
    for tenth, expected in ((0, (0, 179)), (4, (0.4, 179.8)), (10, (1, -179)), (20, (2, -177))):
        assert found[tenth] == pytest.approx(expected, abs=1e-6)
    with pytest.warns(Note, match="/odom has positions of 1 of 30 images"):
        assert positions_of(bag, position_topic="/odom") == {0: (1.0, 2.0)}
    assert positions_of(bag, position_topic="none") is None
    listed = r"/gps/fix \(NavSatFix, 5\), /odom \(Odometry, 1\)"
    with refused(f"found --position-topic /gps, expected a topic of positions: {listed}"):
        positions_of(bag, position_topic="/gps")


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        ([pose(BEGIN, 1, 2), pose(BEGIN, 1, 2, topic="/a")], "took no .* from /a .*, /odom "),
        ([fix(BEGIN, 1, 2, status=-1)], "took no positions: /gps/fix has no message with a fix"),
        ([fix(BEGIN - SECOND, 1, 2)], "/gps/fix has positions of 0 of 30 images, 30 are outside"),
    ],
)
def test_a_note_says_why_there_are_no_positions(tmp_path, messages, words):
    bag = write_bag(tmp_path / "walk.bag", [*walk(), *messages])
    with pytest.warns(Note, match=words):
        assert positions_of(bag) is None


def test_a_named_topic_without_a_fix_is_refused(tmp_path):
    bag = write_bag(tmp_path / "walk.bag", [*walk(), fix(BEGIN, 1, 2, status=-1)])
    with refused("found no fix in /gps/fix, expected at least one"):
        positions_of(bag, position_topic="/gps/fix")


# Files

ZSTD = CompressionFormat.ZSTD


@pytest.mark.parametrize(
    ("form", "options"),
    [
        ("walk.bag", {"compression": (Writer1.CompressionFormat.LZ4,)}),
        ("walk.bag", {"compression": (Writer1.CompressionFormat.BZ2,)}),
        ("walk.mcap", {"compression": (CompressionMode.STORAGE, ZSTD)}),
        ("walk", {"compression": (CompressionMode.MESSAGE, ZSTD)}),
        ("walk", {"compression": (CompressionMode.FILE, ZSTD)}),
        ("other.mcap", {"compression": McapCompression.LZ4}),
        ("other.mcap", {"compression": McapCompression.NONE, "chunk_size": 100}),
    ],
)
def test_a_compressed_bag(tmp_path, form, options):
    paths = open_source(write_bag(tmp_path / form, walk(), **options), fps=10).paths
    np.testing.assert_array_equal(np.stack([read_image(path) for path in paths]), PIXELS)


@pytest.mark.parametrize("form", [form for form in FORMS if form != "walk"])
@pytest.mark.parametrize("share", [0, 0.001, 0.3, 0.9])
def test_a_cut_bag_is_one_line(bags, tmp_path, form, share):
    data = (bags / form).read_bytes()
    (tmp_path / form).write_bytes(data[: int(len(data) * share)])
    with refused(rf"{form}: found a log that cannot be read \(.*\), expected a ROS bag .* whole"):
        open_source(tmp_path / form)


def test_a_folder_without_its_files_is_one_line(bags, tmp_path):
    shutil.copytree(bags / "walk", tmp_path / "walk")
    (tmp_path / "walk" / "walk.mcap").unlink()
    with refused("walk: found a log that cannot be read .* files are missing"):
        open_source(tmp_path / "walk")


@pytest.mark.parametrize("form", ["walk.bag", "other.mcap"])
def test_changed_bytes_are_one_line_or_the_same_images(bags, tmp_path, form):
    """Every 97th byte, one after the other: no other error, and no other names."""
    data = (bags / form).read_bytes()
    names = open_source(bags / form, fps=10).names
    refusals = 0
    for place in range(0, len(data), 97):
        changed = bytearray(data)
        changed[place] ^= 0xFF
        (tmp_path / form).write_bytes(changed)
        try:
            source = open_source(tmp_path / form, fps=10)
            for path in source.paths:
                read_pixels(path)
        except InputError:
            refusals += 1
        else:
            assert form != "other.mcap" or source.names == names  # whose chunks have checksums
    assert refusals > 5


def test_what_is_no_log(tmp_path):
    with refused(r"none.bag: found no such file, expected a folder of images, an image, a video"):
        open_source(tmp_path / "none.bag")
    with refused(r"none.bag: found no such file, expected a ROS bag \(.mcap .bag .db3, or"):
        read_image(tmp_path / "none.bag#/cam#t=1")
    (tmp_path / "metadata.yaml").write_text("author: nobody")
    cv2.imwrite(str(tmp_path / "a.png"), PIXELS[0])
    assert open_source(tmp_path).names == ["a.png"]


def test_a_missing_extra_is_one_line(bags, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags", None)
    shutil.copy(bags / "walk.bag", bags / "third.bag")
    with refused(r"third.bag: found no module rosbags, expected it with the extra robot: pip"):
        open_source(bags / "third.bag")


def test_patterns_lists_and_the_folder_one_is_in(tmp_path, monkeypatch):
    forms, runs = ("a.bag", "b.mcap", "c"), tmp_path / "runs"
    runs.mkdir()
    for form in forms:
        write_bag(runs / form, walk()[:2])
    names = [name(form, tenths) for form in forms for tenths in (0, 1)]
    assert open_source(runs / "*", fps=10).names == names
    (tmp_path / "list.txt").write_text("runs/c\nruns/a.bag#/camera/image_raw#t=1700000000.05\n")
    listed = ["c", "c", "a.bag"]
    names = [f"runs/{name(form, i)}" for form, i in zip(listed, (0, 1, 1), strict=True)]
    assert open_source(tmp_path / "list.txt", fps=10).names == names
    (tmp_path / "table.csv").write_text("name,x,y\nruns/a.bag,1,2\n")
    with refused("table.csv: found the ROS bag .*a.bag, expected images or frames like walk.mp4#"):
        open_source(tmp_path / "table.csv")
    frame = "runs/a.bag#/camera/image_raw#t=1700000000.1"
    (tmp_path / "table.csv").write_text(f"name,x,y\n{frame},1,2\n")
    positions = open_source(tmp_path / "table.csv").positions
    assert positions.of == {f"runs/{name('a.bag', 1)}": (1.0, 2.0)}
    monkeypatch.chdir(tmp_path / "runs" / "c")
    assert open_source(".", fps=10).names == [name("c", 0), name("c", 1)]
    assert stored_bytes(tmp_path / "runs" / name("c", 0)) == sum(
        file.stat().st_size for file in (tmp_path / "runs" / "c").iterdir()
    )


def test_positions_of_several_logs(tmp_path):
    first = write_bag(tmp_path / "a.bag", [*walk()[:1], pose(BEGIN, 1, 2)])
    write_bag(tmp_path / "b.bag", [*walk()[:1], pose(BEGIN, 3, 4)])
    with pytest.warns(Note, match="/odom has positions of 1 of 1 images"):
        found = open_source(tmp_path / "*.bag", fps=1).positions
    assert found.of == {name("a.bag", 0): (1.0, 2.0), name("b.bag", 0): (3.0, 4.0)}
    write_bag(tmp_path / "c.bag", [*walk()[:1], fix(BEGIN, 3, 4)])
    with (
        pytest.warns(Note, match="has positions of"),
        refused("c.bag: found positions in lat, lon, expected x, y as in the logs before it"),
    ):
        open_source(tmp_path / "*.bag", fps=1)
    assert first.is_file()


def test_missing_logs_are_listed_to_be_skipped(bags):
    missing = ["gone.bag", "gone.bag#/cam#t=1.000000000"]
    (bags / "some.txt").write_text("\n".join([*missing, "walk"]))
    source = open_source(bags / "some.txt", fps=1, on_bad_image="skip")
    assert source.names[:2] == missing
    batches = image_batches(source.paths, image_size=(6, 8), batch_size=8, on_bad_image="skip")
    assert [batch.valid.sum() for batch in batches] == [3]
