"""Published recipes from the first image to the last weights, on synthetic places."""

import dataclasses
import pathlib

import jax
import numpy as np
import pytest

from crisalad_jax.checkpoints.weights import load_weights, save_weights
from crisalad_jax.data.places import read_places
from crisalad_jax.experiments.train import train
from crisalad_jax.nn.model import Model, init_crisalad, parameter_shapes
from crisalad_jax.training.recipes import recipe
from crisalad_jax.training.schedules import RunSteps
from crisalad_jax.training.start import with_vocabulary_of
from crisalad_jax.utils.pytree import named_leaves
from tests.conftest import random_params

BLOCKS = {"image": 2, "vlad-buff": 4}
"""Number of blocks that train, of tiny's four."""


@pytest.mark.parametrize("name", ["image", pytest.param("vlad-buff", marks=pytest.mark.slow)])
def test_a_recipe_trains_its_own_parts_from_its_own_start(
    name: str, shared: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    """By the command's own function, without a flag for the start; two steps of tiny."""
    published = recipe("tiny", name)
    config = dataclasses.replace(
        published,
        model=dataclasses.replace(published.model, image_size=(42, 56)),
        # A rate of the warm-up would be too low to see in a step.
        optimiser=dataclasses.replace(published.optimiser, warmup_steps=0),
        places_per_batch=4,
        images_per_place=2,
        min_images=2,
        epochs=1,
        seed=3,
    )
    given = random_params(config.model)
    save_weights(tmp_path / "given.safetensors", Model(given, config.model))
    what = "backbone" if config.model.aggregator.starts_from_centroids else "weights"
    options = {what: tmp_path / "given.safetensors", "quiet": True}
    result = train(config, shared / "city", tmp_path / "run", **options)
    assert result.steps == 2
    trained, model = load_weights(tmp_path / "run" / "last.safetensors")
    assert model == config.model
    places = read_places(shared / "city", min_images=2)
    start = with_vocabulary_of(given, config, places, quiet=True)  # if there is one
    before, after = named_leaves(start), named_leaves(trained)
    moved = {key for key, leaf in after.items() if not np.array_equal(leaf, before[key])}
    head = {key for key in after if key.startswith("aggregator.")}
    assert head
    assert {key for key in moved if not key.startswith("backbone.")} == head
    depth, last = config.model.backbone.depth, BLOCKS[name]
    for key in moved - head:
        if key.startswith("backbone.blocks."):
            same = np.asarray(after[key] == before[key]).reshape(depth, -1).all(axis=1)
            assert list(same) == [True] * (depth - last) + [False] * last, key
    rest = {key for key in moved - head if not key.startswith("backbone.blocks.")}
    norm = {"backbone.norm.weight", "backbone.norm.bias"}
    assert rest == (norm if name == "vlad-buff" else set())
    # Two steps of Adam at some 5e-5 move a number by 1e-4 at most: the start was this.
    for key in head:
        np.testing.assert_allclose(after[key], before[key], rtol=0, atol=2e-4)


def test_selavprpp_has_the_sizes_and_the_start_of_its_code() -> None:
    """Of the facts of Lu-Feng/SelaVPRplusplus; nothing but adapters and head trains."""
    for preset, dim, adapters in (("b14", 2048, 12), ("l14", 4096, 16)):
        config = recipe(preset, "selavprpp")
        assert config.model.descriptor_dim == dim
        shapes = named_leaves(parameter_shapes(config.model))
        down = next(leaf for name, leaf in shapes.items() if name.endswith("adapter.down.weight"))
        assert down.shape == (adapters, config.model.backbone.dim, config.model.backbone.dim // 2)
        batch = config.places_per_batch, config.images_per_place, config.epochs, config.patience
        assert batch == (120, 4, 25, 12)
    # Halved after three epochs of ten steps.
    rates = [config.optimiser.schedule.apply(step, 4e-4, RunSteps(250, 10, 0)) for step in (29, 30)]
    assert [float(rate) for rate in rates] == pytest.approx([4e-4, 2e-4], rel=1e-6)
    tiny = recipe("tiny", "selavprpp")
    start = named_leaves(init_crisalad(jax.random.key(0), tiny.model))
    adapter = {name: leaf for name, leaf in start.items() if ".adapter." in name}
    for name, leaf in adapter.items():
        if ".up." in name:
            assert not leaf.any(), name
        elif ".conv." in name:
            np.testing.assert_array_equal(leaf, np.float32(1e-5), err_msg=name)
    assert tiny.trainable == "adapters,head"
