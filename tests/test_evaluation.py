"""Groupings against `describe` on the very images, and recalls against brute force."""

import dataclasses
import pathlib

import numpy as np
import pytest

from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.images import read_image, resize_image
from crisalad_jax.errors import InputError
from crisalad_jax.evaluation import (
    GROUPINGS,
    FolderTokens,
    check_grouping,
    evaluate,
    group,
    read_tokens,
)
from crisalad_jax.model import describe
from tests.conftest import BATCH, MODEL, random_params

# Entries of a unit descriptor of 48 numbers are of order 0.1. The same image in a batch of another
# size, or beside padding, is summed in another order: some units in the last place of float32.
TOLERANCE = 2e-6
# What a changed neighbour makes of a descriptor, far above rounding.
VISIBLE = 1e-3

WITHOUT_ENCODER = dataclasses.replace(MODEL, encoder=dataclasses.replace(MODEL.encoder, layers=0))


def pictures(paths) -> np.ndarray:
    return np.stack([resize_image(read_image(path), MODEL.image_size) for path in paths])


@pytest.fixture(scope="module")
def images(benchmark: Benchmark) -> np.ndarray:
    return pictures(benchmark.database)


@pytest.fixture(scope="module")
def folder(benchmark: Benchmark, params) -> FolderTokens:
    return read_tokens(params, MODEL, benchmark.database, batch_size=BATCH, label="", quiet=True)


def grouped(params, folder: FolderTokens, grouping: str, **changes) -> np.ndarray:
    return group(params, MODEL, folder, grouping, **({"batch_size": BATCH} | changes))


