"""Verified answers of a map: their order, what is known, and the calibration of inliers."""

import dataclasses
import json

import numpy as np
import pytest

from crisalad_jax.cli.query import answer_lines
from crisalad_jax.data.benchmarks import open_benchmark
from crisalad_jax.data.images import read_image
from crisalad_jax.data.live import FolderWatch, Frame
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.calibrate import calibrate, operating_point_of
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.maps.calibration import VERIFIED, read_calibration, write_calibration
from crisalad_jax.retrieval.maps.live import query_live
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.query import json_lines
from crisalad_jax.retrieval.reranking import Reranker, Reranking
from crisalad_jax.retrieval.sequence import BayesFilter
from crisalad_jax.retrieval.verification.verify import Verifier, Verify, order_by_inliers
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note
from tests.conftest import BATCH, MODEL
from tests.retrieval.maps.conftest import ask
from tests.retrieval.maps.test_calibration import folder, remembered  # noqa: F401

QUIET = Reading(batch_size=BATCH, quiet=True)


@pytest.fixture(scope="module")
def plain(town_map, params, sides):
    return ask(town_map, params, sides[1], k=7)


@pytest.fixture(scope="module")
def counted(town_map, plain):
    """The inliers of each query with its answers, pair by pair."""
    with Map.open(town_map) as places:
        verifier = Verifier(Verify())
        names = [
            [(places.images[i].root, places.images[i].name) for i in row]
            for row in plain.neighbours.indices
        ]
        return [
            [verifier.check(read_image(path), [name])[0].inliers for name in row]
            for path, row in zip(plain.queries, names, strict=True)
        ]


def test_the_first_answers_are_verified_and_put_in_order(town_map, params, sides, plain, counted):
    found = ask(town_map, params, sides[1], k=7, verify=Verify(answers=5))
    for number, (old, similarities) in enumerate(zip(*plain.neighbours, strict=True)):
        order = order_by_inliers(similarities[:5], counted[number][:5])
        new = [*old[:5][order], *old[5:]]
        assert found.neighbours.indices[number].tolist() == new
        inliers = [check.inliers for check in found.checks[number]]
        assert inliers == [counted[number][i] for i in order]
    np.testing.assert_array_equal(found.best, plain.neighbours.similarities[:, 0])
    assert any(max(row) > 20 for row in counted)  # or nothing was verified


def test_more_are_verified_than_are_asked_for(town_map, params, sides):
    most = ask(town_map, params, sides[1], k=5, verify=Verify(answers=5))
    least = ask(town_map, params, sides[1], k=2, verify=Verify(answers=5))
    np.testing.assert_array_equal(least.neighbours.indices, most.neighbours.indices[:, :2])
    assert [len(checks) for checks in least.checks] == [2] * 5
    all_of_them = ask(town_map, params, sides[1], k=2, verify=Verify(answers=99))
    assert all_of_them.neighbours.indices.shape == (5, 2)


def test_json_and_lines_have_inliers(town_map, params, sides):
    found = ask(town_map, params, sides[1], k=3, verify=Verify(answers=2))
    rows = [json.loads(line) for line in json_lines(found)]
    for row, checks in zip(rows, found.checks, strict=True):
        first, second, third = row["neighbours"]
        assert first["verified"]["inliers"] == checks[0].inliers
        assert set(second["verified"]) == {"inliers", "matches", "confidence"}
        assert "verified" not in third
        assert "known" not in row
    head, _, first, *_, last = answer_lines(found)
    assert head.split()[:4] == ["rank", "similarity", "inliers", "confidence"]
    assert first.split()[2] == str(found.checks[0][0].inliers)
    assert last.split()[2:4] == ["-", "-"]


def test_too_few_inliers_are_of_an_unknown_place(town_map, params, sides, counted):
    found = ask(town_map, params, sides[1], verify=Verify(answers=1))
    first = [row[0] for row in counted]
    least = sorted(first)[2]
    strict = ask(town_map, params, sides[1], verify=Verify(answers=1, min_inliers=least))
    assert strict.known.tolist() == [count >= least for count in first]
    assert found.known.all()
    assert [json.loads(line)["known"] for line in json_lines(strict)] == strict.known.tolist()
    middle = float(np.sort(found.best)[2])
    both = ask(
        town_map,
        params,
        sides[1],
        min_similarity=middle,
        verify=Verify(answers=1, min_inliers=least),
    )
    assert both.known.tolist() == [
        count >= least and best >= middle for count, best in zip(first, found.best, strict=True)
    ]


