"""Sources of images and live queries on the command line."""

import json
import pathlib
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from crisalad_jax.checkpoints.weights import save_weights
from crisalad_jax.data.images import list_images
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.descriptor_files import read_descriptors
from crisalad_jax.retrieval.maps.map import Map
from tests.cli.test_cli import extract, fails, runs, succeeds
from tests.cli.test_index import index, query
from tests.conftest import BATCH, random_params, write_video
from tests.data.bags import BEGIN, SECOND, fix, image, write_bag
from tests.data.test_sources import write_jpeg
from tests.retrieval.maps.test_stores import ROUNDING
from tests.training.test_vocabulary import ANYLOC


@pytest.fixture(scope="module")
def images(tmp_path_factory) -> pathlib.Path:
    """Two JPEGs with EXIF positions, N 52.2296 E 21.0125 and S."""
    folder = tmp_path_factory.mktemp("images")
    write_jpeg(folder / "a.jpg")
    write_jpeg(folder / "b.jpg", _1="S")
    return folder


def positions(folder: pathlib.Path) -> dict[str, tuple[float, float] | None]:
    with Map.open(folder) as places:
        return {image.name: image.position for image in places.images}


def test_positions_are_of_the_flag_the_table_names_or_exif(shared, images, tmp_path, capfd):
    exif = {
        name: (pytest.approx(sign * 52.2296, abs=1e-6), pytest.approx(21.0125, abs=1e-6))
        for name, sign in (("a.jpg", 1), ("b.jpg", -1))  # 1e-6: ratios of integers of 32 bits
    }
    said = succeeds(capfd, *index(shared, images, tmp_path / "exif"))
    assert "2 images added, 2 with positions" in said
    assert positions(tmp_path / "exif") == exif

    work = tmp_path / "work"
    shutil.copytree(images, work)
    (work / "poses.csv").write_text("name;x;y\na.jpg;1,5;2\nb.jpg;;\n")
    said = succeeds(capfd, *index(shared, work / "poses.csv", tmp_path / "table"))
    assert "2 images added, 1 with positions" in said
    assert positions(tmp_path / "table") == {"a.jpg": (1.5, 2.0), "b.jpg": None}

    (work / "more.csv").write_text("name,lat,lon\nb.jpg,3,4\n")
    flags = ("--positions", work / "more.csv")
    succeeds(capfd, *index(shared, work / "poses.csv", tmp_path / "flag", *flags))
    assert positions(tmp_path / "flag") == {"a.jpg": None, "b.jpg": (3.0, 4.0)}

    # A table without positions leaves them to EXIF; a map of metres leaves EXIF out, with a note.
    (work / "names.csv").write_text("name\nb.jpg\n")
    succeeds(capfd, *index(shared, work / "names.csv", tmp_path / "names"))
    assert positions(tmp_path / "names") == {"b.jpg": exif["b.jpg"]}
    shutil.copy(work / "a.jpg", work / "new.jpg")
    _, error = runs(capfd, *index(shared, work / "new.jpg", tmp_path / "table"))
    assert "left out the EXIF positions of 1 images, expected x, y as in the map" in error
    assert positions(tmp_path / "table")["new.jpg"] is None


@pytest.mark.slow  # five commands, for one error
def test_a_rate_without_a_video_is_refused(shared, images, town_map, tmp_path, capfd, weights):
    words = ("--fps: found 2 without a video among the images, expected both",)
    out = ("--out", tmp_path / "out.npy")
    common = ("--weights", weights, "--images", images, "--quiet")
    fails(capfd, "extract", *common, *out, "--fps", 2, words=words)
    fails(capfd, *index(shared, images, tmp_path / "map", "--fps", 2), words=words)
    fails(capfd, *query(town_map, images, "--fps", 2), words=words)
    target = ("--out", tmp_path / "v.safetensors")
    fails(capfd, "vocabulary", "--images", images, *target, "--fps", 2, words=words)
    assert not list(tmp_path.iterdir())
    # One video among several sources is enough.
    video = write_video(tmp_path / "walk.avi", 21)
    assert "walk.avi#t=0.500" in succeeds(
        capfd, *query(town_map, images, video, "--fps", 2, "--json", "-")
    )


def test_a_video_is_extracted_and_described_as_its_frames(tmp_path, capfd, weights):
    video = write_video(tmp_path / "walk.avi", 21)
    common = ("--weights", weights, "--batch-size", BATCH, "--quiet")
    out = tmp_path / "d.npy"
    succeeds(capfd, "extract", "--images", video, "--fps", 2, "--out", out, *common)
    names, descriptors = read_descriptors(out)
    assert names == [f"walk.avi#t={time:.3f}" for time in (0, 0.5, 1, 1.5, 2)]
    record = json.loads((tmp_path / "d.npy.json").read_text())
    assert (record["images"], record["fps"]) == (str(video), 2)
    # The same frames by name, in another order.
    (tmp_path / "list.txt").write_text("\n".join(reversed(names)))
    succeeds(
        capfd, "extract", "--images", tmp_path / "list.txt", "--out", tmp_path / "e.npy", *common
    )
    again, found = read_descriptors(tmp_path / "e.npy")
    assert again == names[::-1]
    # float32 sums of other batches.
    np.testing.assert_allclose(found[::-1], descriptors, atol=ROUNDING)


