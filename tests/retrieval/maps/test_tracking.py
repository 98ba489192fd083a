"""Cameras of another rate than the map's: what moves them, by the names of images and frames."""

import dataclasses
import pathlib

import numpy as np
import pytest

from crisalad_jax.data.frames import moment_of
from crisalad_jax.data.positions import Positions, utm_positions
from crisalad_jax.retrieval.maps.appending import open_for_appending
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.tracking import SequenceTracker
from crisalad_jax.retrieval.sequence import BayesFilter
from crisalad_jax.utils.output import Note
from tests.killed_appends import metadata
from tests.retrieval.test_sequence import walk

NOISE = 0.9
"""Single frames find 70 % within a second, so that there is something to gain and to lose."""


def made(folder: pathlib.Path, names, rows, positions: Positions | None = None) -> Map:
    described = dataclasses.replace(metadata("files"), descriptor_length=rows.shape[1])
    with open_for_appending(folder, described) as target:
        rows = rows.astype(np.float32)
        target.append(names, [1] * len(names), rows, root="/images", positions=positions)
    return Map.open(folder)


def in_video(times) -> list[str]:
    return [f"walk.mp4#t={time:.3f}" for time in times]


def since_1970(times) -> list[str]:
    """As EuRoC names images, in nanoseconds."""
    return [f"cam0/{1_403_636_579_000_000_000 + round(1e9 * time)}.png" for time in times]


def in_metres(times) -> list[str]:
    """At 1.5 m/s to the north."""
    return [f"@{500_000:.1f}@{4_000_000 + 1.5 * time:.2f}@32@N@{time:.1f}@.jpg" for time in times]


def numbered(times) -> list[str]:
    return [f"{number:04d}.jpg" for number in range(len(times))]


def recalls(folder, of_map: float, of_frames: float, name, name_frames=None) -> tuple[float, float]:
    """Within a second: of single frames, and of the filter."""
    there, database = walk(of_map, 2, 0.1)
    when, queries = walk(of_frames, 3, NOISE)
    places = made(folder, name(there), database)
    frames = [pathlib.Path("in", each) for each in (name_frames or name)(when)]
    follower = SequenceTracker(places, BayesFilter())
    # In portions, as `query` asks.
    portions = [follower.answer(queries[:7].astype(np.float32), 1, frames[:7])]
    portions.append(follower.answer(queries[7:].astype(np.float32), 1, frames[7:]))
    found = np.concatenate([portion.numbers[:, 0] for portion in portions])
    return tuple(
        float(np.mean(np.abs(there[numbers] - when) <= 1))
        for numbers in ((queries @ database.T).argmax(axis=1), found)
    )


@pytest.mark.filterwarnings("error::crisalad_jax.utils.output.Note")
@pytest.mark.parametrize("name", [in_video, since_1970])
@pytest.mark.parametrize(("of_map", "of_frames"), [(5, 1), (1, 5), (5, 5)])
def test_a_filter_loses_nothing_whatever_the_rates(tmp_path, name, of_map, of_frames):
    single, filtered = recalls(tmp_path, of_map, of_frames, name)
    assert filtered > single


@pytest.mark.filterwarnings("error::crisalad_jax.utils.output.Note")
def test_a_map_of_positions_is_followed_in_metres(tmp_path):
    """The camera of the map walks at 1.5 m/s, and so does this one."""
    there, database = walk(5, 2, 0.1)
    when, queries = walk(1, 3, NOISE)
    names = numbered(there)
    # On a meridian, where by the ellipsoid of WGS84 a degree is 111,035 m at 40 degrees.
    degrees = [(40 + 1.5 * time / 111_035, 9.0) for time in there]
    of = dict(zip(names, degrees, strict=True))
    places = made(tmp_path, names, database, Positions(("lat", "lon"), of))
    follower = SequenceTracker(places, BayesFilter())
    frames = [pathlib.Path(each) for each in in_metres(when)]
    found = follower.answer(queries.astype(np.float32), 1, frames).numbers[:, 0]
    # UTM shrinks by 0.9996 at the central meridian; the sums of 500 roundings are less.
    assert np.ptp(follower.state.along) == pytest.approx(1.5 * 99.8, rel=5e-4)
    single = (queries @ database.T).argmax(axis=1)
    recall, filtered = (np.mean(np.abs(there[one] - when) <= 1) for one in (single, found))
    assert filtered > recall


