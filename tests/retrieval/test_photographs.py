"""Photographs as each model takes them: chains of floats, and sizes that differ."""

import dataclasses
import pathlib

import cv2
import numpy as np
import pytest
import torch

from crisalad_jax.checkpoints.export import ExportConfig, export_model
from crisalad_jax.checkpoints.weights import load_weights, save_weights
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.data.images import read_image
from crisalad_jax.data.loader import ImageCache
from crisalad_jax.data.reading import Reading
from crisalad_jax.nn.aggregators.vlad import NetVladConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.model import Model, describe
from crisalad_jax.retrieval.describe import prepare_image
from crisalad_jax.retrieval.describer import describer_of
from crisalad_jax.retrieval.extract import extract
from crisalad_jax.retrieval.maps.build import index
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.query import query
from crisalad_jax.retrieval.reranking.stage import Reranking
from crisalad_jax.utils.errors import InputError
from tests.conftest import MODEL, random_params

MEAN, DEVIATION = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
SHAPES = [(42, 56), (42, 56), (56, 42), (56, 42), (56, 42), (40, 60), (42, 56)]
"""The last but one is rounded to the size of the last: 42 x 56."""
ALONE = dataclasses.replace(
    MODEL,
    backbone=ViTConfig(dim=32, depth=1, heads=2, position_grid=3),
    aggregator="gem",
    cross_image="none",
)
NATIVE = ALONE.resized(None, ["native"])


@pytest.fixture
def folder(tmp_path: pathlib.Path) -> pathlib.Path:
    generator = np.random.default_rng(0)
    (tmp_path / "images").mkdir()
    for number, shape in enumerate(SHAPES):
        image = generator.integers(0, 256, (*shape, 3), dtype=np.uint8)
        assert cv2.imwrite(str(tmp_path / "images" / f"{number}.png"), image)
    return tmp_path / "images"


def batches_of(config, paths, **options):
    """Batches of files as a model of this configuration takes them."""
    describer = describer_of(Model(random_params(config), config))
    return Reading(**options).batches(paths, describer.preparation)


def paths_in(folder: pathlib.Path) -> list[pathlib.Path]:
    return sorted(folder.glob("*.png"))


def torch_chain(path: pathlib.Path, *sizes: tuple[int, int], mode: str) -> np.ndarray:
    """As public wrappers do: normalise, then resize, once or twice."""
    pixels = torch.from_numpy(read_image(path)).float() / 255
    tensor = ((pixels - MEAN) / DEVIATION).permute(2, 0, 1)[None]
    for size in sizes:
        tensor = torch.nn.functional.interpolate(
            tensor, size, mode=mode, antialias=True, align_corners=False
        )
    return tensor[0].permute(1, 2, 0).numpy()


def test_floats_are_those_of_a_wrapper_that_normalises_first(folder: pathlib.Path) -> None:
    config = ALONE.resized((28, 42), ["bicubic", "floats"])
    cache = ImageCache()
    for _ in range(2):
        first, second = batches_of(config, paths_in(folder), batch_size=4, cache=cache)
        assert first.images.dtype == np.float32
        assert second.valid.tolist() == [True, True, True, False]
        found = np.concatenate([first.images, second.images[:3]])
        expected = [torch_chain(path, (28, 42), mode="bicubic") for path in paths_in(folder)]
        # Float32 of up to 3 over filters of 12 taps; a bilinear filter differs by 1.
        np.testing.assert_allclose(found, expected, atol=2e-5)


def test_a_size_between_patches_is_resized_again_as_megaloc_does(folder: pathlib.Path) -> None:
    config = ALONE.resized((50, 44), ["floats", "round"])
    assert config.input_size == (56, 42)
    path = paths_in(folder)[0]
    expected = torch_chain(path, (50, 44), (56, 42), mode="bilinear")
    found = prepare_image(read_image(path), config)
    np.testing.assert_allclose(found, expected, atol=2e-5)  # as above


