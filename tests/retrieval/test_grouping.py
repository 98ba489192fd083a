"""Who looks at whom, by hand and by following every path through the layers; no model is needed."""

import numpy as np
import pytest

from crisalad_jax.retrieval.grouping import (
    DEFAULT_GROUPINGS,
    GROUPINGS,
    Grouping,
    batches_of,
    parse_groupings,
)
from crisalad_jax.utils.errors import InputError

LAYERS = 2


def influence(count, grouping, batch_size, seed=0) -> np.ndarray:
    """Whether image j can change the descriptor of image i, through any number of layers."""
    batches = batches_of(count, grouping, batch_size, seed)
    reach = np.linalg.matrix_power(batches.attention_mask.astype(int), LAYERS) > 0
    changes = np.zeros((count, count), bool)
    given = np.zeros(count, int)
    for images, kept, reached in zip(batches.images, batches.kept, reach, strict=True):
        for place in np.flatnonzero(kept):
            changes[images[place], images[reached[place]]] = True
            given[images[place]] += 1
    # Every image has exactly one descriptor.
    np.testing.assert_array_equal(given, 1)
    return changes


def same_block(order: np.ndarray, size: int) -> np.ndarray:
    block = np.empty(len(order), int)
    block[order] = np.arange(len(order)) // size
    return block[:, None] == block


@pytest.mark.parametrize(("count", "size"), [(7, 4), (8, 4), (3, 4), (5, 1), (1, 3)])
def test_each_grouping_lets_exactly_these_look(count, size):
    i, j = np.indices((count, count))
    expected = {
        "single": i == j,
        "sequential": i // size == j // size,
        "shuffled": same_block(np.random.default_rng(6).permutation(count), size),
        "window": (j <= i) & (j > i - size),
    }
    assert expected.keys() == GROUPINGS.keys()
    for grouping, wanted in expected.items():
        np.testing.assert_array_equal(influence(count, grouping, size, seed=6), wanted, grouping)


def test_batches_keep_their_shape():
    for grouping in GROUPINGS:
        for count in (1, 5, 9):
            assert batches_of(count, grouping, 4).images.shape[1] == 4
    part = batches_of(9, "sequential", 4).part(1, 3)
    assert part.images.tolist() == [[4, 5, 6, 7], [8, 8, 8, 8]]
    assert part.filled.tolist() == [[True] * 4, [True, False, False, False]]


@pytest.mark.parametrize(
    ("text", "queries", "database"),
    [
        ("single", "single", "single"),
        ("window/single", "window", "single"),
        ("shuffled/sequential", "shuffled", "sequential"),
        ("masked/single@26", "masked", "single"),
    ],
)
def test_a_grouping_is_written_as_it_is_read(text, queries, database):
    grouping = Grouping.parse(text)
    assert (grouping.queries, grouping.database) == (queries, database)
    assert grouping.batch_size == (26 if "@" in text else None)
    assert str(grouping) == text
    assert Grouping.parse(f"{queries}/{database}{'@26' * ('@' in text)}") == grouping


def test_groupings_come_once_and_in_their_order():
    found = parse_groupings(["window/single", "single", "single/single", "window/single"])
    assert [str(grouping) for grouping in found] == ["window/single", "single"]
    assert [str(grouping) for grouping in parse_groupings(DEFAULT_GROUPINGS)] == [
        *("single", "shuffled", "sequential", "window/single")
    ]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sorted", "^grouping: found 'sorted', expected one of masked, sequential, shuffled, si"),
        ("", "^grouping: found ''"),
        ("single/", "^grouping: found '', expected one of"),
        (
            "single@",
            "^grouping: found 'single@', expected a number of images after @",
        ),
        ("single@4", "^grouping: found 'single@4', expected single without a number"),
        ("single@0", "^grouping: found 'single@0', expected a number"),
        ("single@-3", "^grouping: found 'single@-3', expected a number"),
        ("single/window/single", "^grouping: found 'single/window/single', .* QUERIES/DATABASE"),
    ],
)
def test_bad_groupings_are_named(text, words):
    with pytest.raises(InputError, match=words):
        Grouping.parse(text)