def alike(found: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(found, expected, atol=TOLERANCE, rtol=0)


def in_batches(params, images: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Each batch described by itself, the last with as few images as it has."""
    descriptors = np.empty((len(images), MODEL.descriptor_dim), np.float32)
    for start in range(0, len(images), BATCH):
        chosen = order[start : start + BATCH]
        descriptors[chosen] = describe(params, images[chosen], MODEL)
    return descriptors


def test_single_is_every_image_in_a_batch_of_one(params, folder, images):
    expected = np.concatenate([describe(params, image[None], MODEL) for image in images])
    alike(grouped(params, folder, "single"), expected)


def test_sequential_is_consecutive_batches_whose_padding_is_unseen(params, folder, images):
    assert len(images) % BATCH  # or nothing is padded
    expected = in_batches(params, images, np.arange(len(images)))
    found = grouped(params, folder, "sequential")
    alike(found, expected)
    assert np.abs(found - grouped(params, folder, "single")).max() > VISIBLE


def test_shuffled_gives_each_image_its_own_descriptor_in_the_seeds_order(params, folder, images):
    found = grouped(params, folder, "shuffled", seed=3)
    order = np.random.default_rng(3).permutation(len(images))
    assert not np.array_equal(order, np.arange(len(images)))
    alike(found, in_batches(params, images, order))
    np.testing.assert_array_equal(grouped(params, folder, "shuffled", seed=3), found)
    assert np.abs(grouped(params, folder, "shuffled", seed=4) - found).max() > VISIBLE


@pytest.mark.parametrize("grouping", GROUPINGS)
def test_descriptors_are_unit_vectors(params, folder, grouping):
    norms = np.linalg.norm(grouped(params, folder, grouping), axis=1)
    np.testing.assert_allclose(norms, 1, atol=1e-6)  # float32, some roundings


def test_an_unreadable_image_is_seen_by_none(params, benchmark, images, folder, tmp_path):
    bad = tmp_path / "bad.jpg"
    bad.write_bytes(b"")
    paths = [*benchmark.database[:2], bad, *benchmark.database[2:4]]
    found = read_tokens(
        params, MODEL, paths, batch_size=BATCH, label="", on_bad_image="skip", quiet=True
    )
    np.testing.assert_array_equal(found.readable, [True, True, False, True, True])
    descriptors = grouped(params, found, "sequential")
    alike(descriptors[[0, 1, 3]], np.asarray(describe(params, images[:3], MODEL)))
    alike(descriptors[4:], np.asarray(describe(params, images[3:4], MODEL)))
    with pytest.raises(InputError, match=f"^{bad}: "):
        read_tokens(params, MODEL, paths, batch_size=BATCH, label="", quiet=True)


def test_recalls_equal_brute_force(params, benchmark):
    results = evaluate(params, MODEL, benchmark, batch_size=BATCH, seed=7, quiet=True)
    assert [result.grouping for result in results] == ["single", "shuffled", "sequential"]
    database, queries = pictures(benchmark.database), pictures(benchmark.queries)
    positions = [
        np.array([float(path.name.split("@")[1]) for path in paths])
        for paths in (benchmark.database, benchmark.queries)
    ]
    right = np.abs(positions[1][:, None] - positions[0][None, :]) <= 25
    assert right.any(axis=1).tolist() == [True] * 4 + [False]
    # Database and queries are shuffled apart, by this seed and the next.
    order = np.random.default_rng(7).permutation(7), np.random.default_rng(8).permutation(5)
    expected = {
        "single": [
            np.concatenate([describe(params, image[None], MODEL) for image in side])
            for side in (database, queries)
        ],
        "shuffled": [
            in_batches(params, side, o) for side, o in zip((database, queries), order, strict=True)
        ],
        "sequential": [
            in_batches(params, side, np.arange(len(side))) for side in (database, queries)
        ],
    }
    for result in results:
        a, b = expected[result.grouping]
        ranking = np.argsort(-(b @ a.T), axis=1, kind="stable")
        np.testing.assert_array_equal(result.neighbours.indices, ranking)
        hits = np.take_along_axis(right, ranking, axis=1)
        for k in (1, 5, 10, 20):
            # 4/5 at most: a query without positives is a miss.
            assert result.recalls[k] == hits[:, :k].any(axis=1).mean()
    assert results[0].recalls[20] == 0.8


def test_only_the_groupings_asked_for_in_their_order(params, benchmark):
    results = evaluate(
        params,
        MODEL,
        benchmark,
        groupings=("sequential", "single"),
        batch_size=BATCH,
        quiet=True,
    )
    assert [result.grouping for result in results] == ["sequential", "single"]


def test_without_an_encoder_no_descriptor_depends_on_its_batch(benchmark):
    params = random_params(WITHOUT_ENCODER)
    folder = read_tokens(
        params, WITHOUT_ENCODER, benchmark.database, batch_size=BATCH, label="", quiet=True
    )
    single, shuffled, sequential = (
        group(params, WITHOUT_ENCODER, folder, name, batch_size=BATCH) for name in GROUPINGS
    )
    np.testing.assert_array_equal(shuffled, single)
    np.testing.assert_array_equal(sequential, single)
    (result,) = evaluate(params, WITHOUT_ENCODER, benchmark, batch_size=BATCH, quiet=True)
    assert result.grouping == "any"


def test_an_image_that_cannot_be_read_stops_an_evaluation(params, town: pathlib.Path):
    benchmark = open_benchmark(town)
    benchmark.queries[2].write_bytes(benchmark.queries[2].read_bytes()[:200])
    with pytest.raises(InputError, match=f"^{benchmark.queries[2]}: .*cut short"):
        evaluate(params, MODEL, benchmark, batch_size=BATCH, quiet=True)


@pytest.mark.parametrize(
    ("groupings", "batch_size", "seed", "words"),
    [
        (("single", "sorted"), 4, 0, "grouping: found 'sorted', expected one of sequential, shuf"),
        (("",), 4, 0, "grouping: found ''"),
        (("single",), 0, 0, "batch size: found 0, expected at least 1"),
        (("single",), 4, -1, "seed: found -1, expected at least 0"),
    ],
)
def test_bad_groupings_are_named(groupings, batch_size, seed, words):
    with pytest.raises(InputError, match=words):
        check_grouping(groupings, batch_size, seed)


def test_an_observer_sees_the_descriptors_of_each_grouping(
    benchmark: Benchmark, params, images: np.ndarray
):
    seen = {}

    def observe(grouping: str, database: np.ndarray, queries: np.ndarray) -> None:
        seen[grouping] = database, queries

    results = evaluate(
        params,
        MODEL,
        benchmark,
        groupings=("single", "sequential"),
        batch_size=BATCH,
        observe=observe,
        quiet=True,
    )
    assert list(seen) == ["single", "sequential"]
    first = describe(params, images[:BATCH], MODEL)
    np.testing.assert_allclose(seen["sequential"][0][:BATCH], first, rtol=0, atol=TOLERANCE)
    for result in results:
        database, queries = seen[result.grouping]
        best = (queries @ database.T).max(axis=1)
        np.testing.assert_allclose(result.neighbours.similarities[:, 0], best, atol=TOLERANCE)
