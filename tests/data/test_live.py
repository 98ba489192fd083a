"""Images as they come: a folder that fills, and a camera, which is a video here."""

import contextlib
import os
import threading
import time

import cv2
import numpy as np
import pytest

import crisalad_jax.data.live
from crisalad_jax.data.images import read_image
from crisalad_jax.data.live import Camera, FolderWatch, LatestFrame
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note
from tests.conftest import write_picture, write_video
from tests.data.bags import BEGIN, SECOND, image, write_bag
from tests.data.benchmarks.trees import refused
from tests.data.test_sources import LEVELS


class Ended(Exception):
    """What a test's check raises."""


def until_idle(seconds: float):
    """A check that ends a watch after some seconds."""
    end = time.monotonic() + seconds

    def check() -> None:
        if time.monotonic() > end:
            raise Ended

    return check


def encoded(suffix: str, level: int) -> bytes:
    noise = np.random.default_rng(level).integers(0, 256, (40, 60, 3), np.uint8)
    return cv2.imencode(suffix, noise)[1].tobytes()


def test_a_watched_folder_gives_each_image_once_when_it_is_whole(tmp_path, monkeypatch):
    """Half-written files, slow writers, renamed files, subfolders; what was there is left out."""
    monkeypatch.setattr(crisalad_jax.data.live, "_SETTLED", 0.5)
    write_picture(tmp_path / "there.jpg", 0)
    watch = FolderWatch(tmp_path)
    assert (watch.there, watch.size, watch.dropped) == (1, None, 0)
    whole = {suffix: encoded(suffix, 1) for suffix in (".jpg", ".png", ".bmp")}

    def write() -> None:
        for suffix, data in whole.items():
            (tmp_path / f"half{suffix}").write_bytes(data[: len(data) // 2])
        time.sleep(0.25)  # polls of 0.05 s see the halves
        for suffix, data in whole.items():
            with (tmp_path / f"half{suffix}").open("ab") as file:
                file.write(data[len(data) // 2 :])
        (tmp_path / "sub").mkdir()
        (tmp_path / "sub" / ".part.png").write_bytes(whole[".png"])
        (tmp_path / "sub" / ".part.png").rename(tmp_path / "sub" / "moved.png")
        os.utime(tmp_path / "half.jpg")  # a later time of change is no new image
        os.utime(tmp_path / "there.jpg")

    writer = threading.Thread(target=write)
    writer.start()
    found = {}
    over = until_idle(20)

    def check() -> None:  # a moment after the fourth, for what would come twice
        if len(found) == 4 and time.perf_counter() > last + 0.3:
            raise Ended
        over()

    with contextlib.suppress(Ended):
        for frame in watch.frames(check):
            last = time.perf_counter()
            assert frame.name not in found
            found[frame.name] = frame
    writer.join()
    names = ("half.jpg", "half.png", "half.bmp", "sub/moved.png")
    assert set(found) == set(names)
    for name, frame in found.items():
        np.testing.assert_array_equal(frame.image, read_image(tmp_path / name))
        assert frame.taken <= time.perf_counter()
    bmp = tmp_path / "half.bmp"
    assert found["half.bmp"].time == bmp.stat().st_mtime


def test_several_come_by_their_time_of_change(tmp_path):
    watch = FolderWatch(tmp_path)
    for number, name in enumerate(("c.png", "a.png", "b.png")):
        write_picture(tmp_path / name, number)
        os.utime(tmp_path / name, (1000 + number, 1000 + number))
    frames = watch.frames()
    found = [next(frames) for _ in range(3)]
    assert [(frame.name, frame.time) for frame in found] == [
        *(("c.png", 1000.0), ("a.png", 1001.0), ("b.png", 1002.0))
    ]


def test_a_file_that_stays_unreadable_is_left_out_with_a_note(tmp_path, monkeypatch):
    monkeypatch.setattr(crisalad_jax.data.live, "_PATIENCE", 0.3)
    watch = FolderWatch(tmp_path)
    (tmp_path / "bad.jpg").write_bytes(b"none")
    (tmp_path / "empty.png").touch()
    with pytest.warns(Note) as notes, pytest.raises(Ended):
        next(watch.frames(until_idle(1)))
    told = sorted(str(note.message) for note in notes)
    assert len(told) == 2
    assert "bad.jpg: found 4 bytes that do not decode" in told[0]
    assert "empty.png: found an empty file" in told[1]
    assert all(line.endswith("; it is left out") for line in told)


def test_a_video_plays_as_a_camera(tmp_path):
    """Whatever is passed over: times and levels agree, and the last frame is answered."""
    video = write_video(tmp_path / "a.avi", 8)
    begun = time.perf_counter()
    with Camera(video) as camera:
        assert camera.size == (48, 64)
        found = list(camera.frames())
    assert found[-1].time == 0.7
    assert len(found) + camera.dropped == len(found) + sum(frame.dropped for frame in found) == 8
    for frame in found:
        assert frame.name == f"{video.name}#t={frame.time:.3f}"
        assert frame.image.mean() == pytest.approx(100 * frame.time, abs=LEVELS)
        # At its own pace: never before its time. Clocks differ by far less than a frame.
        assert frame.taken - begun > frame.time - 0.01


def test_only_the_newest_frame_is_given(tmp_path):
    """Who is busy for four frames' time misses three of them, and gets none late."""
    video = write_video(tmp_path / "a.avi", 12)
    with Camera(video) as camera:
        frames = camera.frames()
        first = next(frames)
        time.sleep(0.45)
        begun = time.perf_counter()
        second = next(frames)
        # Of the four since then, one or two fewer on a busy machine.
        assert second.time >= first.time + 0.2
        assert camera.dropped >= 1
        # Never one that waited: a frame's time, and some for a busy machine.
        assert begun - second.taken < 0.4


def test_a_camera_at_a_rate(tmp_path):
    with Camera(write_video(tmp_path / "a.avi", 7), fps=4) as camera:
        given = [time.monotonic() for _ in camera.frames()]
    # Sleeping is never shorter than asked for, but for the clock's resolution.
    assert np.diff(given).min() > 0.25 - 0.01
    assert len(given) + camera.dropped == 7
    assert camera.dropped >= 1


def test_a_file_plays_at_a_rate(tmp_path):
    """Ten frames a second at half the rate are five: never before their time."""
    begun = time.perf_counter()
    with Camera(write_video(tmp_path / "a.avi", 5), rate=0.5) as camera:
        slow = [(frame.time, frame.taken - begun) for frame in camera.frames()]
    assert all(taken > 2 * at - 0.01 for at, taken in slow)
    assert slow[-1][0] == 0.4


def test_frames_of_several_threads_are_given_or_counted():
    """Four writers and a slow reader: whatever the order, none is lost."""
    latest = LatestFrame()
    image = np.zeros((2, 2, 3), np.uint8)

    def write(writer: int) -> None:
        for number in range(50):
            latest.put(image, number, f"{writer}-{number}")
            time.sleep(0.0005)

    writers = [threading.Thread(target=write, args=(writer,)) for writer in range(4)]
    for writer in writers:
        writer.start()
    threading.Thread(target=lambda: [*(each.join() for each in writers), latest.close()]).start()
    names, passed = [], 0
    for frame in latest.frames():
        names.append(frame.name)
        passed += frame.dropped
        time.sleep(0.002)
    assert len(names) + passed == len(names) + latest.dropped == 200
    assert len(set(names)) == len(names) > 1


def bag_of(path, levels, step=50_000_000, **more):
    """A bag of flat images, so many nanoseconds apart."""
    flat = [np.full((4, 6, 3), level, np.uint8) for level in levels]
    return write_bag(path, [image(BEGIN + step * n, each, **more) for n, each in enumerate(flat)])


@pytest.mark.parametrize("form", ["walk", "walk.mcap", "walk.bag"])
def test_a_log_plays_at_its_own_pace(tmp_path, form):
    """Each frame is given or counted, and none before its time."""
    bag = bag_of(tmp_path / form, range(12))
    begun = time.perf_counter()
    with Camera(bag, rate=2) as camera:
        assert camera.size == (4, 6)
        found = list(camera.frames())
    assert len(found) + sum(frame.dropped for frame in found) == 12
    assert sum(frame.dropped for frame in found) == camera.dropped
    for frame in found:
        level = int(frame.image[0, 0, 0])
        stamp = BEGIN + 50_000_000 * level
        seconds, rest = divmod(stamp, SECOND)
        assert frame.name == f"{form}#/camera/image_raw#t={seconds}.{rest:09d}"
        assert frame.time == stamp / SECOND
        # Of two clocks, which differ by far less than a frame.
        assert frame.taken - begun > 0.05 * level / 2 - 0.01
    assert found[-1].image[0, 0, 0] == 11


def test_the_topic_of_a_log_is_chosen(tmp_path):
    two = [image(BEGIN, np.full((4, 6, 3), n, np.uint8), topic=f"/{n}") for n in (7, 9)]
    bag = write_bag(tmp_path / "two.mcap", two)
    with Camera(bag, topic="/9") as camera:
        (frame,) = camera.frames()
    assert (frame.image[0, 0, 0], frame.name.split("#")[1]) == (9, "/9")
    for topic in (None, "/8"):
        with pytest.raises(
            InputError, match=r"two\.mcap: found .*/7 \(Image, 1\), /9 \(Image, 1\)"
        ):
            Camera(bag, topic=topic)
    with refused("topic: found /9 with camera-0, expected a robot log"):
        Camera(0, topic="/9")


def test_what_is_wrong_in_a_log_is_raised_where_frames_are_asked_for(tmp_path):
    """Not in the thread that plays it: the frames before it come first."""
    good = image(BEGIN, np.zeros((4, 6, 3), np.uint8))
    bad = image(BEGIN + 1, np.zeros((4, 6, 3), np.uint8), "nv21")
    with Camera(write_bag(tmp_path / "a.mcap", [good, bad])) as camera:
        frames = camera.frames()
        assert next(frames).name.endswith(".000000000")
        with pytest.raises(InputError, match="found an image of encoding 'nv21'"):
            next(frames)


@pytest.mark.parametrize("rate", [0, -1, float("inf"), float("nan")])
def test_a_rate_that_nothing_plays_at(tmp_path, rate):
    with refused(f"rate: found {rate:g}, expected more than 0"):
        Camera(write_video(tmp_path / "a.avi", 2), rate=rate)


def test_a_camera_ends_when_it_is_told_to(tmp_path):
    def stop() -> None:
        raise Ended

    with Camera(write_video(tmp_path / "a.avi", 30)) as camera, pytest.raises(Ended):
        next(camera.frames(stop))
    assert not camera._thread or not camera._thread.is_alive()


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (str(2**31), "camera: found no frame from camera-2147483648,"),
        ("97", "camera: found no frame from camera-97, expected a number from 0, a URL or a video"),
        ("http://u:pass@127.0.0.1:9/x?pass@#x", "found no frame from http://127.0.0.1:9/x, exp"),
        ("{here}/text.avi", "text.avi, expected a number from 0"),
    ],
)
def test_no_camera_and_no_folder_is_one_line(tmp_path, camera, words, capfd):
    (tmp_path / "text.avi").write_text("text")
    for name, kind in (("none", "nothing"), ("text.avi", "a file")):
        with refused(f"{name}: found {kind}, expected a folder to watch"):
            FolderWatch(tmp_path / name)
    with pytest.raises(InputError, match=words) as error:
        Camera(camera.format(here=tmp_path))
    assert "pass@" not in str(error.value)
    assert capfd.readouterr() == ("", "")
