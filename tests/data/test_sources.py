"""Sources of images: what each form lists, names and knows of positions, and what is refused."""

import itertools
import pathlib
import shutil

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from crisalad_jax.data.images import list_images, read_image
from crisalad_jax.data.live import Camera
from crisalad_jax.data.positions import Positions, exif_position, read_image_table
from crisalad_jax.data.reading import image_batches
from crisalad_jax.data.sources import open_source
from crisalad_jax.data.video import list_frames
from crisalad_jax.utils.errors import InputError
from tests.conftest import write_picture, write_video
from tests.data.benchmarks.trees import refused

LEVELS = 3
"""Largest difference from the grey that was written, of 256: MJPG is lossy, and flat frames
change by rounding alone."""


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> pathlib.Path:
    """Files to read only: run/left/{0,1}.png, run/right/2.jpg, run/walk.avi of 25 frames."""
    folder = tmp_path_factory.mktemp("sources")
    for number, name in enumerate(("left/0.png", "left/1.png", "right/2.jpg")):
        write_picture(folder / "run" / name, number)
    write_video(folder / "run" / "walk.avi", 25)
    (folder / "run" / "notes.md").write_text("no image")
    return folder


def grey(path: pathlib.Path) -> float:
    return float(np.mean(read_image(path)))


def test_a_folder_and_a_file(root):
    source = open_source(root / "run")
    assert (source.root, source.positions) == (root / "run", None)
    assert source.names == ["left/0.png", "left/1.png", "right/2.jpg"]
    assert source.paths == list_images(root / "run")
    one = root / "run" / "left" / "1.png"
    assert open_source(str(one)) == (one.parent, [one], ["1.png"], None)


@pytest.mark.parametrize(
    ("pattern", "inside", "names"),
    [
        ("run/left/*.png", "run/left", ["0.png", "1.png"]),
        ("run/*/*", "run", ["left/0.png", "left/1.png", "right/2.jpg"]),
        ("run/**/[12].*", "run", ["left/1.png", "right/2.jpg"]),
        ("*/*.avi", "", [f"run/walk.avi#t={second}.000" for second in range(3)]),
    ],
)
def test_a_pattern_is_relative_to_what_stands_before_it(root, pattern, inside, names):
    source = open_source(root / pattern)
    assert source.root == root / inside
    assert source.names == names
    assert source.paths == [source.root / name for name in names]


def test_a_name_with_wildcards_that_is_there_is_no_pattern(tmp_path):
    write_picture(tmp_path / "a[1].png", 0)
    assert open_source(tmp_path / "a[1].png").names == ["a[1].png"]


def test_a_list_of_images_videos_and_frames(root, tmp_path):
    """With a byte order mark, Windows' ends of lines and an empty line."""
    work = tmp_path / "work"
    shutil.copytree(root / "run", work)
    lines = ["left/../left/1.png", "", " walk.avi#t=1.200 ", "right/2.jpg"]
    (work / "list.txt").write_bytes(("\ufeff" + "\r\n".join(lines)).encode())
    source = open_source(work / "list.txt")
    assert source.root == work
    assert source.names == ["left/1.png", "walk.avi#t=1.200", "right/2.jpg"]
    (work / "list.txt").write_text("walk.avi\n")
    assert open_source(work / "list.txt", fps=2).names == [
        f"walk.avi#t={time:.3f}" for time in (0, 0.5, 1, 1.5, 2)
    ]


def test_a_list_that_leads_out_of_its_folder_is_named_from_the_top(root, tmp_path, monkeypatch):
    out = root / "run" / "left" / "0.png"
    (tmp_path / "list.txt").write_text(f"{out}\na.png\n")
    write_picture(tmp_path / "a.png", 1)
    top = pathlib.Path(out.anchor)
    names = [path.relative_to(top).as_posix() for path in (out, tmp_path / "a.png")]
    assert open_source(tmp_path / "list.txt")[:3] == (top, [out, tmp_path / "a.png"], names)
    # From the working folder, too, and from one beside it.
    (tmp_path / "beside").mkdir()
    (tmp_path / "beside" / "b.txt").write_text("../a.png\n")
    monkeypatch.chdir(tmp_path)
    assert open_source("beside/b.txt").names == names[1:]
    monkeypatch.chdir(tmp_path / "beside")
    (tmp_path / "list.txt").write_text("a.png\n")
    assert open_source("../list.txt").names == ["a.png"]
    assert open_source("b.txt").names == names[1:]


