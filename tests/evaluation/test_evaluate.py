"""Groupings against `describe` on the very images, and recalls against brute force."""

import dataclasses
import re

import faiss
import numpy as np
import pytest

from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.images import read_image
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.resize import resize_image
from crisalad_jax.evaluation.evaluate import evaluate, same_place_rule
from crisalad_jax.nn.model import Model, describe
from crisalad_jax.retrieval.describe import TokenSet, group
from crisalad_jax.retrieval.describer import describer_of
from crisalad_jax.retrieval.grouping import GROUPINGS, batches_of
from crisalad_jax.utils.errors import InputError
from tests.conftest import BATCH, MODEL, random_params

# Entries of a unit descriptor of 48 numbers are of order 0.1. The same image in a batch of another
# size, or beside padding, is summed in another order: some units in the last place of float32.
TOLERANCE = 2e-6
# What a changed neighbour makes of a descriptor, far above rounding.
VISIBLE = 1e-3

READING = Reading(batch_size=BATCH, quiet=True)
WITHOUT_ENCODER = dataclasses.replace(MODEL, cross_image="none")


def pictures(paths) -> np.ndarray:
    return np.stack([resize_image(read_image(path), MODEL.image_size) for path in paths])


@pytest.fixture(scope="module")
def images(benchmark: Benchmark) -> np.ndarray:
    return pictures(benchmark.database)


def tokens_of(params, paths, config=MODEL, **options) -> TokenSet:
    reading = Reading(batch_size=BATCH, quiet=True, **options)
    return TokenSet(describer_of(Model(params, config)), paths, reading)


@pytest.fixture(scope="module")
def folder(benchmark: Benchmark, params) -> np.ndarray:
    return tokens_of(params, benchmark.database).rows


def grouped(params, rows: np.ndarray, grouping: str, config=MODEL) -> np.ndarray:
    return group(describer_of(Model(params, config)), rows, batches_of(len(rows), grouping, BATCH))


