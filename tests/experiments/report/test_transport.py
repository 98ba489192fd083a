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
    draw_transport,
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
    for picture in (PICTURE, PICTURE._replace(masses=2 * MASSES)):  # whatever a patch sends
        np.testing.assert_allclose(picture.dustbin, [[0.3, 0.7, 0.9], [0.5, 0.0, 0.8]])
    assert PICTURE.top.tolist() == [[0, 1, 1], [0, 0, 0]]
    assert WITHOUT.dustbin is None
    # Cluster 0 is first in four patches, of which it took 0.6, 0.3, 0.5 and 0.2; 2.8 was kept.
    strongest = strongest_clusters([PICTURE])
    assert list(strongest) == [0, 1]
    assert list(strongest.values()) == pytest.approx([1.6 / 2.8, 0.3 / 2.8])


def test_shares_are_those_of_the_model(benchmark, params):
    for path in benchmark.queries[:2]:
        picture = transport_of(read_image(path), cj.Model(params, MODEL))
        assert picture.masses.shape == (3, 4, MODEL.aggregator.clusters + 1)
        # Rows are updated last: each patch has sent all it has, to rounding of float32.
        np.testing.assert_allclose(picture.masses.sum(axis=-1), 1, rtol=1e-5)
        np.testing.assert_array_equal(picture.image, read_image(path))
        # Twelve patches for four clusters, within what three iterations leave.
        assert picture.dustbin.mean() == pytest.approx(8 / 12, abs=0.02)


def test_a_row_shows_the_dustbins_shares_and_the_top_clusters():
    """Dark and bright by the scale of all pictures; clusters strong where much was kept."""
    figure = draw_transport({"query": PICTURE}, [PICTURE, PICTURE], photographs=False)
    dustbin, clusters, _ = figure.axes
    assert dustbin.get_ylabel() == "query"
    assert dustbin.get_title(loc="left") == f"dustbin: {100 * 3.2 / 6:.0f} %"
    grey, heat = dustbin.images
    assert (grey.get_array() == 100).all()
    np.testing.assert_allclose(heat.get_array(), PICTURE.dustbin)
    assert heat.get_clim() == (0.0, pytest.approx(0.9))
    assert grey.get_extent() == list(heat.get_extent())
    # All of the patch in the middle below was kept: opacity 0.25 + 0.65.
    shown = clusters.images[1].get_array()
    strength = np.array([[0.7, 0.3, 0.1], [0.5, 1.0, 0.2]])
    np.testing.assert_allclose(shown[..., 3], 0.25 + 0.65 * strength)
    expected = np.array([rgb(CLUSTER_COLOURS[each]) for each in PICTURE.top.ravel()])
    np.testing.assert_allclose(shown[..., :3].reshape(-1, 3), expected)


def test_patches_of_other_clusters_are_clear_and_no_dustbin_has_no_panel():
    strong = Transported(GREY, np.eye(9)[np.array([[0, 0], [1, 1], [2, 3]])] * 1.0, 9)
    many = [Transported(GREY, np.eye(9)[np.array([[n, n]])], 9) for n in range(4, 9)]
    figure = draw_transport({"query": strong}, [strong, strong, *many, many[0]], photographs=False)
    (clusters,) = figure.axes
    shown = clusters.images[1].get_array()
    assert (shown[:2, :, 3] > 0.8).all()
    assert len(figure.legends[0].get_texts()) == 7 == len(strongest_clusters([strong, *many]))
    assert len(draw_transport({"": WITHOUT}, [WITHOUT], photographs=True).axes) == 2


def test_patches_lie_where_the_model_saw_them():
    """Of a photograph that is squeezed, the right half is right."""
    image = np.zeros((40, 90, 3), np.uint8)
    image[:, 45:] = 255
    bright = resize_image(image, (28, 28)).reshape(2, 14, 2, 14, 3).mean(axis=(1, 3, 4)) / 255
    picture = Transported(image, np.stack([1 - bright, bright], -1), 1)
    figure = draw_transport({"": picture}, [picture], photographs=True)
    pixels = _pixels(figure).astype(int).sum(axis=2)
    box = figure.axes[1].get_window_extent()
    row = pixels[round(len(pixels) - (box.y0 + box.y1) / 2)]
    left, right = (round(box.x0 + part * box.width) for part in (0.4, 0.6))
    assert row[right : round(box.x1) - 2].min() > row[round(box.x0) + 2 : left].max()


def rgb(colour):
    return [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]


def _pixels(figure):
    shown = cv2.imdecode(np.frombuffer(figure._repr_jpeg_(), np.uint8), cv2.IMREAD_COLOR)
    assert shown.shape[1] == round(figure.get_figwidth() * figure.dpi)
    return shown[..., ::-1]


def test_transport_shows_picture_dustbin_and_clusters(params, benchmark, tmp_path):
    image = cj.read_image(benchmark.queries[0])
    figure = cj.show_transport(image, cj.Model(params, MODEL))
    first, dustbin, *_ = figure.axes
    assert first.get_title(loc="left") == "70 x 50 pixels, 3 x 4 patches"
    np.testing.assert_array_equal(first.images[0].get_array(), image)
    # Two thirds, within what three iterations leave.
    assert dustbin.get_title(loc="left") in ("dustbin: 66 %", "dustbin: 67 %")
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert len(legend) == len({label.split(":")[0] for label in legend}) <= 4
    colours = [patch.get_facecolor()[:3] for patch in figure.legends[0].get_patches()]
    np.testing.assert_allclose(colours, list(map(rgb, CLUSTER_COLOURS[: len(colours)])))
    pixels = _pixels(figure)
    assert pixels.std() > 10  # not blank
    same = cj.show_transport(benchmark.queries[0], cj.Model(params, MODEL))
    np.testing.assert_array_equal(_pixels(same), pixels)


def test_a_model_without_a_transport_is_refused(benchmark):
    alone = "none"
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
