"""The resize, against Pillow's."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
import pytest
from PIL import Image

from crisalad_jax.data import resize
from crisalad_jax.data.resize import resize_image
from crisalad_jax.utils.errors import InputError

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


def test_threads_that_meet_at_the_first_picture_compile_once():
    """And what is compiled lets go of Python's lock."""
    program = """
import threading
from concurrent.futures import ThreadPoolExecutor
import numba, numpy
from crisalad_jax.data.resize import resize_image

barrier, compiled, njit = threading.Barrier(8), [], numba.njit

def counted(*arguments, **options):
    if "nogil" in options:  # numba compiles parts of its own, too
        compiled.append(options["nogil"])
    return njit(*arguments, **options)

numba.njit = counted

def first(_):
    barrier.wait()
    return resize_image(numpy.zeros((30, 40, 3), numpy.uint8), (28, 28))

with ThreadPoolExecutor(8) as threads:
    list(threads.map(first, range(8)))
print(compiled)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "[True]\n", done.stderr


@pytest.mark.parametrize("error", [RuntimeError("no locator"), OSError(28, "No space left")])
def test_where_nothing_can_be_kept_it_compiles_all_the_same(monkeypatch, error):
    njit = numba.njit

    def keeps_nothing(*arguments, cache=False, **options):
        if cache:
            raise error
        return njit(*arguments, **options)

    expected = resize_image(picture(60, 80), (28, 42))
    monkeypatch.setattr(numba, "njit", keeps_nothing)
    monkeypatch.setattr(resize, "_compiled", resize._compiled.__wrapped__)
    np.testing.assert_array_equal(resize_image(picture(60, 80), (28, 42)), expected)


@pytest.mark.parametrize(
    ("image", "image_size", "message"),
    [
        (np.zeros((4, 5, 3), np.float32), (2, 2), r"image: found float32 of shape \(4, 5, 3\)"),
        (np.zeros((4, 5), np.uint8), (2, 2), r"image: found uint8 of shape \(4, 5\), expected"),
        (np.zeros((4, 5, 4), np.uint8), (2, 2), r"image: found uint8 of shape \(4, 5, 4\)"),
        (np.zeros((0, 5, 3), np.uint8), (2, 2), r"image: found uint8 of shape \(0, 5, 3\)"),
        (np.zeros((4, 5, 3), np.uint8), (0, 2), r"image_size: found \(0, 2\), expected sides"),
    ],
)
def test_what_is_no_picture(image, image_size, message):
    with pytest.raises(InputError, match=message):
        resize_image(image, image_size)
