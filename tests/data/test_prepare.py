"""Pixels of any depth as 8-bit RGB, by hand."""

import dataclasses
import threading
import warnings

import numpy as np
import pytest
from PIL import Image

from crisalad_jax.data import prepare
from crisalad_jax.data.images import read_image
from crisalad_jax.data.prepare import Preparation, as_rgb
from crisalad_jax.nn.config import PRESETS
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note


@pytest.fixture(autouse=True)
def nothing_noted(monkeypatch):
    monkeypatch.setattr(prepare, "_noted", threading.Lock())


@pytest.mark.parametrize("shape", [(4, 6), (4, 6, 1)])
def test_grey_is_repeated(shape):
    values = np.arange(24, dtype=np.uint8)
    found = as_rgb(values.reshape(shape))
    assert found.shape == (4, 6, 3)
    for channel in range(3):
        np.testing.assert_array_equal(found[..., channel], values.reshape(4, 6))
    prepared = Preparation((2, 3)).prepare(values.reshape(shape))
    np.testing.assert_array_equal(prepared, Preparation((2, 3)).prepare(found))


@pytest.mark.parametrize(
    ("image", "words"),
    [
        ("a.png", "image: found str, expected uint8 or uint16 of shape"),
        (np.zeros((4, 6, 4), np.uint8), r"image: found uint8 of shape \(4, 6, 4\), expected uint8"),
        (np.zeros((0, 6), np.uint8), r"found uint8 of shape \(0, 6\), .* sides of at least 1"),
        (np.zeros((4, 6), bool), r"found bool of shape \(4, 6\), expected"),
        (np.full((4, 6, 3), 0.5), r"\(4, 6, 3\), .*contrast-stretch"),
    ],
)
def test_what_is_no_picture(image, words):
    with pytest.raises(InputError, match=words):
        as_rgb(image)
    with pytest.raises(InputError, match="image: found no finite value"):
        as_rgb(np.full((4, 6), np.nan), "contrast-stretch")


def test_a_dead_pixel_takes_no_range():
    """Of 10,000 values one is dead: 1 % at each end is clipped, so it changes a level at most."""
    values = np.linspace(7200, 8900, 10_000).astype(np.uint16).reshape(100, 100)
    dead = values.copy()
    dead[50, 50] = 65535
    stretched = [as_rgb(each, "contrast-stretch").astype(int) for each in (values, dead)]
    assert (stretched[1][50, 50] == 255).all()
    stretched[1][50, 50] = stretched[0][50, 50]
    assert np.abs(stretched[0] - stretched[1]).max() <= 1
    # By hand: 16 to 1,682 of the 1,700 above 7,200 are spread.
    assert stretched[0][0, 0, 0] == 0
    middle = 255 * (int(values[50, 0]) - 7216) / 1666
    assert abs(stretched[0][50, 0, 0] - middle) <= 1


def test_what_is_not_finite_is_black():
    values = np.array([[1.0, 2.0, np.nan, np.inf, -np.inf]], np.float32)
    found = as_rgb(values, "contrast-stretch")[0, :, 0].tolist()
    assert found == [0, 255, 0, 255, 0]


def test_flat_values_and_eight_bits():
    with np.errstate(all="raise"):
        assert not as_rgb(np.full((4, 6), 8000, np.uint16), "contrast-stretch").any()
    three = as_rgb(np.array([[0, 6, 7]], np.uint16), "contrast-stretch")
    assert three[0, :, 0].tolist() == [0, 219, 255]  # 218.6
    eight = np.array([[100, 110]], np.uint8)
    assert as_rgb(eight, "contrast-stretch")[0, :, 0].tolist() == [100, 110]


def test_narrow_sixteen_bits_are_noted_once(tmp_path):
    values = np.linspace(7200, 8900, 6000).astype(np.uint16).reshape(60, 100)
    paths = [tmp_path / "thermal.png", tmp_path / "another.png"]
    for path in paths:
        Image.fromarray(values).save(path)
    with pytest.warns(Note) as notes:
        found = [read_image(path) for path in paths]
    # The 1st and 99th percentile, and the high bytes between them: 28 to 34.
    assert [str(note.message) for note in notes] == [
        f"{paths[0]}: 16-bit values from 7,216 to 8,882 of 65,535 become 7 of 256 grey levels; "
        "--resize contrast-stretch spreads them over all"
    ]
    for image in found:
        np.testing.assert_array_equal(image[..., 0], values >> 8)


def test_wide_sixteen_bits_and_stretched_ones_are_not_noted():
    wide = np.linspace(0, 65535, 6000).astype(np.uint16).reshape(60, 100)
    with warnings.catch_warnings(action="error"):
        as_rgb(wide)
        as_rgb(wide // 4 + wide // 128)  # 98 % of 16,894 is 16,556, and 64 of 256 levels are 16,384
        as_rgb(wide // 32, "contrast-stretch")
    with pytest.warns(Note, match="become 64 of 256"):
        as_rgb(wide // 4)  # 98 % of 16,383


def test_models_that_prepare_images_alike_share_a_cache():
    how = dataclasses.replace(Preparation.of(PRESETS["b14"]), image_size=(28, 42))
    assert how == Preparation((28, 42), side_multiple=14)