def test_a_robot_log_is_indexed_with_positions_and_queried(shared, tmp_path, capfd):
    """Two cameras and a receiver; the map's images are found again in the same walk as a folder."""
    pictures = np.random.default_rng(0).integers(0, 256, (4, 60, 80, 3), np.uint8)
    walk = [
        message
        for second, picture in enumerate(pictures)
        for message in (
            image(BEGIN + second * SECOND, picture, topic="/left"),
            image(BEGIN + second * SECOND, picture[::-1], topic="/right"),
            fix(BEGIN + second * SECOND, 52 + second / 1000, 21.0),
        )
    ]
    bag, out = write_bag(tmp_path / "walk.bag", walk), tmp_path / "map"
    words = ("found 2 topics of images, expected --topic with one of /left (Image, 4), /right",)
    fails(capfd, *index(shared, bag, out), words=words)
    said, notes = runs(capfd, *index(shared, bag, out, "--topic", "/left", "--fps", 10))
    assert "4 images added, 4 with positions" in said
    assert notes.endswith("/gps/fix has positions of 4 of 4 images; the largest gap is 0 s\n")
    names = [f"walk.bag#/left#t={(BEGIN // SECOND) + second}.000000000" for second in range(4)]
    assert positions(out) == {name: (52 + i / 1000, 21.0) for i, name in enumerate(names)}
    flags = ("--topic", "/left", "--position-topic", "none")
    assert "4 were there already" in succeeds(capfd, *index(shared, bag, out, *flags))

    folder = write_bag(tmp_path / "walk", walk)
    flags = ("--topic", "/left", "--k", 1, "--json", "-")
    lines = runs(capfd, *query(out, folder, *flags))[0].splitlines()
    for line, name in zip(lines, names, strict=True):
        answer = json.loads(line)
        assert (answer["query"], answer["time"]) == (
            name.replace("walk.bag", "walk"),
            answer["neighbours"][0]["time"],
        )
        assert answer["neighbours"][0]["name"] == name
        assert answer["neighbours"][0]["similarity"] == pytest.approx(1, abs=ROUNDING)

    more = image(BEGIN + 9 * SECOND, pictures[0], topic="/left")
    write_bag(bag.with_name("longer.bag"), [*walk, more]).replace(bag)
    words = (f"but the map has '{names[0]}' of", "expected new names for new images")
    flags = ("--topic", "/left", "--position-topic", "none", "--fps", 10)
    fails(capfd, *index(shared, bag, out, *flags), words=words)


def test_a_pattern_and_a_window_of_queries(town_map, tmp_path, capfd, queries):

    def answers(*flags: object) -> list[dict]:
        out = tmp_path / "answers.jsonl"
        succeeds(capfd, *query(town_map, queries / "*.jpg", "--k", 1, "--json", out, *flags))
        return [json.loads(line) for line in out.read_text().splitlines()]

    lines, together = answers(), answers("--window", 3)
    assert len(lines) == len(list_images(queries))
    alone, similar = (
        [line["neighbours"][0]["similarity"] for line in each] for each in (lines, together)
    )
    assert similar[0] == pytest.approx(alone[0], abs=ROUNDING + 1e-6)  # nothing is before it
    assert np.abs(np.subtract(similar, alone))[1:].max() > 1000 * ROUNDING


def test_the_default_rate_of_a_video_is_said(shared, town_map, tmp_path, capfd):
    """Of 21 frames in 2.1 seconds three are taken: at 0, 1 and 2 s."""
    video = write_video(tmp_path / "walk.avi", 21)
    said = f"crisalad: note: {video}: took 3 of 21 frames, 1 per second (--fps)\n"
    start, out = tmp_path / "start.safetensors", tmp_path / "v.safetensors"
    save_weights(start, Model(random_params(ANYLOC), ANYLOC))
    verbs = (
        extract(shared, video, tmp_path / "d.npy"),
        index(shared, video, tmp_path / "map"),
        query(town_map, video),
        ("vocabulary", "--images", video, "--weights", start, "--out", out, "--quiet"),
    )
    for verb in verbs:
        assert runs(capfd, *verb)[1] == said
    # Of two videos in a list, together; nothing where a rate is given, or all are taken.
    write_video(tmp_path / "slow.avi", 3, rate=1)
    (tmp_path / "list.txt").write_text("walk.avi\nslow.avi\n")
    _, error = runs(capfd, *query(town_map, tmp_path / "list.txt"))
    assert "list.txt: took 6 of 24 frames, 1 per second (--fps)\n" in error
    succeeds(capfd, *query(town_map, video, "--fps", 1))
    succeeds(capfd, *query(town_map, tmp_path / "slow.avi"))
    succeeds(capfd, *query(town_map, f"{video}#t=0.5"))