@pytest.mark.parametrize(
    ("text", "axes", "of"),
    [
        ("name,lat,lon\nleft/0.png,52.5,-1\n", ("lat", "lon"), {"left/0.png": (52.5, -1.0)}),
        (
            '\ufeffname; north ;east;note\n"left/0.png";"4,5";-1e2;"a;b"\nright/2.jpg;;;\n',
            ("east", "north"),
            {"left/0.png": (-100.0, 4.5)},
        ),
        ("x,name,y\n1,left/../left/1.png,2\n", ("x", "y"), {"left/1.png": (1.0, 2.0)}),
        ("lat,lon,x,y,name\n1,2,3,4,left/1.png\n", ("lat", "lon"), {"left/1.png": (1.0, 2.0)}),
        ("name,lat,lon\nleft/1.png,,\n", None, None),
    ],
)
def test_a_table(root, tmp_path, text, axes, of):
    shutil.copytree(root / "run", tmp_path, dirs_exist_ok=True)
    (tmp_path / "poses.csv").write_text(text, encoding="utf-8")
    source = open_source(tmp_path / "poses.csv")
    assert source.root == tmp_path
    assert source.positions == (None if of is None else Positions(axes, of))
    if of is not None:
        assert set(of) <= set(source.names)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("none", None, "none: found no such file, expected a folder of images, an image, a video"),
        ("*.gif", None, r"\*.gif: found no image, expected files that end in .jpg"),
        ("run/*.md", None, "found no image among 1 .md"),
        ("a.txt", "\n\n", "a.txt: found no image, expected images"),
        ("a.txt", "b.png\n", "a.txt: .*b.png: found no such file, expected an image file"),
        ("a.txt", "\n{run}/left/0.png\n{run}/right/../left/0.png", "a.txt: found .*0.png' twice"),
        ("a.txt", "{run}\n", "a.txt: .*run: found a folder, expected an image file"),
        ("a.csv", "name\n", "a.csv: found no image, expected images"),
        ("a.csv", "name,year\n,1\n", "line 2: found no name, expected one"),
        ("a.csv", "name;lat;lon\n{run}/left/0.png;1.000,5;2\n", "lat: found '1.000,5', expected"),
        ("a.csv", "name,x,x,y\n", "found columns name, x, x, y, expected each once"),
        ("a.csv", "name,x,y\n{run}/walk.avi,1,2\n", "found the video .*walk.avi, expected images"),
        ("a.mp4", "text", "a.mp4: found no frame, expected a video"),
        ("a.mp4#t=1.000", None, "a.mp4: found no such file"),
    ],
)
def test_a_bad_source_is_one_line(root, tmp_path, name, text, words, capfd):
    source = tmp_path / name
    if text is not None:
        source.write_text(text.format(run=root / "run"))
    elif name.startswith("run"):
        source = root / name
    with refused(words):
        open_source(source)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("fps", [0, float("nan"), 1001])
def test_a_rate_out_of_range_is_refused(root, fps):
    with pytest.raises(InputError, match=f"fps: found {fps:g}, expected more than 0, and at most"):
        open_source(root / "run" / "walk.avi", fps=fps)


# Videos


@pytest.mark.parametrize(
    ("fps", "frames"),
    [
        (1, [0, 10, 20]),
        (4, [0, 3, 5, 8, 10, 13, 15, 18, 20, 23]),
        (1000, [*range(25)]),
    ],
)
def test_frames_are_the_first_after_each_step(root, fps, frames):
    """Frame i of 10 a second is at 0.1 i seconds, and is grey of level 10 i."""
    video = root / "run" / "walk.avi"
    found = list_frames(video, fps)
    assert [path.name for path in found] == [f"walk.avi#t={i / 10:.3f}" for i in frames]
    np.testing.assert_allclose([grey(path) for path in found], np.multiply(10, frames), atol=LEVELS)


