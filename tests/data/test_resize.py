"""The resize, against Pillow's."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from PIL import Image

from crisalad_jax.data.resize import resize_image

SIZES = [(224, 224), (322, 322), (70, 126), (448, 420)]


def picture(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.mark.parametrize("image_size", SIZES)
@pytest.mark.parametrize("shape", [(480, 640), (72, 97), (224, 224), (1, 1), (3, 20_000), (701, 1)])
def test_resize_is_pillows(shape, image_size):
    image = picture(*shape)
    height, width = image_size
    expected = np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BILINEAR))
    resized = resize_image(image, image_size)
    assert resized.dtype == np.uint8
    # Pillow rounds after each direction, we once: at most a level, a quarter of one on average.
    difference = np.abs(resized.astype(int) - expected)
    assert difference.max() <= 1
    assert difference.mean() < 0.25


def test_resize_to_the_same_size_changes_nothing():
    image = picture(60, 80)
    np.testing.assert_array_equal(resize_image(image, (60, 80)), image)


@pytest.mark.parametrize("level", [0, 1, 254, 255])
def test_an_even_picture_stays_so(level):
    """Weights that sum to a little over or under 1 would show at the ends of the scale."""
    for height in range(200, 320):
        resized = resize_image(np.full((height, 2 * height, 3), level, np.uint8), (98, 98))
        assert (resized == level).all()


def test_a_view_and_a_picture_that_may_not_be_written_to():
    mirrored = np.flip(picture(60, 80), axis=1)
    expected = resize_image(np.ascontiguousarray(mirrored), (28, 42))
    np.testing.assert_array_equal(resize_image(mirrored, (28, 42)), expected)
    fixed = np.ascontiguousarray(mirrored)
    fixed.setflags(write=False)
    np.testing.assert_array_equal(resize_image(fixed, (28, 42)), expected)


def test_threads_beside_each_other_change_nothing():
    shapes = ((60, 80), (200, 90), (1, 1), (150, 170), (30, 400)) * 8
    images = [picture(*shape, seed=number) for number, shape in enumerate(shapes)]
    alone = [resize_image(image, (70, 84)) for image in images]
    with ThreadPoolExecutor(4) as together:
        found = list(together.map(lambda image: resize_image(image, (70, 84)), images))
    np.testing.assert_array_equal(found, alone)
