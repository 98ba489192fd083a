"""SeqSLAM against the paper's sums in loops, and on walks that single frames cannot follow."""

import pathlib

import numpy as np
import pytest

from crisalad_jax.retrieval.maps.tracking import SequenceTracker
from crisalad_jax.retrieval.seqslam import SeqSlam
from crisalad_jax.utils.errors import InputError
from tests.retrieval.maps.test_tracking import made, numbered


def unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def in_loops(similarities: np.ndarray, search: SeqSlam) -> np.ndarray:
    """The score of each image at the last frame, by the equations of the paper's section III."""
    frames, count = similarities.shape
    enhanced = np.zeros((frames, count))
    for t in range(frames):
        for i in range(count):
            around = (
                1 - similarities[t, max(0, i - search.window // 2) : i + search.window // 2 + 1]
            )
            enhanced[t, i] = (1 - similarities[t, i] - around.mean()) / around.std()
    last, scores = frames - 1, np.full(count, np.inf)
    for i in range(count):
        for velocity in np.arange(search.slowest, search.fastest + 0.05, 0.1).round(9):
            total = 0.0
            for t in range(max(0, frames - search.length), frames):
                total += enhanced[t, max(0, round(i - velocity * (last - t)))]
            scores[i] = min(scores[i], total)
    return scores


@pytest.mark.parametrize("length", [1, 4, 9])
def test_scores_are_those_of_loops(length: int) -> None:
    generator = np.random.default_rng(length)
    similarities = generator.uniform(-1, 1, (7, 23))
    search = SeqSlam(length=length, window=6, slowest=0.7, fastest=1.3)
    state = search.start(np.zeros(23))
    for row in similarities:
        state = search.step(state, row)
    scores = in_loops(similarities, search)
    # The belief is the softmax of minus the scores; float64 throughout.
    expected = np.exp(-scores) / np.exp(-scores).sum()
    np.testing.assert_allclose(state.belief, expected, rtol=1e-9)
    assert state.frames == 7
    assert len(state.rows) == min(7, length)


def test_velocities_are_a_tenth_apart() -> None:
    np.testing.assert_allclose(SeqSlam().velocities, [0.8, 0.9, 1.0, 1.1, 1.2])
    np.testing.assert_allclose(SeqSlam(slowest=1, fastest=1).velocities, [1])


def test_a_walk_is_followed_that_single_frames_lose(tmp_path: pathlib.Path) -> None:
    """Through `SequenceTracker`, in portions as `query` asks; a frame is an image of the map."""
    generator = np.random.default_rng(0)
    database = unit(generator.standard_normal((80, 12)))
    there = np.arange(20, 60)
    queries = unit(database[there] + 0.45 * generator.standard_normal((40, 12)))
    places = made(tmp_path / "map", numbered(range(80)), database)
    tracker = SequenceTracker(places, SeqSlam(length=8))
    frames = [pathlib.Path(name) for name in numbered(range(40))]
    rows = queries.astype(np.float32)
    portions = [tracker.answer(rows[:7], 3, frames[:7]), tracker.answer(rows[7:], 3, frames[7:])]
    found = np.concatenate([portion.numbers[:, 0] for portion in portions])
    single = (queries @ database.T).argmax(axis=1)
    assert np.mean(single == there) < 0.7
    assert np.abs(found[8:] - there[8:]).max() <= 1  # lines of two velocities may share most
    shares = np.concatenate([portion.probabilities for portion in portions])
    assert (np.diff(shares, axis=1) <= 0).all()
    # At its own speed alone; a camera of twice that is not on a line.
    tracker = SequenceTracker(places, SeqSlam(length=8))
    fast = tracker.answer(rows[::2], 1, frames[::2])
    assert np.mean(fast.numbers[8:, 0] == there[::2][8:]) < 0.5


def test_what_is_the_same_everywhere_says_nothing() -> None:
    search = SeqSlam()
    state = search.step(search.start(np.zeros(5)), np.full(5, 0.3))
    np.testing.assert_array_equal(state.belief, np.full(5, 0.2))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"length": 0}, "length: found 0"),
        ({"slowest": -0.1}, "slowest: found -0.1, expected at least 0"),
        ({"fastest": 0.5}, "fastest: found 0.5, expected at least the slowest, 0.8"),
    ],
)
def test_numbers_out_of_range(fields: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        SeqSlam(**fields)
    with pytest.raises(InputError, match="similarities: found NaN or infinity"):
        SeqSlam().step(SeqSlam().start(np.zeros(2)), np.array([0, np.nan]))