def test_frames_in_any_order_and_times_between_them(root):
    video = root / "run" / "walk.avi"
    for time, level in ((2.4, 240), (0.0, 0), (1.5, 150), (1.5, 150), (1.41, 150), (0.05, 10)):
        assert grey(pathlib.Path(f"{video}#t={time}")) == pytest.approx(level, abs=LEVELS)
    with refused(r"walk\.avi#t=2\.500: found no frame there, expected a time"):
        read_image(f"{video}#t=2.5")
    with pytest.raises(InputError, match=r"none\.avi: found no such file, expected a video"):
        read_image(f"{video.with_name('none.avi')}#t=0")


def test_a_frame_has_one_name_however_it_is_written(root, tmp_path):
    """Frames are 0.1 s apart; of a time between two, the later one is read."""
    video = root / "run" / "walk.avi"
    for written in ("1.2", "1.20000", "1.15", "01.2", "1.1004"):
        expected = 1.1 if written == "1.1004" else 1.2  # names have milliseconds
        assert open_source(f"{video}#t={written}").names == [f"walk.avi#t={expected:.3f}"]
    assert open_source(f"{video}#t=9").names == ["walk.avi#t=9.000"]  # is told where it is read
    work = pathlib.Path(shutil.copytree(root / "run", tmp_path / "run"))
    (work / "list.txt").write_text("walk.avi#t=1.2\nwalk.avi#t=1.15\n")
    with pytest.raises(InputError, match=r"found 'walk\.avi#t=1\.200' twice, expected it once"):
        open_source(work / "list.txt")
    (work / "table.csv").write_text("name,x,y\nwalk.avi#t=0.15,1,2\n")
    named = Positions(("x", "y"), {"walk.avi#t=0.200": (1, 2)})
    assert open_source(work / "table.csv").positions == named
    (work / "positions.csv").write_text("name,x,y\nwalk.avi#t=0.2,1,2\n")
    assert read_image_table(work / "positions.csv")[1].of == {"walk.avi#t=0.200": (1, 2)}


def test_a_camera_and_a_list_call_a_frame_the_same(tmp_path):
    """At 80 frames a second, every other time is half a millisecond, which rounds to even."""
    video = write_video(tmp_path / "fast.avi", 4, rate=80)
    names = [path.name for path in list_frames(video, 1000)]
    with Camera(video) as camera:
        live = [frame.name for frame in camera.frames()]
    assert names == [f"fast.avi#t=0.{milliseconds:03d}" for milliseconds in (0, 12, 25, 38)]
    assert {pathlib.Path(name).name for name in live} <= set(names)
    assert pathlib.Path(live[-1]).name == names[-1]


def test_a_video_that_changes_is_read_again(tmp_path):
    write_video(tmp_path / "a.avi", 3)
    assert grey(tmp_path / "a.avi#t=0.200") == pytest.approx(20, abs=LEVELS)
    write_video(tmp_path / "a.avi", 4, step=40)
    assert grey(tmp_path / "a.avi#t=0.200") == pytest.approx(80, abs=LEVELS)


def test_colours_keep_their_places(tmp_path):
    write_video(tmp_path / "a.avi", 1, colour=(0, 0, 1), step=200, first=1)
    red, green, blue = read_image(tmp_path / "a.avi#t=0").mean(axis=(0, 1))
    # OpenCV writes blue first, so the last channel is red. Colours of JPEG are halved in size and
    # rounded: some levels.
    assert (red, green, blue) == (pytest.approx(200, abs=8), *(2 * [pytest.approx(0, abs=8)]))


