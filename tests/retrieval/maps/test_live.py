"""Answers as images come: those of `query` to the same images, with their latency."""

import json
import shutil

import numpy as np
import pytest

from crisalad_jax.data.images import list_images, read_image
from crisalad_jax.data.live import Camera, FolderWatch, Frame, LatestFrame
from crisalad_jax.data.video import list_frames
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.maps.build import index
from crisalad_jax.retrieval.maps.corrections import remove_images
from crisalad_jax.retrieval.maps.live import latency_words, query_live
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.query import json_lines
from crisalad_jax.retrieval.sequence import BayesFilter
from crisalad_jax.utils.errors import InputError
from tests.conftest import MODEL, read_options, write_video
from tests.retrieval.maps.conftest import ask
from tests.retrieval.maps.test_stores import ROUNDING


class Given:
    """A source of images that are there."""

    size = None

    def __init__(self, paths) -> None:
        self.paths, self.taken = paths, 0

    def frames(self, check=lambda: None):
        for path in self.paths:
            check()
            self.taken += 1
            yield Frame(path.as_posix(), 1.5, read_image(path), 0.0)


def live(places: Map, source, params, **options):
    return query_live(places, source, model=Model(params, places.config), **options)


@pytest.mark.parametrize("window", [1, 3])
def test_the_answers_are_those_of_query(town_map, shared, params, window):
    paths = list_images(shared / "town" / "images" / "test" / "queries")
    source = Given(paths)
    expected = ask(town_map, params, paths[0].parent, k=2, window=window)
    with Map.open(town_map) as places:
        seen = []
        options = {"k": 2, "window": window, "ready": lambda: seen.append(source.taken)}
        stream = live(places, source, params, **options)
        assert not seen  # nothing is compiled before the first answer is asked for
        found = list(stream)
    assert seen == [0]  # ready before the first frame is taken
    lines = [json.loads(answer.json_line()) for answer in found]
    assert [line["query"] for line in lines] == [path.as_posix() for path in paths]
    for line, right in zip(lines, map(json.loads, json_lines(expected)), strict=True):
        assert line["time"] == 1.5
        assert [one["name"] for one in line["neighbours"]] == [
            one["name"] for one in right["neighbours"]
        ]
        similarities = [[one["similarity"] for one in each["neighbours"]] for each in (line, right)]
        # float32 sums of other batches, and six decimals.
        np.testing.assert_allclose(*similarities, atol=ROUNDING + 1e-6)
    # `taken` was the clock's zero: the latency is what it shows.
    assert all(answer.latency_ms > 0 for answer in found)


def test_a_watched_folder_and_a_camera(town_map, shared, params, tmp_path):
    database = shared / "town" / "images" / "test" / "database"
    image = list_images(database)[4]
    (tmp_path / "in").mkdir()
    watch = FolderWatch(tmp_path / "in")
    shutil.copy(image, tmp_path / "in")
    video = write_video(tmp_path / "walk.avi", 4)
    with Map.open(town_map) as places:
        first = next(live(places, watch, params, k=1))
        line = json.loads(first.json_line())
        assert line["neighbours"][0]["name"] == image.name
        assert 0 < line["latency_ms"] < 60_000
        with Camera(video) as camera:
            *before, last = live(places, camera, params, k=1)
    assert sum(1 + each.frame.dropped for each in (*before, last)) == 4
    assert json.loads(last.json_line())["dropped"] == last.frame.dropped
    assert (last.frame.time, json.loads(last.json_line())["query"]) == (0.3, "walk.avi#t=0.300")


def test_frames_from_another_thread(town_map, shared, params):
    """As a callback of ROS puts them: the newest is answered, and those dropped are counted."""
    paths = list_images(shared / "town" / "images" / "test" / "database")[:5]
    images = [read_image(path) for path in paths]
    latest = LatestFrame()
    with Map.open(town_map) as places:
        stream = live(places, latest, params, k=1, min_similarity=0.99)
        for number, image in enumerate(images):
            latest.put(image, 1767225600.0 + number, str(number))
        first = next(stream)
        latest.put(images[2], 1767225610.5)
        second = next(stream)
        latest.close()
        assert list(stream) == []
    # The map's own images: the last one, and the third.
    assert (first.ranked[0].image.name, first.known) == (paths[-1].name, True)
    assert (first.answers.names, first.frame.time, first.frame.dropped) == (["4"], 1767225604.0, 4)
    assert second.ranked[0].image.name == paths[2].name
    assert (second.answers.names, second.frame.dropped) == (["camera#t=1767225610.500"], 0)
    assert latest.dropped == 4