def alike(found: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(found, expected, atol=TOLERANCE, rtol=0)


def in_batches(params, images: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Each batch described by itself, the last with as few images as it has."""
    descriptors = np.empty((len(images), MODEL.descriptor_dim), np.float32)
    for start in range(0, len(images), BATCH):
        chosen = order[start : start + BATCH]
        descriptors[chosen] = describe(params, images[chosen], MODEL)
    return descriptors


@pytest.mark.parametrize("changed", range(7))
def test_a_window_owes_nothing_to_older_frames_nor_to_later_ones(params, folder, changed):
    """Through two layers of a strip with a mask, an older frame would come through."""
    assert MODEL.cross_image.layers == 2
    rows = folder.copy()
    rows[changed] = folder[(changed + 3) % 7]
    before, after = (grouped(params, each, "window") for each in (folder, rows))
    moved = np.abs(after - before).max(axis=1)
    sees = np.arange(7) - changed
    # The same program on the same numbers: to the bit.
    np.testing.assert_array_equal(moved[(sees < 0) | (sees >= BATCH)], 0)
    assert (moved[(sees >= 0) & (sees < BATCH)] > VISIBLE).all()


def test_an_unreadable_image_is_seen_by_none(params, benchmark, images, folder, tmp_path):
    bad = tmp_path / "bad.jpg"
    bad.write_bytes(b"")
    paths = [*benchmark.database[:2], bad, *benchmark.database[2:4]]
    found = tokens_of(params, paths, on_bad_image="skip")
    assert (len(found.rows), found.unreadable.tolist()) == (4, [2])
    alike(
        found.describe(found.batches("sequential", None)),
        np.asarray(describe(params, images[:4], MODEL)),
    )
    with pytest.raises(InputError, match=f"^{bad}: "):
        tokens_of(params, paths)


def test_descriptors_and_recalls_equal_brute_force(params, benchmark):
    seen = {}

    def observe(grouping: str, database: np.ndarray, queries: np.ndarray) -> None:
        assert grouping not in seen  # of several shuffles the first alone
        seen[grouping] = database, queries

    results = evaluate(
        Model(params, MODEL), benchmark, seed=7, seeds=1, observe=observe, reading=READING
    )
    assert [result.grouping for result in results] == [
        *("single", "shuffled", "sequential", "window/single")
    ]
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
    windows = [queries[max(0, i - BATCH + 1) : i + 1] for i in range(len(queries))]
    last = np.stack([describe(params, window, MODEL)[-1] for window in windows])
    expected["window/single"] = [expected["single"][0], last]
    for result in results:
        a, b = expected[result.grouping]
        for found, side in zip(seen[result.grouping], (a, b), strict=True):
            alike(found, side)
        similarities = b @ a.T
        ranking = np.argsort(-similarities, axis=1, kind="stable")
        # Two of the town's pictures are the same: their order is rounding's. All others are further
        # apart than the roundings of float32 in sums of unit vectors.
        found = result.neighbours.indices
        swapped = found != ranking
        assert set(found[swapped]) | set(ranking[swapped]) <= {5, 6}
        np.testing.assert_allclose(
            *(np.take_along_axis(similarities, each, axis=1) for each in (found, ranking)),
            atol=1e-6,
        )
        hits = np.take_along_axis(right, ranking, axis=1)
        for k in (1, 5, 10, 20):
            # 4/5 at most: a query without positives is a miss.
            assert result.recalls[k] == hits[:, :k].any(axis=1).mean()
    assert results[0].recalls[20] == 0.8


def test_without_an_encoder_no_descriptor_depends_on_its_batch(benchmark):
    params = random_params(WITHOUT_ENCODER)
    rows = tokens_of(params, benchmark.database, WITHOUT_ENCODER).rows
    single, *others = (grouped(params, rows, name, WITHOUT_ENCODER) for name in GROUPINGS)
    assert len(others) == 3
    for found in others:
        # A window's program is another one than a batch's.
        alike(found, single)
    (result,) = evaluate(Model(params, WITHOUT_ENCODER), benchmark, reading=READING)
    assert result.grouping == "any"
    assert (result.query_share, result.database_share, dict(result.by_seed)) == (None, None, {})


def test_a_set_without_ground_truth_is_refused_before_anything_is_read(params, town):
    benchmark = dataclasses.replace(open_benchmark(town), positives=None)
    benchmark.database[0].write_bytes(b"")
    with pytest.raises(InputError, match=re.escape(f"{benchmark.name}: no ground truth")):
        evaluate(Model(params, MODEL), benchmark, reading=READING)


def test_each_seed_of_a_shuffle_is_as_alone_and_what_is_not_random_is_of_one(params, benchmark):
    # The last query is far from all, and what it retrieves changes with the shuffle.
    positives = (*benchmark.positives[:4], np.array([1]))
    benchmark = dataclasses.replace(benchmark, positives=positives)
    seen = []

    def evaluated(**options):
        return evaluate(
            Model(params, MODEL),
            benchmark,
            groupings=("shuffled/single", "window/single"),
            observe=lambda grouping, *_: seen.append(grouping),
            reading=READING,
            **options,
        )

    together, window = evaluated(seed=3, seeds=3)
    assert seen == [together.grouping, window.grouping] == ["shuffled/single", "window/single"]
    assert (window.spread, dict(window.by_seed)) == (None, {})
    assert list(together.by_seed) == [3, 5, 7]
    alone = [evaluated(seed=seed, seeds=1)[0] for seed in together.by_seed]
    assert len({one.recalls[1] for one in alone}) > 1  # or there is no spread
    assert [dict(each.recalls) for each in together.by_seed.values()] == [
        dict(one.recalls) for one in alone
    ]
    assert together.query_share == pytest.approx(np.mean([one.query_share for one in alone]))
    assert (together.database_share, alone[0].spread) == (None, None)


def test_shares_are_told_by_positions_or_else_by_the_truth(params, benchmark):
    """Seven database images 40 m apart but for the last two, 10 m; five queries far apart."""
    unplaced = dataclasses.replace(benchmark, query_positions=None, database_positions=None)

    def shares(benchmark: Benchmark) -> tuple[float | None, ...]:
        (result,) = evaluate(
            Model(params, MODEL), benchmark, groupings=("window/sequential",), reading=READING
        )
        return result.query_share, result.database_share

    assert same_place_rule(benchmark) == "a distance of at most 25 m"
    assert same_place_rule(unplaced) == "a common positive"
    # By fours (0 40 80 120) and (160 200 210): each of the last two sees one of two.
    assert shares(benchmark) == (0, (0.5 + 0.5) / 7)
    # The query at 205 has both of them as positives.
    assert shares(unplaced) == (0, (0.5 + 0.5) / 7)
    # Of the queries, which look at those before them, the one at 45 m sees the one at 3 m; of the
    # database, which looks by fours, each image sees its neighbours up to 45 m away.
    wider = dataclasses.replace(benchmark, radius=45.0)
    assert shares(wider) == (1 / 4, pytest.approx((1 + 2 + 2 + 1) / 3 / 7 + (1 + 1 + 2) / 2 / 7))


def test_recalls_are_those_of_a_flat_faiss_index_on_the_same_descriptors(params, town):
    """Database images that stand there twice or thrice make exact ties."""
    folder = town / "images" / "test" / "database"
    for path in sorted(folder.iterdir())[::2]:
        for copy in "ab":
            path.with_name(path.name.replace("@.jpg", f"@{copy}.jpg")).write_bytes(
                path.read_bytes()
            )
    benchmark = open_benchmark(town)
    assert len(benchmark.database) == 15
    database, queries = (
        grouped(params, tokens_of(params, paths).rows, "single")
        for paths in (benchmark.database, benchmark.queries)
    )
    index = faiss.IndexFlatL2(database.shape[1])
    index.add(database)
    # All of the database: among equal distances FAISS promises no order, ours is by index.
    distances, indices = index.search(queries, len(database))
    ranking = np.take_along_axis(indices, np.lexsort((indices, distances), axis=1), axis=1)
    # Four images thrice; and those at 200 and 210 m are one picture.
    assert (np.diff(np.sort(distances, axis=1), axis=1) == 0).sum(axis=1).tolist() == [9] * 5
    (result,) = evaluate(Model(params, MODEL), benchmark, groupings=("single",), reading=READING)
    np.testing.assert_array_equal(result.neighbours.indices, ranking)
    for k, recall in result.recalls.items():
        right = [
            bool(set(row[:k].tolist()) & set(wanted.tolist()))
            for row, wanted in zip(ranking, benchmark.positives, strict=True)
        ]
        assert recall == np.mean(right)


def test_masked_images_are_described_with_their_batch_less_their_own_place(params, benchmark):
    """Of three to a batch, image 1 of the database is at the place of image 0."""
    moved = benchmark.database_positions.copy()
    moved[:] = np.arange(len(moved))[:, None] * 1000.0
    moved[1] = moved[0]
    seen = {}
    evaluate(
        Model(params, MODEL),
        dataclasses.replace(benchmark, database_positions=moved),
        groupings=["masked@3"],
        observe=lambda name, database, queries: seen.update({name: database}),
        reading=READING,
    )
    images = pictures(benchmark.database)
    # The image itself first.
    groups = [[0, 2], [1, 2], [2, 0, 1], [3, 4, 5], [4, 3, 5], [5, 3, 4], [6]]
    expected = [np.asarray(describe(params, images[group], MODEL))[0] for group in groups]
    alike(seen["masked@3"], np.stack(expected))


def test_a_published_grouping_is_its_size_in_file_order_and_the_honest_ones(params, benchmark):
    named = dataclasses.replace(benchmark, name="sped")
    model = Model(params, MODEL)
    found = evaluate(model, named, groupings=["published:sage"], seeds=1, reading=READING)
    assert [each.grouping for each in found] == ["sequential@2", "single", "shuffled@2", "masked@2"]
    alone = evaluate(
        model, named, groupings=["sequential"], reading=Reading(batch_size=2, quiet=True)
    )
    np.testing.assert_array_equal(found[0].neighbours.indices, alone[0].neighbours.indices)
    assert found[0].over_single.mean == found[0].recalls[1] - found[1].recalls[1]
    assert found[1].over_single is found[1].mirrored_share is None