def test_a_change_of_size_ends_a_batch(folder: pathlib.Path) -> None:
    paths = paths_in(folder)
    (folder / "3.png").write_bytes(b"no image")
    batches = list(batches_of(NATIVE, paths, batch_size=2, on_bad_image="skip"))
    assert [batch.indices.tolist() for batch in batches] == [[0, 1], [2, 3], [4, -1], [5, 6]]
    sizes = [(42, 56), (56, 42), (56, 42), (42, 56)]
    assert [batch.images.shape for batch in batches] == [(2, *size, 3) for size in sizes]
    assert [batch.valid.tolist() for batch in batches] == [
        *([True, True], [True, False], [True, False], [True, True])
    ]
    for batch in batches:
        for image, number in zip(batch.images, batch.indices, strict=True):
            if number in (0, 1, 2, 4, 6):
                np.testing.assert_array_equal(image, read_image(paths[number]))
    with pytest.raises(InputError, match=f"^{paths[3]}: found 8 bytes"):
        list(batches_of(NATIVE, paths, batch_size=2))


def test_an_image_that_the_model_cannot_describe_is_named(folder: pathlib.Path) -> None:
    assert cv2.imwrite(str(folder / "8.png"), np.zeros((14, 14, 3), np.uint8))
    assert cv2.imwrite(str(folder / "9.png"), np.zeros((1, 4200, 3), np.uint8))
    salad = MODEL.resized(None, ["native"])
    with pytest.raises(InputError, match=rf"^{folder / '8.png'}: .* 1 patches for 4 clusters"):
        list(batches_of(salad, [folder / "8.png"], batch_size=1))
    with pytest.raises(InputError, match=rf"^{folder / '9.png'}: image size: .* at most 4096"):
        list(batches_of(NATIVE, [folder / "9.png"], batch_size=1))


def test_descriptors_of_all_sizes_in_order(folder: pathlib.Path, tmp_path: pathlib.Path) -> None:
    """Of a file that stores the rule: extracted, resumably too, and in a map."""
    params, weights = random_params(NATIVE), tmp_path / "w.safetensors"
    save_weights(weights, Model(params, NATIVE))
    params, config = load_weights(weights)
    assert config == NATIVE
    images = [prepare_image(read_image(path), config) for path in paths_in(folder)]
    expected = np.concatenate(
        [describe(params, np.stack([image] * 2), config)[:1] for image in images]
    )
    # Float32 rounding: other images stand beside each.
    close = {"atol": 2e-6}
    out, model, two = tmp_path / "out.npy", Model(params, config), Reading(batch_size=2, quiet=True)
    found = extract(model, folder, out, reading=two)
    np.testing.assert_allclose(found.descriptors, expected, **close)
    np.testing.assert_allclose(np.load(out), expected, **close)

    place = tmp_path / "map"
    index(model, folder, place, weights=weights, reading=two)
    again = index(model, folder, place, weights=weights, reading=two)
    assert (again.added, again.there) == (0, len(SHAPES))
    fixed = Model(params, config.resized(None, ["fixed"]))
    with pytest.raises(InputError, match=r"found images at 42 x 56, .* expected native size, "):
        index(fixed, folder, place, weights=weights, reading=two)
    with Map.open(place) as places:
        assert places.summary()["resize"] == config.images_in_words
        np.testing.assert_allclose(np.concatenate(list(places.descriptors)), expected, **close)
        answers = query(places, paths_in(folder)[2:4], k=1, reading=two)
    assert answers.neighbours.indices.ravel().tolist() == [2, 3]


def test_local_features_need_a_fixed_size() -> None:
    config = dataclasses.replace(
        ALONE, image_size=(56, 56), aggregator=NetVladConfig(clusters=4)
    ).resized(None, ["native"])
    words = "rerank: found a model with aggregator netvlad and size rule native, expected"
    with pytest.raises(InputError, match=words):
        Reranking("patch-netvlad", 2).check(config)


def test_a_program_of_floats_takes_floats() -> None:
    config = dataclasses.replace(
        ALONE,
        image_size=(40, 60),
        preprocessing=PreprocessingConfig(pixels="floats", round_to_patch=True),
    )
    params = random_params(config)
    exported = export_model(params, config, ExportConfig(batch_size=1, platforms=("cpu",)))
    images = exported.in_avals[-1]
    assert (images.shape, images.dtype) == ((1, 42, 56, 3), np.float32)
