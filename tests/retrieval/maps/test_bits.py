"""Maps of bits: answers against numpy's, what they refuse, and sets that are measured by bits."""

import dataclasses
import pathlib
import shutil

import numpy as np
import pytest

import crisalad_jax.retrieval.maps.build
from crisalad_jax import pack_bits
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.calibrate import calibrate
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.maps.appending import open_for_appending
from crisalad_jax.retrieval.maps.build import index
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.sequence import BayesFilter
from crisalad_jax.utils.errors import InputError
from tests.conftest import BATCH, MODEL, describe_single, random_params, read_options
from tests.killed_appends import LENGTH, metadata, names, rows
from tests.retrieval.maps.conftest import ask

QUIET = Reading(batch_size=BATCH, quiet=True)
BITS = dataclasses.replace(metadata("files"), dtype="bits")


@pytest.fixture(scope="module")
def town_bits(shared, params, sides, tmp_path_factory) -> pathlib.Path:
    """Of the town's database, in segments of four and three images; to read only."""
    out, weights = tmp_path_factory.mktemp("bits") / "map", shared / "weights.safetensors"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(crisalad_jax.retrieval.maps.build, "SEGMENT", 4)
        index(
            Model(params, MODEL), sides[0], out, weights=weights, dtype="bits", **read_options({})
        )
    return out


def similarities(queries: np.ndarray, database: np.ndarray) -> np.ndarray:
    """By counting, dimension by dimension."""
    equal = (queries[:, None] >= 0) == (database[None] >= 0)
    return 2 * equal.mean(axis=2) - 1


def test_a_map_of_bits_answers_by_the_signs(town_bits, town_map, params, sides):
    with Map.open(town_map) as whole, Map.open(town_bits) as places:
        database = np.concatenate(list(whole.descriptors))
        assert places.metadata.descriptor_length == MODEL.descriptor_dim
        assert f"{MODEL.descriptor_dim} bits" in repr(places)
        assert places.summary(verify=True)["descriptor"] == f"{MODEL.descriptor_dim} bits"
        files = sorted((town_bits / "segments").glob("*.npy"))
        assert [np.load(file).shape for file in files] == [
            (4, MODEL.descriptor_dim // 8),
            (3, MODEL.descriptor_dim // 8),
        ]
        np.testing.assert_array_equal(
            np.concatenate([np.load(file) for file in files]), pack_bits(database)
        )
        signs = np.concatenate(list(places.descriptors))
        np.testing.assert_allclose(np.linalg.norm(signs, axis=1), 1, atol=1e-6)
        np.testing.assert_array_equal(signs >= 0, database >= 0)
        assert len(places.images) == len(whole.images)
    answers = ask(town_bits, params, sides[1], k=7)
    asked = describe_single(Model(params, MODEL), answers.queries)
    expected = similarities(asked, database)
    order = np.argsort(-expected, axis=1, kind="stable")
    np.testing.assert_array_equal(answers.neighbours.indices, order)
    # Rounded to float32.
    np.testing.assert_allclose(
        answers.neighbours.similarities, np.take_along_axis(expected, order, axis=1), atol=1e-7
    )
    # By a filter of consecutive frames, which takes the similarities to all images.
    followed = ask(town_bits, params, sides[1], k=1, sequence=BayesFilter())
    found = np.take_along_axis(expected, followed.neighbours.indices, axis=1)
    np.testing.assert_allclose(followed.neighbours.similarities, found, atol=1e-6)


def test_a_map_grows_by_numbers_or_by_packed_bits(tmp_path):
    database = rows(0, 12)
    with open_for_appending(tmp_path / "map", BITS) as places:
        places.append(names(0, 5), [1] * 5, database[:5], root="/r")
        # Of any length: the signs count alone.
        places.append(names(5, 4), [1] * 4, 7 * database[5:9], root="/r")
        places.append(names(9, 3), [1] * 3, pack_bits(database[9:]), root="/r")
    with Map.open(tmp_path / "map") as places:
        for queries in (database, pack_bits(database)):
            found = places.search(queries, 12)
            expected = similarities(database, database)
            order = np.argsort(-expected, axis=1, kind="stable")
            np.testing.assert_array_equal(found.indices, order)
        # A thirty-second of float32's.
        for segment in (tmp_path / "map" / "segments").glob("*.npy"):
            assert np.load(segment).nbytes * 32 == len(np.load(segment)) * LENGTH * 4


def test_bits_and_numbers_in_one_map_are_refused(town_bits, town_map, params, sides, tmp_path):
    for folder, dtype, words in (
        (town_bits, "float32", "found dtype float32, expected bits as in the map"),
        (town_map, "bits", "found dtype bits, expected float32 as in the map"),
    ):
        with pytest.raises(InputError, match=words):
            index(Model(params, MODEL), sides[0], folder, weights="w", dtype=dtype, reading=QUIET)
    with Map.open(town_map) as places:
        bits = pack_bits(np.concatenate(list(places.descriptors)))
        with pytest.raises(InputError, match=r"^queries: found packed bits .uint8., expected desc"):
            places.search(bits, 1)
    with Map.open(town_bits) as places:
        for queries, words in (
            (bits[:, 1:], "queries: found uint8 .*, expected packed bits"),
            (np.ones((1, 8)), "queries: found shape .1, 8., expected"),
        ):
            with pytest.raises(InputError, match=words):
                places.search(queries, 1)
        with pytest.raises(InputError, match="search: found hnsw for a map of bits, expected"):
            places.build_search("hnsw")
    with pytest.raises(InputError, match=r"dtype: found 'bits', expected float32 in milvus:x.db"):
        dataclasses.replace(BITS, store="milvus:x.db")
    odd = dataclasses.replace(MODEL.aggregator, token_dim=17)
    config = dataclasses.replace(MODEL, aggregator=odd, cross_image="none")
    with pytest.raises(InputError, match="dtype: found 49 dimensions, expected a mul"):
        index(
            Model(random_params(config), config),
            sides[0],
            tmp_path / "odd",
            weights="w",
            dtype="bits",
            reading=QUIET,
        )
    assert not (tmp_path / "odd").exists()


def test_a_set_is_evaluated_by_bits(params, benchmark):
    seen = []
    (result,) = evaluate(
        Model(params, MODEL),
        benchmark,
        groupings=["single"],
        dtype="bits",
        observe=lambda _, *sides: seen.append(sides),
        reading=QUIET,
    )
    database, queries = (
        describe_single(Model(params, MODEL), paths)
        for paths in (benchmark.database, benchmark.queries)
    )
    expected = similarities(queries, database)
    order = np.argsort(-expected, axis=1, kind="stable")[:, :20]
    np.testing.assert_array_equal(result.neighbours.indices, order)
    np.testing.assert_allclose(
        result.neighbours.similarities, np.take_along_axis(expected, order, axis=1), atol=1e-7
    )
    ((observed, _),) = seen
    np.testing.assert_array_equal(observed >= 0, database >= 0)


def test_a_map_of_bits_remembers_a_similarity_of_bits(town_bits, params, benchmark, tmp_path):
    folder = shutil.copytree(town_bits, tmp_path / "map")
    (result,) = evaluate(
        Model(params, MODEL),
        benchmark,
        groupings=["single"],
        dtype="bits",
        precision=0.4,
        reading=QUIET,
    )
    assert result.operating_point is not None
    with Map.open(folder) as places:
        found = calibrate(places, benchmark, 0.4, model=Model(params, places.config), reading=QUIET)
    assert found.min_similarity == result.operating_point.min_similarity