def test_a_camera_of_a_video(town_map, tmp_path, capfd):
    video = write_video(tmp_path / "walk.avi", 5)
    given = query(town_map, "--camera", video, "--k", 1, "--window", 3)
    out, error = runs(capfd, *given)
    lines = [json.loads(line) for line in out.splitlines()]
    assert (lines[-1]["query"], lines[-1]["time"]) == ("walk.avi#t=0.400", 0.4)
    ready, summary = error.splitlines()
    assert ready == f"crisalad: ready, taking frames from {video}; by jax"
    assert summary.startswith(f"crisalad: {len(lines)} answers, latency median ")


def test_a_bag_is_replayed_and_no_frame_is_lost(town_map, tmp_path, capfd):
    """Forty frames, a hundred a second at twice the bag's rate: each is answered or counted."""
    flat = [np.full((48, 64, 3), 6 * number, np.uint8) for number in range(40)]
    step = SECOND // 50
    bag = write_bag(
        tmp_path / "walk.mcap",
        [image(BEGIN + step * number, each) for number, each in enumerate(flat)],
    )
    out, error = runs(capfd, *query(town_map, "--camera", bag, "--rate", 2, "--k", 1))
    lines = [json.loads(line) for line in out.splitlines()]
    assert len(lines) + sum(line["dropped"] for line in lines) == 40
    for line in lines:
        seconds = line["query"].removeprefix("walk.mcap#/camera/image_raw#t=")
        assert float(seconds) == line["time"]
        assert line["latency_ms"] > 0
    assert lines[-1]["time"] == (BEGIN + 39 * step) / SECOND
    ready, summary = error.splitlines()
    assert ready == f"crisalad: ready, taking frames from {bag}; by jax"
    assert summary.startswith(f"crisalad: {len(lines)} answer")
    passed = 40 - len(lines)
    words = {0: " ms", 1: "; 1 frame dropped"}
    assert summary.endswith(words.get(passed, f"; {passed} frames dropped"))
    given = query(town_map, "--camera", bag, "--topic", "/front")
    fails(capfd, *given, words=("found --topic /front, expected", "/camera/image_raw (Image, 40)"))
    fails(capfd, *query(town_map, "--camera", bag, "--rate", 0), words=("rate: found 0, expected",))


@pytest.mark.parametrize(
    ("number", "code", "words"),
    [
        (signal.SIGINT, 130, "interrupted"),
        pytest.param(signal.SIGTERM, 143, "ended by SIGTERM", marks=pytest.mark.slow),
    ],
)
def test_a_watch_ends_by_a_signal_with_its_summary(shared, town_map, tmp_path, number, code, words):
    """In a process of its own, as a shell starts it: the signal must reach no other test."""
    image = list_images(shared / "town" / "images" / "test" / "database")[2]
    (tmp_path / "in").mkdir()
    shutil.copy(image, tmp_path / "in" / "old.jpg")
    given = query(town_map, "--watch", tmp_path / "in", "--k", 1)
    with (tmp_path / "errors").open("w") as errors:
        child = subprocess.Popen(
            [sys.executable, "-m", "crisalad_jax", *map(str, given)],
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )
    try:
        for _ in range(2400):  # two minutes, on a busy machine
            if "ready" in (tmp_path / "errors").read_text() or child.poll() is not None:
                break
            time.sleep(0.05)
        shutil.copy(image, tmp_path / "in" / "new.jpg")
        assert child.stdout is not None
        line = json.loads(child.stdout.readline())
        child.send_signal(number)
        assert child.wait(120) == code
    finally:
        child.kill()
    said = (tmp_path / "errors").read_text()
    assert line["query"] == "new.jpg"
    assert line["neighbours"][0]["name"] == image.name
    assert "crisalad: 1 answer, latency median " in said
    assert said.endswith(f"crisalad: {words}\n")


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--watch", "{map}", "a.jpg"), "IMAGE: found with --watch, expected only one of the two"),
        (("--watch", "{map}", "--camera", "0"), "--camera: found with --watch, expected only one"),
        (("--camera", "0", "--gallery", "a.png"), "--gallery: found with --camera, expected only"),
        (("--camera", "0", "--json", "a"), "--json: found a with --camera, expected -: answers go"),
        (("--camera", "x.avi"), "camera: found no frame from x.avi, expected a number from 0"),
        (("--watch", "{map}/none"), "none: found nothing, expected a folder to watch"),
        (("{map}/map.json", "--window", "0"), "window: found 0, expected at least 1"),
        ((), "images: found none, expected at least one image"),
    ],
)
def test_bad_live_queries_are_one_line(town_map, capfd, flags, words):
    fails(capfd, *query(town_map, *(flag.format(map=town_map) for flag in flags)), words=(words,))
