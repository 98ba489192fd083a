"""Figures for notebooks."""

import dataclasses

import cv2
import jax
import numpy as np
import PIL.Image
import pytest

import crisalad_jax as cj
from crisalad_jax.evaluation.results import GroupingResult
from crisalad_jax.experiments.report.transport import CLUSTER_COLOURS
from crisalad_jax.nn.model import parameter_shapes
from crisalad_jax.retrieval.neighbours import Neighbours
from tests.conftest import MODEL


def _pixels(figure):
    shown = cv2.imdecode(np.frombuffer(figure._repr_jpeg_(), np.uint8), cv2.IMREAD_COLOR)
    assert shown.shape[1] == round(figure.get_figwidth() * figure.dpi)
    return shown[..., ::-1]


def test_transport_shows_picture_dustbin_and_clusters(params, benchmark, tmp_path):
    image = cj.read_image(benchmark.queries[0])
    figure = cj.show_transport(image, params, MODEL)
    first, dustbin, clusters = figure.axes
    np.testing.assert_array_equal(first.images[0].get_array(), image)
    # Twelve patches for four clusters leave two thirds in the dustbin, within what three
    # iterations leave.
    assert dustbin.get_title(loc="left") in (
        "dustbin: 66 % of the mass",
        "dustbin: 67 % of the mass",
    )
    legend = [text.get_text() for text in clusters.get_legend().get_texts()]
    assert len(legend) == len({label.split(":")[0] for label in legend}) <= 4
    colours = [patch.get_facecolor()[:3] for patch in clusters.get_legend().get_patches()]
    expected = [[int(c[i : i + 2], 16) / 255 for i in (1, 3, 5)] for c in CLUSTER_COLOURS]
    np.testing.assert_allclose(colours, expected[: len(colours)])
    assert _pixels(figure).std() > 10  # not blank
    same = cj.show_transport(benchmark.queries[0], params, MODEL)
    np.testing.assert_array_equal(_pixels(same), _pixels(figure))


def test_a_model_without_a_transport_is_refused(benchmark):
    alone = cj.CrossImageConfig(layers=0)
    model = dataclasses.replace(MODEL, aggregator="gem", cross_image=alone)
    other = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), parameter_shapes(model))
    with pytest.raises(cj.InputError, match="found gem, expected one that transports"):
        cj.show_transport(benchmark.queries[0], other, model)


def _result(benchmark):
    count = len(benchmark.queries)
    first = [int(p[0]) if len(p) else 0 for p in benchmark.positives]
    wrong = [(index + 3) % len(benchmark.database) for index in first]
    indices = np.stack([first, wrong], axis=1)
    similarities = np.tile([0.75, 0.5], (count, 1))
    return GroupingResult("single", {1: 0.8}, Neighbours(indices, similarities))


def test_retrievals_of_a_result_are_marked(benchmark):
    figure = cj.show_retrievals(_result(benchmark), benchmark, queries=[1, 0])
    captions = [axes.get_xlabel() for axes in figure.axes]
    marked = ["1   0.750   \N{CHECK MARK}", "2   0.500   \N{BALLOT X}"]
    assert captions == ["query 1", *marked, "query 0", *marked]
    assert _pixels(figure).std() > 10


@pytest.mark.parametrize("queries", [[5], [-1], []])
def test_retrievals_refuse_queries_that_are_not_there(benchmark, queries):
    with pytest.raises(cj.InputError, match=r"queries: found .* expected numbers from 0 to 4"):
        cj.show_retrievals(_result(benchmark), benchmark, queries=queries)


def test_a_result_needs_its_benchmark(benchmark):
    with pytest.raises(cj.InputError, match="benchmark: found none for a result"):
        cj.show_retrievals(_result(benchmark))


def test_what_is_shown_is_of_the_right_class(params, benchmark):
    """Each is one line that names the argument; the order of a model's calls is refused too."""
    picture = PIL.Image.open(benchmark.queries[0])
    for arguments, words in (
        ((picture, params, MODEL), "image: found JpegImageFile, expected uint8 or uint16"),
        ((params, picture, MODEL), "image: found parameters, .* show_transport\\(image, params, c"),
    ):
        with pytest.raises(cj.InputError, match=words):
            cj.show_transport(*arguments)
    with pytest.raises(cj.InputError, match="found: found str, expected answers of `query`, or"):
        cj.show_retrievals("own")
    with pytest.raises(cj.InputError, match="benchmark: found str, expected one of"):
        cj.show_retrievals(_result(benchmark), "town")
