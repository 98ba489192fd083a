"""What a map remembers, which answers it calls unknown, and cameras that are followed."""

import dataclasses
import json
import pathlib
import shutil

import jax
import numpy as np
import pytest

import crisalad_jax.retrieval.maps.build
import crisalad_jax.retrieval.maps.tracking
from crisalad_jax.cli.query import answer_lines
from crisalad_jax.data.images import list_images
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.calibrate import calibrate, operating_point_of
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.maps.build import index
from crisalad_jax.retrieval.maps.calibration import (
    CALIBRATION,
    Calibration,
    read_calibration,
    write_calibration,
)
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.query import Answers, json_lines
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.retrieval.sequence import BayesFilter
from crisalad_jax.utils.errors import InputError
from tests.conftest import BATCH, MODEL, describe_single, random_params
from tests.retrieval.maps.conftest import ask

QUIET = Reading(batch_size=BATCH, quiet=True)


@pytest.fixture
def queries(sides) -> pathlib.Path:
    return sides[1]


@pytest.fixture
def folder(town_map, tmp_path) -> pathlib.Path:
    """A copy to spoil."""
    return shutil.copytree(town_map, tmp_path / "map")


def remembered(folder: pathlib.Path, **changes) -> Calibration:
    """A calibration that was never measured, in the map."""
    with Map.open(folder) as places:
        model = places.metadata.model
    counts = {"answered": 4, "right": 4, "queries": 5, "unknown": 1, "unknown_answered": 0}
    known = {"min_similarity": 0.5, "precision": 0.9, "benchmark": "town", "rule": "25 m"}
    calibration = Calibration(**counts | known | {"database": 7, "model": model} | changes)
    write_calibration(folder, calibration)
    return calibration


# What is remembered


def test_a_map_remembers_the_point_of_an_evaluation(folder, params, benchmark):
    (result,) = evaluate(
        Model(params, MODEL), benchmark, groupings=["single"], precision=0.4, reading=QUIET
    )
    point = result.operating_point
    assert point is not None
    assert point.reached
    with Map.open(folder) as places:
        assert places.calibration is None
        assert places.summary()["calibration"] is None
        found = calibrate(places, benchmark, 0.4, model=Model(params, places.config), reading=QUIET)
        assert places.calibration is found
        assert found.model == places.metadata.model
    assert operating_point_of(found) == point
    assert (found.benchmark, found.rule, found.database) == (benchmark.name, benchmark.rule, 7)
    with Map.open(folder) as places:
        assert places.calibration == found
        assert places.summary()["calibration"]["min_similarity"] == found.min_similarity
    assert not list(folder.glob(".crisalad-*"))


def test_a_precision_out_of_reach_leaves_what_was_there(folder, params, benchmark):
    before = remembered(folder)
    # The far query alone: whatever is answered is wrong.
    lost = dataclasses.replace(
        benchmark,
        queries=benchmark.queries[-1:],
        query_positions=None,
        database_positions=None,
        positives=(np.array([], np.int64),),
    )
    words = "precision: no similarity reaches a precision of 99 %; the highest is 0.0 %"
    with Map.open(folder) as places:
        with pytest.raises(InputError, match=words):
            calibrate(places, lost, model=Model(params, places.config), reading=QUIET)
        assert places.calibration == before
    with Map.open(folder) as places:
        assert places.calibration == before


def test_another_model_calibrates_nothing(folder, benchmark):
    changed = jax.tree.map(lambda leaf: np.asarray(leaf) * 1.5, random_params(MODEL))
    with Map.open(folder) as places, pytest.raises(InputError, match="but the given model is"):
        calibrate(places, benchmark, model=Model(changed, places.config), reading=QUIET)
    assert not (folder / CALIBRATION).exists()


def test_a_calibration_that_is_not_this_maps_is_refused(folder):
    path = folder / CALIBRATION
    remembered(folder, model="0" * 64)
    with pytest.raises(InputError, match=r"calibration.json: found a calibration of model 0{12},"):
        Map.open(folder)
    path.unlink()
    remembered(folder)
    path.write_text(path.read_text().replace("0.5", "0.4"))
    with pytest.raises(InputError, match=r"calibration.json: .*changed"):
        Map.open(folder)
    # Who edits the file removes its checksum.
    value = json.loads(path.read_text())
    del value["checksum"]
    path.write_text(json.dumps(value))
    with Map.open(folder) as places:
        assert places.calibration is not None
        assert places.calibration.min_similarity == 0.4
    for changes, words in (
        ({"min_similarity": 1.5}, r"found similarity 1.5, expected one from -1 to 1"),
        ({"min_similarity": -1.5}, r"found similarity -1.5, expected one from -1 to 1"),
        ({"format": 2}, r"found 2, expected one of 1 @ config\.format"),
    ):
        path.write_text(json.dumps(value | changes))
        with pytest.raises(InputError, match=words):
            Map.open(folder)


def test_a_map_with_a_calibration_grows(folder, params, shared, queries):
    before = remembered(folder)
    weights = shared / "weights.safetensors"
    grown = index(Model(params, MODEL), queries, folder, weights=weights, reading=QUIET)
    assert grown.images == 12
    with Map.open(folder) as places:
        assert places.calibration == before
    assert read_calibration(folder.parent / "none", before.model) is None


# Unknown places


