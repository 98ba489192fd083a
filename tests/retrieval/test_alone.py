"""Images that are described alone: files, and pictures in memory."""

import pathlib

import cv2
import numpy as np
import pytest

from crisalad_jax.data.images import read_image
from crisalad_jax.data.reading import Reading
from crisalad_jax.nn.model import Crisalad, Model, describe
from crisalad_jax.retrieval.describe import describe_files, describe_images, prepare_image
from crisalad_jax.retrieval.extract import extract
from crisalad_jax.utils.errors import InputError
from tests.conftest import MODEL, random_params

# Batches of another size round otherwise: unit vectors in float32.
ROUNDING = 5e-6


@pytest.fixture(scope="module")
def params() -> Crisalad:
    return random_params(MODEL)


@pytest.fixture
def pixels() -> list[np.ndarray]:
    generator = np.random.default_rng(1)
    shapes = [(60, 80), (42, 56), (80, 60), (30, 40), (60, 80)]
    return [generator.integers(0, 256, (*shape, 3), dtype=np.uint8) for shape in shapes]


def test_each_picture_is_described_as_if_it_were_alone(
    params: Crisalad, pixels: list[np.ndarray]
) -> None:
    found = describe_images(Model(params, MODEL), pixels, batch_size=4)
    # Batches of 4 and of 1: no picture looks at another, nor at padding.
    for row, picture in zip(found, pixels, strict=True):
        alone = describe(params, prepare_image(picture, MODEL)[None], MODEL)
        np.testing.assert_allclose(row, alone[0], atol=ROUNDING)


def test_files_are_described_as_extract_describes_them(
    params: Crisalad, pixels: list[np.ndarray], tmp_path: pathlib.Path
) -> None:
    files = [tmp_path / f"{number}.png" for number in range(len(pixels))]
    for file, picture in zip(files, pixels, strict=True):
        cv2.imwrite(str(file), picture[..., ::-1])
    found = describe_files(Model(params, MODEL), files)
    np.testing.assert_array_equal(
        found, extract(Model(params, MODEL), tmp_path, reading=Reading(quiet=True)).descriptors
    )
    np.testing.assert_allclose(describe_images(Model(params, MODEL), pixels), found, atol=ROUNDING)
    np.testing.assert_array_equal(
        read_image(files[0], MODEL.image_size), prepare_image(pixels[0], MODEL)
    )


def test_nothing_and_other_types_are_refused(params: Crisalad) -> None:
    with pytest.raises(InputError, match="images: found none, expected at least one image"):
        describe_images(Model(params, MODEL), [])
    with pytest.raises(InputError, match="files: found none, expected at least one image"):
        describe_files(Model(params, MODEL), [])
    with pytest.raises(InputError, match="files: found None, expected images"):
        describe_files(Model(params, MODEL), None)
    with pytest.raises(InputError, match="image: found float64 of shape"):
        describe_images(Model(params, MODEL), [np.zeros((9, 9, 3))])
    with pytest.raises(InputError, match=r"no-file\.png"):
        describe_files(Model(params, MODEL), "no-file.png")
