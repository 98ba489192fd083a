"""CosPlace's augmentation against the standard library's colours, hand computations and bounds."""

import colorsys

import numpy as np
import pytest

from crisalad_jax.data.augmentations.colour_crop import ColourCropConfig, _crop

NOTHING = {"brightness": 0.0, "contrast": 0.0, "saturation": 0.0, "hue": 0.0, "crop": 0.0}
IMAGE = np.random.default_rng(0).integers(0, 256, (12, 12, 3), dtype=np.uint8)
LUMA = (0.2989, 0.587, 0.114)


class Scripted:
    """Draws given numbers, and leaves the changes in their order."""

    def __init__(self, *numbers: float) -> None:
        self.numbers = list(numbers)

    def uniform(self, low: float, high: float) -> float:
        return self.numbers.pop(0) if self.numbers else low

    def permutation(self, count: int) -> range:
        return range(count)


def changed(*numbers: float) -> np.ndarray:
    config = ColourCropConfig(**NOTHING)
    # Of a crop of all of a square no share is left out, so that its size is exact.
    return config.apply(IMAGE, Scripted(*numbers), of_place=np.random.default_rng(0))  # pyright: ignore


def as_bytes(pixels: np.ndarray) -> np.ndarray:
    return np.clip(np.round(255 * np.clip(pixels, 0, 1)), 0, 255).astype(np.uint8)


def test_nothing_changes_nothing() -> None:
    config = ColourCropConfig(**NOTHING)
    generator = np.random.default_rng(1)
    # HSV and back is exact to some 1e-6, far below half a byte.
    np.testing.assert_array_equal(config.apply(IMAGE, generator, of_place=generator), IMAGE)


@pytest.mark.parametrize("number", range(4))
def test_each_change_is_torchvisions_formula(number: int) -> None:
    pixels = IMAGE / 255
    grey = (pixels @ LUMA)[..., None]
    strengths = [1.0, 1.0, 1.0, 0.0]
    strengths[number] = (1.6, 0.4, 1.5, 0.3)[number]
    if number == 3:
        turned = [
            colorsys.hsv_to_rgb((h + 0.3) % 1, s, v)
            for h, s, v in (colorsys.rgb_to_hsv(*pixel) for pixel in pixels.reshape(-1, 3))
        ]
        expected = np.reshape(turned, pixels.shape)
    else:
        mean = 0.4 * pixels + 0.6 * grey.mean()
        expected = (1.6 * pixels, mean, 1.5 * pixels - 0.5 * grey)[number]
    found = changed(*strengths)
    # In float32 a value may round to the other side of a half.
    assert np.abs(found.astype(int) - as_bytes(expected)).max() <= 1
    assert (found != as_bytes(expected)).mean() < 0.01
    assert (found != IMAGE).any()


def test_crops_have_the_shares_and_aspects_that_are_drawn() -> None:
    generator = np.random.default_rng(2)
    crops = np.array([_crop(240, 300, 0.5, generator) for _ in range(500)])
    top, left, height, width = crops.T
    assert min(top.min(), left.min()) >= 0
    assert ((top + height <= 240) & (left + width <= 300)).all()
    # Sides are rounded to whole pixels of 120 and more.
    share, aspect = height * width / 72_000, width / height
    assert 0.495 < share.min() < 0.52
    assert 0.9 < share.max() < 1.01
    assert 0.74 < aspect.min() < 0.78
    assert 1.28 < aspect.max() < 1.34


def test_a_crop_fills_the_image_again() -> None:
    """A ramp stays one, steeper or not: its ends move inwards by what is cut off."""
    ramp = np.broadcast_to(np.arange(0, 240, 2, dtype=np.uint8)[None, :, None], (80, 120, 3))
    config = ColourCropConfig(**NOTHING | {"crop": 0.5})
    generator = np.random.default_rng(3)
    found = config.apply(np.ascontiguousarray(ramp), generator, of_place=generator)
    assert found.shape == ramp.shape
    row = found[40, :, 0].astype(int)
    assert (np.diff(row) >= 0).all()
    assert 0 < row[-1] - row[0] < 238
    np.testing.assert_array_equal(found, np.broadcast_to(found[:1], found.shape))


def test_an_image_too_long_for_any_crop_is_cut_in_the_middle() -> None:
    assert _crop(100, 400, 0.0, np.random.default_rng(4)) == (0, 133, 100, 133)
    assert _crop(400, 100, 0.0, np.random.default_rng(4)) == (133, 0, 133, 100)