def test_answers_below_the_similarity_are_unknown(folder, params, queries):
    plain = ask(folder, params, queries, k=2)
    best = plain.neighbours.similarities[:, 0].astype(np.float64)
    assert plain.min_similarity is None
    assert plain.known.tolist() == [True] * 5
    ordered = np.sort(best)
    below = int(np.diff(ordered).argmax()) + 1  # at the largest gap
    between = float(ordered[below - 1 : below + 1].mean())
    given = ask(folder, params, queries, k=2, min_similarity=between)
    assert int((~given.known).sum()) == below
    np.testing.assert_array_equal(given.known, best >= between)
    remembered(folder, min_similarity=between)
    by_map = ask(folder, params, queries, k=2)
    assert (by_map.min_similarity, by_map.known.tolist()) == (between, given.known.tolist())
    np.testing.assert_array_equal(by_map.neighbours.indices, plain.neighbours.indices)
    # Switched off, the answers are those of a map that remembers nothing, to the last byte.
    off = ask(folder, params, queries, k=2, min_similarity=-1)
    assert off.min_similarity is None
    assert list(json_lines(off)) == list(json_lines(plain))
    with pytest.raises(InputError, match="min_similarity: found similarity 2, expected one from"):
        ask(folder, params, queries, min_similarity=2)


def hand_made(min_similarity: float | None, images) -> Answers:
    paths = [pathlib.Path("a.jpg"), pathlib.Path("b.jpg")]
    similarities = np.array([[0.9, 0.8], [0.3, 0.2]], np.float32)
    neighbours = Neighbours(np.array([[0, 1], [1, 0]]), similarities)
    return Answers(paths, neighbours, images, ("east", "north"), min_similarity=min_similarity)


def test_unknown_places_in_json_and_in_the_table(town_map):
    with Map.open(town_map) as places:
        images = places.images
    lines = [json.loads(line) for line in json_lines(hand_made(0.5, images))]
    assert [line["known"] for line in lines] == [True, False]
    assert [len(line["neighbours"]) for line in lines] == [2, 2]
    plain = [json.loads(line) for line in json_lines(hand_made(None, images))]
    assert [set(line) for line in plain] == [{"query", "neighbours"}] * 2
    _, first, _, second, other, unknown = answer_lines(hand_made(0.5, images))
    assert (first, other) == ("a.jpg", "b.jpg")
    assert unknown.split() == ["-", "0.300", "-", "unknown"]
    assert second.split()[-1] == images[1].name


def test_a_similarity_equal_to_the_least_is_known():
    """float32(0.3) is above 0.3: in float32 a threshold a little above it would accept it."""
    answers = hand_made(float(np.float32(0.3)), [])
    assert answers.known.tolist() == [True, True]
    above = hand_made(float(np.float32(0.3)) + 1e-12, [])
    assert above.known.tolist() == [True, False]


# Cameras that are followed


@pytest.mark.parametrize("numbers", [14, 2**25])
def test_a_followed_camera_is_that_of_the_filter(town_map, params, queries, monkeypatch, numbers):
    """In portions of two frames, and at once; the map has two segments. Names say @UTM positions,
    so that it moves in metres."""
    monkeypatch.setattr(crisalad_jax.retrieval.maps.tracking, "_NUMBERS", numbers)
    settings = BayesFilter(reach=1)
    found = ask(town_map, params, queries, k=3, sequence=settings)
    with Map.open(town_map) as places:
        rows = np.concatenate(list(places.descriptors)).astype(np.float64)
    asked = describe_single(Model(params, MODEL), list_images(queries)).astype(np.float64)
    similarities = asked @ rows.T
    spots = [
        np.array([path.name.split("@")[1:3] for path in list_images(side)], float)
        for side in (queries.parent / "database", queries)
    ]
    steps = [np.hypot(*np.diff(side, axis=0).T) for side in spots]
    along, moved = np.append(0, np.cumsum(steps[0])), np.append(np.inf, steps[1])
    expected = settings.follow(similarities, rows @ rows.mean(axis=0), along, moved)
    np.testing.assert_array_equal(found.neighbours.indices[:, 0], expected.places)
    assert found.probabilities is not None
    # The map multiplies in float32: errors of 1e-7 over deviations of about 1e-1, in an exponent.
    np.testing.assert_allclose(found.probabilities[:, 0], expected.probabilities, rtol=1e-3)
    chosen = np.take_along_axis(similarities, found.neighbours.indices, axis=1)
    np.testing.assert_allclose(found.neighbours.similarities, chosen, atol=1e-6)  # float32
    assert (np.diff(found.probabilities, axis=1) <= 0).all()
    # A frame is known by the image that is most similar, which need not be the answer.
    best = similarities.max(axis=1)
    assert found.best is not None
    np.testing.assert_allclose(found.best, best, atol=1e-6)  # float32
    between = float(np.sort(best)[:2].mean())
    known = found._replace(min_similarity=between).known
    assert known.tolist() == (best > between).tolist()
    (_, first), *_ = found.rows()
    assert [answer.probability for answer in first] == found.probabilities[0].tolist()
    line = json.loads(next(json_lines(found)))
    assert line["neighbours"][0]["probability"] == pytest.approx(
        expected.probabilities[0], rel=1e-3
    )
    assert "probability" in next(answer_lines(found))
