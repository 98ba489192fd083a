"""The resize, against Pillow's, torch's and OpenCV's, and what public chains made of one image."""

import pathlib
import subprocess
import sys

import cv2
import numba
import numpy as np
import pytest
import torch
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


GOLDENS = np.load(pathlib.Path(__file__).parent / "goldens" / "resize_chains.npz")
"""One image as torchvision resizes it on Pillow's images and on tensors, every 4th (tensors: every
8th) row and column."""


@pytest.mark.parametrize("image_size", [(84, 98), (154, 126)])
@pytest.mark.parametrize("filter", ["bilinear", "bicubic"])
def test_public_chains(filter, image_size):
    image = GOLDENS["images"][0]
    name = f"{filter}_{image_size[0]}x{image_size[1]}"
    bytes_ = resize_image(image, image_size, filter=filter)
    assert bytes_.dtype == np.uint8
    assert np.abs(bytes_[::4, ::4].astype(int) - GOLDENS[f"pil_{name}"][0]).max() <= 1
    for antialias, chain in ((True, "tensor"), (False, "tensor_noaa")):
        floats = resize_image(
            image, image_size, filter=filter, antialias=antialias, pixels="floats"
        )
        assert floats.dtype == np.float32
        expected = GOLDENS[f"{chain}_{name}"][0].transpose(1, 2, 0)
        # Float32 of up to 1 has steps of 6e-8, and torch computes positions in it too.
        np.testing.assert_allclose(floats[::8, ::8] / 255, expected, atol=2e-6)


@pytest.mark.parametrize("shape", [(48, 64), (61, 40), (1, 1), (3, 90)])
@pytest.mark.parametrize("antialias", [True, False])
@pytest.mark.parametrize("filter", ["bilinear", "bicubic"])
def test_floats_are_torchs(filter, antialias, shape):
    """Neither rounded nor clamped: a bicubic filter overshoots on noise."""
    image = picture(*shape)
    tensor = torch.from_numpy(image).permute(2, 0, 1)[None].float()
    for image_size in ((28, 42), (70, 56)):
        expected = torch.nn.functional.interpolate(
            tensor, image_size, mode=filter, antialias=antialias, align_corners=False
        )
        found = resize_image(image, image_size, filter=filter, antialias=antialias, pixels="floats")
        # torch's positions are float32 of up to 90, with steps of 8e-6, which a slope of 255
        # grey levels a pixel and filters of several taps enlarge.
        np.testing.assert_allclose(found, expected[0].permute(1, 2, 0), atol=5e-3)
        # Floats are resized too, as MegaLoc resizes what a wrapper has resized.
        image, tensor = expected[0].permute(1, 2, 0).numpy(), expected


@pytest.mark.parametrize(
    ("image", "image_sizes"),
    [
        # Where nothing overshoots 0 or 255, the order of the two directions does not show.
        *((picture(*shape) // 2 + 64, [(70, 126), (448, 420)]) for shape in ((480, 640), (1, 1))),
        # Clamped.
        (picture(40, 60) // 128 * 255, [(90, 60), (30, 60), (40, 100), (40, 21)]),
    ],
)
def test_bicubic_on_bytes_is_pillows(image, image_sizes):
    for height, width in image_sizes:
        expected = Image.fromarray(image).resize((width, height), Image.Resampling.BICUBIC)
        found = resize_image(image, (height, width), filter="bicubic")
        assert np.abs(found.astype(int) - expected).max() <= 1


@pytest.mark.parametrize("pixels", ["bytes", "floats"])
@pytest.mark.parametrize("size", [(30, 45), (50, 70)])
def test_area_is_opencvs_and_grows_by_lines(pixels, size):
    image = picture(40, 60)
    given = image if pixels == "bytes" else image.astype(np.float32)
    how = cv2.INTER_AREA if size == (30, 45) else cv2.INTER_LINEAR
    expected = cv2.resize(given, size[::-1], interpolation=how)
    found = resize_image(image, size, filter="area", pixels=pixels)
    np.testing.assert_array_equal(found, expected)


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


@pytest.mark.parametrize("shape", [(48, 64), (300, 401), (1, 1), (3, 90), (31, 28)])
@pytest.mark.parametrize("filter", ["bilinear", "bicubic"])
@pytest.mark.parametrize("pixels", ["bytes", "floats"])
@pytest.mark.parametrize("antialias", [True, False])
def test_numpy_has_the_bits_of_machine_code(monkeypatch, shape, filter, pixels, antialias):
    """So the first images, or a machine without numba, get no descriptors of their own."""
    image = picture(*shape)
    how = {"filter": filter, "pixels": pixels, "antialias": antialias}
    compiled = [resize_image(image, size, **how) for size in ((28, 42), (70, 56))]
    monkeypatch.setattr(resize, "_machine_code", lambda *_: None)
    by_numpy = [resize_image(image, size, **how) for size in ((28, 42), (70, 56))]
    for expected, found in zip(compiled, by_numpy, strict=True):
        np.testing.assert_array_equal(found, expected)


def test_numba_is_loaded_for_many_images_alone():
    program = """
import sys, numpy
from crisalad_jax.data.resize import resize_image
image = numpy.zeros((1024, 1024, 3), numpy.uint8)
for _ in range(3):
    resize_image(image, (28, 28))
    print("numba" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.split() == ["False", "False", "True"], done.stderr


@pytest.mark.parametrize("error", [RuntimeError("no locator"), OSError(28, "No space left")])
def test_where_nothing_can_be_kept_it_compiles_all_the_same(monkeypatch, error):
    njit = numba.njit

    def keeps_nothing(*arguments, cache=False, **options):
        if cache:
            raise error
        return njit(*arguments, **options)

    expected = resize_image(picture(60, 80), (28, 42))
    monkeypatch.setattr(numba, "njit", keeps_nothing)
    monkeypatch.setattr(resize, "_machine_code", resize._machine_code.__wrapped__)
    np.testing.assert_array_equal(resize_image(picture(60, 80), (28, 42)), expected)


@pytest.mark.parametrize(
    ("image", "image_size", "message"),
    [
        (np.zeros((4, 5, 3), np.float32), (2, 2), r"found float32 of shape \(4, 5, 3\) and"),
        (np.zeros((0, 5, 3), np.uint8), (2, 2), r"found uint8 of shape \(0, 5, 3\) and"),
        (np.zeros((4, 5, 3), np.uint8), (0, 2), r"and \(0, 2\), expected uint8 .*, and two whole"),
    ],
)
def test_what_is_no_picture(image, image_size, message):
    with pytest.raises(InputError, match=message):
        resize_image(image, image_size)
