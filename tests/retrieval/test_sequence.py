"""The filter against the forward algorithm with a whole matrix, and its evidence by descriptors."""

import numpy as np
import pytest

from crisalad_jax.retrieval.sequence import BayesFilter
from crisalad_jax.utils.errors import InputError


def unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def sides(places: int, frames: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors of a map, and of frames that go through it under another light."""
    generator = np.random.default_rng(seed)
    database = generator.normal(0.5, 1, (places, 16))
    way = np.linspace(0, places - 1, frames).round().astype(int)
    queries = database[way] + generator.normal(0, 1, (frames, 16)) + generator.normal(0, 1, 16)
    return unit(database), unit(queries)


def transitions(places: int, reach: int, jump: float) -> np.ndarray:
    """P(to | from), a row for each `from`."""
    matrix = np.zeros((places, places))
    for start in range(places):
        near = [end for end in range(places) if abs(end - start) <= reach]
        for end in near:
            matrix[start, end] += (1 - jump) / len(near)
        matrix[start] += jump / places
    return matrix


def forward(settings: BayesFilter, database: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """The belief after every frame: the forward algorithm, with nothing left out."""
    matrix = transitions(len(database), settings.reach, settings.jump)
    np.testing.assert_allclose(matrix.sum(axis=1), 1, rtol=1e-14)
    belief, beliefs = np.full(len(database), 1 / len(database)), []
    mean = database.mean(axis=0)
    for number, query in enumerate(queries, 1):
        if settings.adapt:  # the map's mean stands for ten frames
            own = (10 * mean + queries[:number].sum(axis=0)) / (10 + number)
            similarities = unit(database - mean) @ (query - own)
        else:
            similarities = database @ query
        z = (similarities - similarities.mean()) / similarities.std()
        belief = (belief @ matrix) * np.exp(settings.sharpness * z)
        belief /= belief.sum()
        beliefs.append(belief)
    return np.array(beliefs)


@pytest.mark.parametrize("adapt", [False, True])
@pytest.mark.parametrize(("reach", "jump", "sharpness"), [(1, 0.01, 2.0), (3, 0.2, 0.7)])
def test_beliefs_are_those_of_the_forward_algorithm(adapt, reach, jump, sharpness):
    settings = BayesFilter(reach, jump, sharpness, adapt)
    database, queries = sides(places=23, frames=30)
    similarities, common = queries @ database.T, database @ database.mean(axis=0)
    expected = forward(settings, database, queries)
    state = settings.start(common)
    for row, belief in zip(similarities, expected, strict=True):
        state = settings.step(state, row)
        # Both in float64; differences of similarities are amplified by 1 / std and the exponent.
        np.testing.assert_allclose(state.belief, belief, rtol=1e-9, atol=1e-300)
    followed = settings.follow(similarities, common)
    np.testing.assert_array_equal(followed.places, expected.argmax(axis=1))
    np.testing.assert_allclose(followed.probabilities, expected.max(axis=1), rtol=1e-9)


def test_a_reach_beyond_the_map_is_anywhere():
    belief = np.array([0.7, 0.2, 0.1])
    expected = belief @ transitions(3, 50, 0.1)
    np.testing.assert_allclose(
        BayesFilter(reach=50, jump=0.1).predict(belief), expected, rtol=1e-14
    )


def test_frames_before_tell_twins_apart():
    """Places 2 and 7 look the same; only who came from 6 is at 7."""
    database = np.eye(10)
    database[7] = database[2]
    common = database @ database.mean(axis=0)
    queries = database[[5, 6, 7]]
    single = (queries @ database.T).argmax(axis=1)
    assert single.tolist() == [5, 6, 2]
    followed = BayesFilter(adapt=False).follow(queries @ database.T, common)
    assert followed.places.tolist() == [5, 6, 7]
    assert followed.probabilities[2] > 0.9


def test_a_camera_that_was_carried_elsewhere_is_found_again():
    database = np.eye(40)
    way = [3, 4, 5, 30, 31, 32]
    followed = BayesFilter().follow(database[way], database @ database.mean(axis=0))
    assert followed.places[[0, 2, 4, 5]].tolist() == [3, 5, 31, 32]


def test_a_frame_that_tells_nothing_leaves_the_prediction():
    settings = BayesFilter(adapt=False)
    state = settings.step(settings.start(np.zeros(6)), np.eye(6)[2])
    after = settings.step(state, np.full(6, 0.25))
    np.testing.assert_allclose(after.belief, settings.predict(state.belief), rtol=1e-14)


def test_a_map_of_one_image_is_where_the_camera_is():
    followed = BayesFilter().follow(np.full((3, 1), 0.5), np.ones(1))
    assert followed.places.tolist() == [0, 0, 0]
    assert followed.probabilities.tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("reach", 0, "at least 1"),
        ("jump", 0.0, "above 0 and below 1"),
        ("jump", 1.0, "above 0 and below 1"),
        ("sharpness", float("inf"), "above 0"),
        ("sharpness", float("nan"), "above 0"),
        ("reach", 1.5, "a whole number"),
    ],
)
def test_such_settings_are_refused(field, value, words):
    with pytest.raises(InputError, match=rf"BayesFilter.{field}: found {value}, expected {words}"):
        BayesFilter(**{field: value})