def test_a_filter_s_answers_are_verified_too(town_map, params, sides):
    found = ask(town_map, params, sides[1], k=3, verify=Verify(answers=3), sequence=BayesFilter())
    plain = ask(town_map, params, sides[1], k=3, sequence=BayesFilter())
    for number, indices in enumerate(found.neighbours.indices):
        pairs = dict(
            zip(plain.neighbours.indices[number], plain.probabilities[number], strict=True)
        )
        assert found.probabilities[number].tolist() == [pairs[i] for i in indices]
    np.testing.assert_array_equal(found.best, plain.best)


def test_images_as_they_come_are_verified(town_map, params, sides, tmp_path, monkeypatch, plain):
    image = read_image(plain.queries[0])
    frames = [Frame("a.jpg", 0.0, image, 0.0)]
    monkeypatch.setattr(FolderWatch, "frames", lambda *_: iter(frames))
    with Map.open(town_map) as places:
        model = Model(params, places.config)
        live = query_live(places, FolderWatch(tmp_path), model=model, k=2, verify=Verify(answers=2))
        (answer,) = live
    (row,) = (json.loads(answer.json_line()),)
    expected = ask(town_map, params, plain.queries[0], k=2, verify=Verify(answers=2))
    assert row["neighbours"][0]["verified"]["inliers"] == expected.checks[0][0].inliers


def test_inliers_are_calibrated(folder, params, shared, sides):  # noqa: F811
    benchmark = open_benchmark(shared / "town")
    with Map.open(folder) as places:
        found = calibrate(
            places,
            benchmark,
            0.9,  # one query of five shows no place of the map
            model=Model(params, places.config),
            verify=Verify(answers=2),
            reading=QUIET,
        )
        model = places.metadata.model
    assert read_calibration(folder, model, VERIFIED) == found
    assert read_calibration(folder, model) is None
    assert (found.min_similarity, found.verifier) == (-1, "sift")
    assert operating_point_of(found).min_similarity == found.min_inliers > 0
    # The same queries: as many are answered as then. Similarity does not count.
    answers = ask(folder, params, sides[1], verify=Verify(answers=2))
    assert (answers.min_similarity, answers.min_inliers) == (None, found.min_inliers)
    assert answers.known.sum() == found.answered
    assert ask(folder, params, sides[1]).min_inliers is None
    # What is asked for stands before it.
    assert ask(folder, params, sides[1], verify=Verify(min_inliers=0)).known.all()


def test_inliers_of_another_matcher_are_not_used(folder, params, sides):  # noqa: F811
    remembered(folder, min_similarity=0.25)
    own = remembered(folder, min_similarity=-1.0, min_inliers=9, verifier="onnx abc")
    with pytest.warns(Note, match=r"calibration-verified\.json: found inliers of onnx abc"):
        found = ask(folder, params, sides[1], verify=Verify(answers=1))
    assert (found.min_similarity, found.min_inliers) == (0.25, 0 or None)
    write_calibration(folder, dataclasses.replace(own, verifier="sift"))
    found = ask(folder, params, sides[1], verify=Verify(answers=1))
    assert (found.min_similarity, found.min_inliers) == (None, 9)


def test_the_second_stage_puts_them_in_the_same_order(sides, plain, counted, town_map):
    with Map.open(town_map) as places:
        files = [sides[0] / image.name for image in places.images]
    with Reranking("local", 5).stage(files, plain.queries, QUIET) as stage:
        indices, scores = stage(plain.neighbours)
        again = stage(plain.neighbours)
    for number, (old, similarities) in enumerate(zip(*plain.neighbours, strict=True)):
        order = order_by_inliers(similarities[:5], counted[number][:5])
        assert indices[number].tolist() == [*old[:5][order], *old[5:]]
        assert scores[number, :5].tolist() == [counted[number][i] for i in order]
    np.testing.assert_array_equal(again.indices, indices)


def test_the_second_stage_takes_any_model():
    reranking = Reranking("local", 5)
    reranking.check(dataclasses.replace(MODEL, cross_image="none"), 5)
    with pytest.raises(InputError, match="rerank: found local:5 over a database of 4 images"):
        reranking.check(MODEL, 4)
    with pytest.raises(InputError, match=r"rerank: found local:5 without a model, .*stage"):
        Reranker(reranking, [], [])