def test_a_video_in_batches(root):
    """Two videos and a photograph; every batch in order, by whatever number of threads."""
    video = root / "run" / "walk.avi"
    paths = [*list_frames(video, 5), root / "run" / "right" / "2.jpg", *list_frames(video, 2)]
    batches = image_batches(paths, image_size=(14, 14), batch_size=4, threads=3)
    images = itertools.chain.from_iterable(batch.images[batch.valid] for batch in batches)
    found = [float(image.mean()) for image in images]
    del found[13]
    expected = [*range(0, 250, 20), *range(0, 250, 50)]
    np.testing.assert_allclose(found, expected, atol=LEVELS)


# EXIF


def write_jpeg(path: pathlib.Path, **gps: object) -> pathlib.Path:
    """A JPEG whose GPS fields are by Pillow; N 52 13 46.56, E 21 0 45 where nothing is said."""
    fields = {1: "N", 2: (52.0, 13.0, 46.56), 3: "E", 4: (21.0, 0.0, 45.0)}
    fields |= {int(name[1:]): value for name, value in gps.items()}
    image = Image.fromarray(np.zeros((8, 8, 3), np.uint8))
    exif = Image.Exif()
    exif.get_ifd(0x8825).update({key: value for key, value in fields.items() if value is not None})
    image.save(path, exif=exif)
    return path


@pytest.mark.parametrize(
    ("gps", "expected"),
    [
        ({}, (52 + 13 / 60 + 46.56 / 3600, 21 + 45 / 3600)),
        ({"_1": "S", "_3": "W"}, (-(52 + 13 / 60 + 46.56 / 3600), -(21 + 45 / 3600))),
        ({"_2": (52.229, 0.0, 0.0)}, (52.229, 21.0125)),
        ({"_9": "V"}, None),
        ({"_1": "Q"}, None),
        ({"_2": (0.0, 0.0, 0.0), "_4": (0.0, 0.0, 0.0)}, None),
        ({"_2": (91.0, 0.0, 0.0)}, None),
        ({"_2": (IFDRational(0, 0), 0.0, 0.0)}, None),
    ],
)
def test_exif_says_where(tmp_path, gps, expected):
    found = exif_position(write_jpeg(tmp_path / "a.jpg", **gps))
    # Fractions are written as ratios of integers of 32 bits.
    assert found == (None if expected is None else pytest.approx(expected, abs=1e-6))


def test_no_exif_is_no_position(root, tmp_path):
    for path in (*list_images(root / "run"), root / "run" / "notes.md", tmp_path / "none.jpg"):
        assert exif_position(path) is None
    data = write_jpeg(tmp_path / "a.jpg").read_bytes()
    place = data.index(b"Exif")
    (tmp_path / "b.jpg").write_bytes(data[: place + 30] + b"\xff" * 60 + data[place + 90 :])
    assert exif_position(tmp_path / "b.jpg") is None
    assert cv2.imread(str(tmp_path / "b.jpg")) is not None


def test_missing_files_are_listed_to_be_skipped(root, tmp_path):
    """An image, a video and a frame of one that are not there, and a folder in place of a file."""
    missing = ["gone.jpg", "gone.avi", "gone.avi#t=1.000", "run/left"]
    there = root / "run" / "right" / "2.jpg"
    lines = [*missing, str(there)]
    (root / "some.txt").write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"some.txt: .*gone.jpg: found no such file"):
        open_source(root / "some.txt")
    source = open_source(root / "some.txt", on_bad_image="skip")
    assert source.names == [*missing, "run/right/2.jpg"]
    (root / "some.csv").write_text("name,x,y\n" + "".join(f"{line},1,2\n" for line in missing[::2]))
    source = open_source(root / "some.csv", on_bad_image="skip")
    assert source.positions[:2] == (("x", "y"), dict.fromkeys(missing[::2], (1.0, 2.0)))
    assert open_source(root / "gone.jpg", on_bad_image="skip").names == ["gone.jpg"]
    batches = image_batches(source.paths, image_size=(9, 9), batch_size=2, on_bad_image="skip")
    assert [batch.valid.tolist() for batch in batches] == [[False, False]]