@pytest.mark.parametrize("sequence", [None, BayesFilter()])
def test_a_correction_counts_from_the_next_frame_on(town_map, sides, params, tmp_path, sequence):
    """A filter follows the camera through the map as it was."""
    folder = shutil.copytree(town_map, tmp_path / "map")
    image = list_images(sides[0])[2]
    with Map.open(folder) as places:
        stream = live(places, Given([image, image]), params, k=9, sequence=sequence)
        first = [one.image.name for _, found in next(stream).answers.rows() for one in found]
        remove_images(folder, [image.name])
        second = [one.image.name for _, found in next(stream).answers.rows() for one in found]
    assert len(first) == 7
    left = [name for name in first if name != image.name]
    assert second == left if sequence is None else sorted(second) == sorted(first)


def test_a_map_of_a_video_tells_times(shared, params, tmp_path):
    video = write_video(tmp_path / "walk.avi", 21)
    more = {"weights": shared / "weights.safetensors"} | read_options({})
    made = index(Model(params, MODEL), video, tmp_path / "map", fps=1, **more)
    assert (made.added, made.positions) == (3, 0)
    made = index(Model(params, MODEL), video, tmp_path / "map", fps=2, **more)
    assert (made.added, made.there) == (2, 3)
    with Map.open(tmp_path / "map") as places:
        assert {image.root for image in places.images} == {tmp_path.resolve().as_posix()}
        assert places.images[1].bytes == video.stat().st_size
    answers = ask(tmp_path / "map", params, list_frames(video, 1)[2], k=1)
    whole = ask(tmp_path / "map", params, video, fps=2, k=1)
    (line,) = map(json.loads, json_lines(answers))
    assert (line["query"], line["time"]) == ("walk.avi#t=2.000", 2.0)
    assert line["neighbours"][0] == {
        "rank": 1,
        "name": "walk.avi#t=2.000",
        "similarity": pytest.approx(1, abs=ROUNDING),
        "position": None,
        "time": 2.0,
    }
    assert [path.name for path in whole.queries] == [f"walk.avi#t={i / 2:.3f}" for i in range(5)]


def test_latencies_in_words():
    # By hand: of 1 to 21 the 11th, and the 20th.
    words = "21 answers, latency median 11.0 ms, 95th percentile 20.0 ms"
    assert latency_words(range(1, 22), 0) == words
    assert latency_words(range(1, 22), 1) == f"{words}; 1 frame dropped"
    assert latency_words([], 0) == "no answers"
    assert latency_words([], 3) == "no answers; 3 frames dropped"


def test_what_is_refused(town_map, params):
    with Map.open(town_map) as places:
        for name in ("k", "window"):
            with pytest.raises(InputError, match=f"{name}: found 0, expected at least 1"):
                live(places, Given([]), params, **{name: 0})


def test_a_filter_and_a_least_similarity_are_those_of_query(town_map, shared, params):
    paths = list_images(shared / "town" / "images" / "test" / "queries")
    best = ask(town_map, params, paths, k=1).neighbours
    # In the widest gap between two of the queries: rounding does not decide.
    ordered = np.sort(best.similarities[:, 0])
    below = int(np.argmax(np.diff(ordered))) + 1
    between = float(ordered[below - 1] + ordered[below]) / 2
    options = {"k": 2, "sequence": BayesFilter(reach=1), "min_similarity": between}
    expected = ask(town_map, params, paths, **options)
    with Map.open(town_map) as places:
        found = list(live(places, Given(paths), params, **options))
    lines = [json.loads(answer.json_line()) for answer in found]
    for line, right in zip(lines, map(json.loads, json_lines(expected)), strict=True):
        assert line["known"] == right["known"]
        for one, other in zip(line["neighbours"], right["neighbours"], strict=True):
            assert one["name"] == other["name"]
            # Similarities of other batches, whose rounding the likelihood amplifies a little.
            assert one["probability"] == pytest.approx(other["probability"], abs=1e-4)
    assert [line["known"] for line in lines].count(False) == below
