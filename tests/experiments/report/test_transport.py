"""What is drawn over a photograph, by its numbers and its pixels."""

import dataclasses

import cv2
import jax
import numpy as np
import PIL.Image
import pytest

import crisalad_jax as cj
from crisalad_jax.data.images import read_image
from crisalad_jax.data.resize import resize_image
from crisalad_jax.experiments.report.transport import (
    CLUSTER_COLOURS,
    Transported,
    draw_clusters,
    draw_dustbin,
    heat_range,
    strongest_clusters,
    transport_of,
)
from crisalad_jax.nn.model import parameter_shapes
from tests.conftest import MODEL

GREY = np.full((20, 30, 3), 100, np.uint8)
# Two rows of three patches, two clusters and a dustbin.
MASSES = np.array(
    [
        [[0.6, 0.1, 0.3], [0.1, 0.2, 0.7], [0.0, 0.1, 0.9]],
        [[0.3, 0.2, 0.5], [0.5, 0.5, 0.0], [0.2, 0.0, 0.8]],
    ]
)
PICTURE = Transported(GREY, MASSES, 2)
WITHOUT = Transported(GREY, MASSES[..., :2], 2)


def test_shares_by_hand():
    np.testing.assert_allclose(PICTURE.dustbin, [[0.3, 0.7, 0.9], [0.5, 0.0, 0.8]])
    assert PICTURE.dustbin_share == pytest.approx(3.2 / 6)
    assert PICTURE.top.tolist() == [[0, 1, 1], [0, 0, 0]]
    assert WITHOUT.dustbin is None
    assert WITHOUT.dustbin_share is None
    assert heat_range([PICTURE, PICTURE]) == (0.0, pytest.approx(0.9))
    # Cluster 0 is first in four patches, of which it took 0.6, 0.3, 0.5 and 0.2; 2.8 was kept.
    strongest = strongest_clusters([PICTURE])
    assert list(strongest) == [0, 1]
    assert list(strongest.values()) == pytest.approx([1.6 / 2.8, 0.3 / 2.8])
    assert list(strongest_clusters([PICTURE], most=1)) == [0]


def test_shares_are_those_of_the_model(benchmark, params):
    for path in benchmark.queries[:2]:
        picture = transport_of(read_image(path), params, MODEL)
        assert picture.masses.shape == (3, 4, MODEL.aggregator.clusters + 1)
        # Rows are updated last: each patch has sent all it has, to rounding of float32.
        np.testing.assert_allclose(picture.masses.sum(axis=-1), 1, rtol=1e-5)
        np.testing.assert_array_equal(picture.image, read_image(path))
        # Twelve patches for four clusters, within what three iterations leave.
        assert picture.dustbin_share == pytest.approx(8 / 12, abs=0.02)


def test_the_dustbin_is_bright_where_much_was_thrown_away():
    drawn = draw_dustbin(PICTURE, (0.0, 0.9), width=30)
    assert drawn.shape == (20, 30, 3)
    brightness = drawn.astype(int).sum(axis=2)[5::10, 5::10]
    order = [np.argsort(each, axis=None).tolist() for each in (brightness, PICTURE.dustbin)]
    assert order[0] == order[1]
    # inferno begins at (0, 0, 4) of 255 and its 0.65 lies over 100.
    assert drawn[15, 15].tolist() == pytest.approx([35, 35, 37], abs=1)


def test_clusters_have_their_colours_strong_where_much_was_kept():
    drawn = draw_clusters(PICTURE, [0], width=30)[5::10, 5::10].astype(int)
    # Of patches whose top cluster was not chosen the photograph is left.
    assert (drawn[0, 1:] == 100).all()
    orange = [int(CLUSTER_COLOURS[0][i : i + 2], 16) for i in (1, 3, 5)]
    # All of the patch in the middle below was kept: opacity 0.25 + 0.65.
    assert drawn[1, 1].tolist() == pytest.approx([10 + 0.9 * c for c in orange], abs=1)
    distance = np.abs(drawn - orange).sum(axis=2)
    assert distance[1, 1] < distance[0, 0] < distance[1, 0] < distance[1, 2]


def test_patches_lie_where_the_model_saw_them():
    """Of a photograph that is squeezed, the right half is right."""
    image = np.zeros((40, 90, 3), np.uint8)
    image[:, 45:] = 255
    bright = resize_image(image, (28, 28)).reshape(2, 14, 2, 14, 3).mean(axis=(1, 3, 4)) / 255
    picture = Transported(image, np.stack([1 - bright, bright], -1), 1)
    drawn = draw_dustbin(picture, (0.0, 1.0), width=90).astype(int).sum(axis=2)
    assert drawn[:, 50:].min() > drawn[:, :40].max()


def _pixels(figure):
    shown = cv2.imdecode(np.frombuffer(figure._repr_jpeg_(), np.uint8), cv2.IMREAD_COLOR)
    assert shown.shape[1] == round(figure.get_figwidth() * figure.dpi)
    return shown[..., ::-1]


def test_transport_shows_picture_dustbin_and_clusters(params, benchmark, tmp_path):
    image = cj.read_image(benchmark.queries[0])
    figure = cj.show_transport(image, cj.Model(params, MODEL))
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
    same = cj.show_transport(benchmark.queries[0], cj.Model(params, MODEL))
    np.testing.assert_array_equal(_pixels(same), _pixels(figure))


def test_a_model_without_a_transport_is_refused(benchmark):
    alone = cj.CrossImageConfig(layers=0)
    model = dataclasses.replace(MODEL, aggregator="gem", cross_image=alone)
    other = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), parameter_shapes(model))
    with pytest.raises(cj.InputError, match="found gem, expected one that transports"):
        cj.show_transport(benchmark.queries[0], cj.Model(other, model))


def test_the_order_of_the_arguments_is_one_line(params, benchmark):
    picture = PIL.Image.open(benchmark.queries[0])
    with pytest.raises(cj.InputError, match="image: found JpegImageFile, expected uint8 or uint16"):
        cj.show_transport(picture, cj.Model(params, MODEL))
    with pytest.raises(cj.InputError, match="model: found JpegImageFile, expected Model"):
        cj.show_transport(cj.Model(params, MODEL), picture)
