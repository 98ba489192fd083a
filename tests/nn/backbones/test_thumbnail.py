"""SeqSLAM's small images against their definition in loops."""

import numpy as np
import pytest

import crisalad_jax as cj
from crisalad_jax.utils.errors import InputError


def test_thumbnails_are_the_loops() -> None:
    params, config = cj.load("thumbnail")
    assert params.backbone is None
    assert (config.image_size, config.descriptor_dim) == ((32, 64), 2048)
    images = np.random.default_rng(0).integers(0, 256, (2, 32, 64, 3), dtype=np.uint8)
    images[1] = 77
    found = np.asarray(cj.describe(params, images, config))

    grey = images[0] @ np.array([0.299, 0.587, 0.114])
    for row in range(0, 32, 8):
        for column in range(0, 64, 8):
            patch = grey[row : row + 8, column : column + 8]
            grey[row : row + 8, column : column + 8] = (patch - patch.mean()) / patch.std()
    # Float32 of numbers up to 255, less their mean.
    np.testing.assert_allclose(found[0], grey.ravel() / np.linalg.norm(grey), atol=1e-6)
    np.testing.assert_allclose(found[1], 2048**-0.5, atol=1e-6)


def test_another_size_is_refused() -> None:
    config = cj.load("thumbnail").config
    with pytest.raises(InputError, match="found 64 x 64, expected 32 x 64 for backbone thumbnail"):
        config.resized((64, 64))
