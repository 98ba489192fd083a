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


def transitions(along: np.ndarray, reach: float, jump: float, moved: float = 1.0) -> np.ndarray:
    """P(to | from), a row for each `from`."""
    places = len(along)
    matrix = np.zeros((places, places))
    for start in range(places):
        near = [
            end
            for end in range(places)
            # Half a millisecond, or half a millimetre, is rounding.
            if abs(end - start) <= 1 or abs(along[end] - along[start]) <= reach * moved + 5e-4
        ]
        for end in near:
            matrix[start, end] += (1 - jump) / len(near)
        matrix[start] += jump / places
    return matrix


def forward(
    settings: BayesFilter,
    database: np.ndarray,
    queries: np.ndarray,
    along: np.ndarray | None = None,
    moved: np.ndarray | None = None,
) -> np.ndarray:
    """The belief after every frame: the forward algorithm, with nothing left out."""
    along = np.arange(len(database)) if along is None else along
    moved = np.ones(len(queries)) if moved is None else moved
    belief, beliefs = np.full(len(database), 1 / len(database)), []
    mean = database.mean(axis=0)
    for number, query in enumerate(queries, 1):
        matrix = transitions(along, settings.reach, settings.jump, moved[number - 1])
        np.testing.assert_allclose(matrix.sum(axis=1), 1, rtol=1e-14)
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
    expected = belief @ transitions(np.arange(3), 50, 0.1)
    settings = BayesFilter(reach=50, jump=0.1)
    state = settings.start(np.zeros(3))._replace(belief=belief)
    np.testing.assert_allclose(settings.predict(state), expected, rtol=1e-14)
    # So is a reach that is unknown, and by hand each place is as likely as another.
    found = BayesFilter().predict(state, moved=np.inf)
    np.testing.assert_allclose(found, np.full(3, 1 / 3), rtol=1e-14)


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


def test_a_frame_that_tells_nothing_leaves_the_prediction():
    settings = BayesFilter(adapt=False)
    state = settings.step(settings.start(np.zeros(6)), np.eye(6)[2])
    after = settings.step(state, np.full(6, 0.25))
    np.testing.assert_allclose(after.belief, settings.predict(state), rtol=1e-14)


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("reach", 0, "at least 1"),
        ("jump", 0.0, "above 0 and below 1"),
        ("jump", 1.0, "above 0 and below 1"),
        ("sharpness", float("inf"), "above 0"),
        ("sharpness", float("nan"), "above 0"),
        ("reach", float("inf"), "at least 1"),
        ("reach", "2", "a number"),
    ],
)
def test_such_settings_are_refused(field, value, words):
    with pytest.raises(
        InputError, match=rf"BayesFilter.{field}: found {value!r}, expected {words}"
    ):
        BayesFilter(**{field: value})


# Seconds and metres


def test_reach_in_seconds_is_that_of_the_forward_algorithm():
    """Images and frames at uneven times, of which some are equal, and a gap beyond any reach."""
    generator = np.random.default_rng(3)
    along = np.cumsum(
        generator.choice([0.0, 0.2, 0.5, 1.0, 500.0], 40, p=[0.2, 0.3, 0.3, 0.1, 0.1])
    )
    moved = generator.choice([0.0, 0.2, 1.0, 3.0, np.inf], 30)
    database, queries = sides(places=40, frames=30)
    settings = BayesFilter(reach=1.5)
    expected = forward(settings, database, queries, along, moved)
    followed = settings.follow(queries @ database.T, database @ database.mean(axis=0), along, moved)
    np.testing.assert_array_equal(followed.places, expected.argmax(axis=1))
    # As above.
    np.testing.assert_allclose(followed.probabilities, expected.max(axis=1), rtol=1e-9)


def test_what_is_reached_by_hand():
    """A map of five images a second, and a frame a second, which moves by up to two seconds."""
    settings = BayesFilter(jump=1e-6)
    state = settings.start(np.zeros(31), np.arange(31) / 5)
    state = state._replace(belief=np.eye(31)[15])
    (reached,) = np.nonzero(settings.predict(state, moved=1.0) > 1e-3)
    assert reached.tolist() == list(range(5, 26))
    # Rounding takes no image away: 0.5996 seconds are 0.6.
    (reached,) = np.nonzero(settings.predict(state, moved=0.2998) > 1e-3)
    assert reached.tolist() == list(range(12, 19))
    # Faster than the map's images: the next image is in reach all the same.
    (reached,) = np.nonzero(settings.predict(state, moved=0.05) > 1e-3)
    assert reached.tolist() == [14, 15, 16]


def walk(rate: float, seed: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and descriptors of a walk of 100 seconds, each second another place, in some noise."""
    corners = np.random.default_rng(1).normal(size=(102, 12))
    times = np.arange(0, 100, 1 / rate)
    part = (times % 1)[:, None]
    second = times.astype(int)
    exact = corners[second] * (1 - part) + corners[second + 1] * part
    return times, unit(exact + np.random.default_rng(seed).normal(0, noise, exact.shape))


@pytest.mark.parametrize("along", [[0.0, 2.0, 1.0], np.array([0.0, 1.0])])
def test_a_way_that_does_not_fit_is_refused(along):
    with pytest.raises(InputError, match=r"along: found shape \(\d,\), expected \(3,\)"):
        BayesFilter().start(np.zeros(3), along)


@pytest.mark.parametrize("moved", [-1.0, float("nan")])
def test_a_step_back_is_refused(moved):
    settings = BayesFilter()
    with pytest.raises(InputError, match=f"moved: found {moved}, expected at least 0"):
        settings.step(settings.start(np.zeros(3)), np.eye(3)[0], moved)


def test_steps_of_other_frames_are_refused():
    with pytest.raises(InputError, match=r"^moved: found shape \(2,\), expected \(3,\)"):
        BayesFilter().follow(np.eye(3), np.zeros(3), moved=[1.0, 2.0])


@pytest.mark.parametrize("common", [np.ones(0), np.array([0.5, np.nan]), np.ones((2, 2))])
def test_no_places_and_no_numbers_are_refused(common):
    with pytest.raises(InputError, match=r"^common: found .*, expected shape \(\d,\) of finite"):
        BayesFilter().start(common)


@pytest.mark.parametrize("row", [np.array([0.5, np.nan]), np.array([np.inf, 0.0]), np.ones(3)])
def test_a_frame_without_a_number_for_each_place_is_refused(row):
    start = BayesFilter().start(np.array([0.5, 0.5]))
    with pytest.raises(InputError, match=r"^similarities: found .*, expected shape \(2,\) of"):
        BayesFilter().step(start, row)
