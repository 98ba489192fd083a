"""Settings and notes of evaluations: what was asked stands beside what was found."""

import json
import pathlib

import numpy as np
import pytest

from crisalad_jax.config.io import to_plain
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.evaluation.record import Record, evaluation_record, table_notes
from crisalad_jax.evaluation.results import ANY, GroupingResult, to_json
from crisalad_jax.evaluation.similarity import FirstSimilarities, similarity_map
from crisalad_jax.retrieval.neighbours import Neighbours
from tests.conftest import BATCH, MODEL

NEIGHBOURS = Neighbours(np.zeros((1, 1), np.int64), np.ones((1, 1), np.float32))


ASKED = {"weights": pathlib.Path("w.safetensors"), "batch_size": BATCH, "seeds": 2, "pca": None}


def result(grouping: str, rerank: str | None = None) -> GroupingResult:
    return GroupingResult(grouping, {1: 0.5}, NEIGHBOURS, rerank=rerank)


RESULTS = [result("single"), result("single", "transvpr:3")]


@pytest.fixture
def record(benchmark: Benchmark) -> Record:
    return evaluation_record(RESULTS, benchmark, MODEL, model_name="mine", **ASKED)


def test_settings_are_what_was_asked(record, benchmark):
    settings = record.settings
    assert settings == json.loads(json.dumps(settings))
    assert settings == ASKED | {
        "weights": "w.safetensors",
        "benchmark": benchmark.name,
        "rule": benchmark.rule,
        "same_place": "a distance of at most 25 m",
        "model": to_plain(MODEL),
    }


def test_results_are_written_with_them(record, benchmark):
    found = json.loads(json.dumps(record.values))
    rows = found.pop("results")
    assert found.pop("skipped") == {"queries": [], "database": []}
    assert found == record.settings
    names = {"benchmark": benchmark.name, "model": "mine"}
    assert rows == [names | json.loads(json.dumps(to_json(each))) for each in RESULTS]


def test_notes_are_of_what_the_table_shows(record):
    settings = record.settings
    assert record.notes == table_notes(RESULTS, settings)
    alone = table_notes([result(ANY)], settings)
    assert alone[1:] == ["No cross-image encoder: no descriptor depends on its batch."]
    _, grouped = table_notes([result("single"), result("window/single")], settings)
    assert f"in its batch of {BATCH}: single = each image independently; window = every" in grouped
    assert "place, by a distance of at most 25 m" in grouped
    results = [result("shuffled"), result("shuffled", "transvpr:3")]
    *_, shuffled, ranked = table_notes(results, settings)
    assert shuffled.startswith("Shuffled: mean of 2 seeds ± their standard deviation")
    assert ranked.startswith("+ transvpr:3: the first 3 retrievals by its scores")
    assert len(table_notes(results, settings | {"seeds": 1})) == 3


def test_similarities_of_the_first_grouping_are_kept():
    generator = np.random.default_rng(0)
    sides = [generator.standard_normal((n, 4)).astype(np.float32) for n in (5, 3)]
    sides = [side / np.linalg.norm(side, axis=1, keepdims=True) for side in sides]
    seen = FirstSimilarities()
    assert seen.map is None
    seen("single", *sides)
    seen("sequential", *reversed(sides))
    np.testing.assert_array_equal(seen.map, similarity_map(*sides))