@pytest.mark.parametrize(("of_map", "of_frames"), [(in_video, numbered), (numbered, in_video)])
def test_without_times_on_both_sides_a_note_says_that_frames_count(tmp_path, of_map, of_frames):
    said = (
        "a frame counts as an image of the map, .* by at most 2 images a frame; .* --sequence-reach"
    )
    with pytest.warns(Note, match=said) as notes:
        single, filtered = recalls(tmp_path, 5, 1, of_map, of_frames)
    assert len(notes) == 1
    assert filtered < single  # which is why it is said


def test_two_videos_have_two_clocks(tmp_path):
    """The camera may be anywhere when another video begins, and a map's videos are far apart."""
    names = [*in_video([0, 1, 2]), *(f"b/{each}" for each in in_video([0, 1, 2]))]
    places = made(tmp_path, names, np.eye(6))
    follower = SequenceTracker(places, BayesFilter(adapt=False))
    frames = [pathlib.Path(each) for each in ("x.mp4#t=0.0", "x.mp4#t=0.5", "y.mp4#t=0.5")]
    follower.answer(np.eye(6, dtype=np.float32)[:2], 1, frames[:2])
    gaps = np.diff(follower.state.along)
    assert gaps[[0, 1, 3, 4]].tolist() == [1, 1, 1, 1]
    assert gaps[2] > 1e8  # three years
    # A frame that tells nothing: where the camera may be is all that it leaves.
    left = follower.answer(np.full((1, 6), 6**-0.5, np.float32), 6, frames[2:])
    np.testing.assert_allclose(left.probabilities, 1 / 6, rtol=1e-9)


def test_metres_come_before_seconds_and_are_of_one_zone(tmp_path):
    names = [f"@500000.0@{4_000_000 + 3 * s}.0@32@N@140363657{s}@.jpg" for s in range(3)]
    places = made(tmp_path, names, np.eye(3), utm_positions(names))
    follower = SequenceTracker(places, BayesFilter())
    follower.answer(np.eye(3, dtype=np.float32)[:1], 1, [pathlib.Path(names[0])])
    assert follower.state.along.tolist() == [0, 3, 6]
    assert follower._moved(pathlib.Path(names[1])) == 3
    assert follower._moved(pathlib.Path(names[2].replace("@32@", "@33@"))) == np.inf


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("walk.mp4#t=12.500", ("walk.mp4", 12.5)),
        ("a/camera-0#t=1767225600.250", ("a/camera-0", 1767225600.25)),
        # A day by `date -u -d @SECONDS`; TUM, EuRoC, Oxford RobotCar, and a phone.
        ("rgb/1305031102.175304.png", ("", 1305031102.175304)),
        ("1403636579763555584.png", ("", 1403636579.763555584)),
        ("stereo/centre/1418381798086398.png", ("", 1418381798.086398)),
        ("IMG-1560349301123.jpg", ("", 1560349301.123)),
        ("1305031102/0001.png", None),  # a day's folder is no frame's time
        ("20190612143501.jpg", None),
        ("13050311021.png", None),
        ("1305031102_1305031103.png", None),
        ("1403636579_763555584.png", ("", 1403636579.763555584)),  # as ROS exports write
        ("1403636579-163555584.png", ("", 1403636579.163555584)),
        ("1403636579_7.png", ("", 1403636579.0)),  # a number of another kind
        ("@0584580.17@4477007.90@17@T@.jpg", None),
    ],
)
def test_moments_in_names(name, expected):
    assert moment_of(name) == expected
