"""What is drawn over a photograph, by its numbers and its pixels."""

import numpy as np
import pytest

from crisalad_jax.data.images import read_image
from crisalad_jax.data.resize import resize_image
from crisalad_jax.experiments.report.transport import (
    CLUSTER_COLOURS,
    Transported,
    draw_clusters,
    draw_dustbin,
    heat_range,
    strongest_clusters,
    write_picture,
)
from crisalad_jax.experiments.report.transport_section import transport_of
from crisalad_jax.utils.errors import InputError
from tests.conftest import MODEL
from tests.experiments.report.pictures import read_picture

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
    paths = list(benchmark.queries[:2])
    for path, picture in zip(paths, transport_of(paths, params, MODEL), strict=True):
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
    for draw in (lambda: draw_dustbin(WITHOUT, (0, 1)), lambda: heat_range([WITHOUT])):
        with pytest.raises(InputError, match=r"^transport: found no dustbin"):
            draw()


def test_clusters_have_their_colours_strong_where_much_was_kept():
    drawn = draw_clusters(PICTURE, [0], width=30)[5::10, 5::10].astype(int)
    # Of patches whose top cluster was not chosen the photograph is left.
    assert (drawn[0, 1:] == 100).all()
    orange = [int(CLUSTER_COLOURS[0][i : i + 2], 16) for i in (1, 3, 5)]
    # All of the patch in the middle below was kept: opacity 0.25 + 0.65.
    assert drawn[1, 1].tolist() == pytest.approx([10 + 0.9 * c for c in orange], abs=1)
    distance = np.abs(drawn - orange).sum(axis=2)
    assert distance[1, 1] < distance[0, 0] < distance[1, 0] < distance[1, 2]


def test_a_picture_is_written_as_it_is(tmp_path):
    drawn = draw_clusters(PICTURE, [1, 0])
    write_picture(tmp_path / "x.png", drawn)
    np.testing.assert_array_equal(read_picture(tmp_path / "x.png"), drawn)


def test_patches_lie_where_the_model_saw_them():
    """Of a photograph that is squeezed, the right half is right."""
    image = np.zeros((40, 90, 3), np.uint8)
    image[:, 45:] = 255
    bright = resize_image(image, (28, 28)).reshape(2, 14, 2, 14, 3).mean(axis=(1, 3, 4)) / 255
    picture = Transported(image, np.stack([1 - bright, bright], -1), 1)
    drawn = draw_dustbin(picture, (0.0, 1.0), width=90).astype(int).sum(axis=2)
    assert drawn[:, 50:].min() > drawn[:, :40].max()
