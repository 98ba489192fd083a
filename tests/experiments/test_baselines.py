"""HOG against a pixel-by-pixel writing of its definition, and on real photographs."""

import math
import pathlib

import numpy as np
import pytest

from crisalad_jax.data import benchmarks, images
from crisalad_jax.experiments import baselines
from crisalad_jax.utils.errors import InputError

PHOTOGRAPHS = pathlib.Path(__file__).parents[3] / "shared" / "data"


def _grey_picture(grey):
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=-1)


def _naive_hog(grey):
    """The definition in loops, for a 128 x 128 picture."""
    padded = np.pad(grey.astype(np.float64), 1, mode="reflect")
    cells = np.zeros((16, 16, 9))
    for y in range(128):
        for x in range(128):
            (a, b, c), (d, _, f), (g, h, i) = padded[y : y + 3, x : x + 3]
            across = c + 2 * f + i - a - 2 * d - g
            down = g + 2 * h + i - a - 2 * b - c
            angle = math.degrees(math.atan2(down, across)) % 180
            # Bins are 20 degrees wide with centres at 10, 30, ... 170; 170 and 10 are neighbours.
            position = (angle - 10) / 20
            low = math.floor(position)
            strength = math.hypot(across, down)
            cells[y // 8, x // 8, low % 9] += strength * (low + 1 - position)
            cells[y // 8, x // 8, (low + 1) % 9] += strength * (position - low)
    parts = []
    for row in range(15):
        for column in range(15):
            block = cells[row : row + 2, column : column + 2].ravel()
            parts.append(block / np.linalg.norm(block))
    descriptor = np.concatenate(parts)
    return descriptor / np.linalg.norm(descriptor)


def test_hog_is_its_definition():
    grey = np.random.default_rng(0).integers(0, 256, (128, 128))
    found = baselines.hog_descriptors(_grey_picture(grey)[None])
    assert found.shape == (1, 8100)
    assert found.dtype == np.float32
    # 1e-5 of entries near 0.01 to 0.03: gradients and angles are float32.
    np.testing.assert_allclose(found[0], _naive_hog(grey), atol=1e-6, rtol=1e-5)


def test_an_edge_falls_into_the_bins_of_its_angle():
    # A vertical edge has angle 0: half in the bin of 170 degrees, half in that of 10.
    grey = np.zeros((128, 128))
    grey[:, 61:] = 200
    blocks = baselines.hog_descriptors(_grey_picture(grey)[None]).reshape(15, 15, 4, 9)
    energy = (blocks.astype(np.float64) ** 2).sum(axis=(0, 1, 2))
    # 1e-6: float32 squares that add up to 1.
    np.testing.assert_allclose(energy, [0.5, 0, 0, 0, 0, 0, 0, 0, 0.5], atol=1e-6)
    # Columns 60 and 61 have gradients; both are in cell column 7, so in blocks of columns 6 and 7.
    np.testing.assert_array_equal(blocks.any(axis=(0, 2, 3)).nonzero()[0], [6, 7])


def test_contrast_and_brightness_do_not_matter():
    grey = np.random.default_rng(1).integers(0, 100, (128, 128))
    found = baselines.hog_descriptors(np.stack([_grey_picture(grey), _grey_picture(2 * grey + 30)]))
    # 1e-6: doubled integers give doubled float32 gradients, up to the rounding of their angles.
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)


def test_every_picture_gets_a_unit_descriptor():
    pictures = np.random.default_rng(2).integers(0, 256, (3, 40, 70, 3)).astype(np.uint8)
    pictures[1] = 90  # one colour
    found = baselines.hog_descriptors(pictures)
    # 1e-5: 8,100 float32 squares.
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    assert np.ptp(found[1]) == 0


def test_no_pictures_are_an_input_error():
    with pytest.raises(InputError, match=r"^images: found none"):
        baselines.hog_descriptors(np.zeros((0, 8, 8, 3), np.uint8))


@pytest.mark.parametrize(
    ("name", "expected"), [("sped_val", (60.5, 76.9, 85.0)), ("corridor", (43.2, 71.2, 82.9))]
)
def test_recall_on_photographs(name, expected):
    if not (PHOTOGRAPHS / name).is_dir():
        pytest.skip(f"no photographs in {PHOTOGRAPHS / name}")
    benchmark = benchmarks.open_benchmark(PHOTOGRAPHS / name)
    database, queries = (
        np.concatenate([baselines.hog_descriptors(images.read_image(p)[None]) for p in paths])
        for paths in (benchmark.database, benchmark.queries)
    )
    order = np.argsort(-(queries @ database.T), axis=1)
    for k, recall in zip((1, 5, 10), expected, strict=True):
        hits = [
            np.isin(row[:k], positives).any()
            for row, positives in zip(order, benchmark.positives, strict=True)
        ]
        # 2 points, two or three queries: another JPEG decoder changes grey levels by one.
        assert 100 * np.mean(hits) == pytest.approx(recall, abs=2)
