"""Normalisation against its definition in numpy and OpenCV, in float64."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.pixels import LOCAL_WINDOW, check_pixels, normalise
from crisalad_jax.utils.errors import InputError

PIXELS = np.random.default_rng(0).integers(0, 256, (42, 56, 3), dtype=np.uint8)
LOCAL = PreprocessingConfig(normalisation="local-contrast")


def test_bytes_less_a_mean_as_hlocs_netvlad_takes_them() -> None:
    """Mean 123.68, 116.779, 103.939 of 0 to 255, and no deviation."""
    mean = (123.68, 116.779, 103.939)
    how = PreprocessingConfig(
        mean=(mean[0] / 255, mean[1] / 255, mean[2] / 255), deviation=(1 / 255,) * 3
    )
    found = normalise(jnp.asarray(PIXELS), how)
    # Float32 of up to 151 has steps of 1.5e-5.
    np.testing.assert_allclose(found, PIXELS - np.array(mean), atol=5e-5)
    check_pixels(np.asarray(found), how)
    with pytest.raises(InputError, match="which are pixels"):
        check_pixels(np.asarray(found))


def test_local_contrast_in_the_interior() -> None:
    """OpenCV's box filter, away from the border, where the two treat missing pixels differently."""
    image = PIXELS / 255
    window = (LOCAL_WINDOW, LOCAL_WINDOW)
    centred = image - cv2.blur(image, window)
    expected = centred / np.sqrt(cv2.blur(centred**2, window) + 0.02**2)
    ours = normalise(jnp.asarray(PIXELS), LOCAL)
    inside = np.s_[20:-20, 20:-20]  # two windows' reach
    # Float32 sums of 441 numbers against float64.
    np.testing.assert_allclose(ours[inside], expected[inside], atol=1e-5)


def test_local_contrast_ignores_brightness_and_contrast() -> None:
    half = (PIXELS // 4 + 100).astype(np.uint8)
    full = (half - 100) * 4
    a, b = (normalise(jnp.asarray(x.astype(np.uint8)), LOCAL) for x in (half, full))
    # Only the guard of 0.02 against flat areas tells them apart: noise of deviation 0.07 / 4 x 4.
    np.testing.assert_allclose(a, b, atol=0.1)
    flat = jnp.full((42, 42, 3), 200, jnp.uint8)
    # Two sums of 21 terms round a mean of 0.78 by some 6e-8 each, over the guard of 0.02: 3e-6 a
    # rounding. What 1.5e-5 was on one processor, and less than 1e-5 on another, is noise.
    np.testing.assert_allclose(normalise(flat, LOCAL), 0, atol=3e-5)
