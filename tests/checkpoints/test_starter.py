"""The model in the package: its file, its numbers on another machine, what it tells apart."""

import pathlib
import warnings

import jax
import numpy as np
import safetensors

from crisalad_jax.checkpoints import starter
from crisalad_jax.checkpoints.load import load
from crisalad_jax.data.benchmarks import open_benchmark
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.nn.model import Model, describe
from crisalad_jax.retrieval.describe import prepare_image
from crisalad_jax.synthetic import WorldConfig, write_world
from crisalad_jax.utils.output import Note

GOLDEN = pathlib.Path(__file__).parents[2] / "parity" / "goldens" / "starter.npz"
"""Two pictures, and their descriptors where `scripts/starter.py` was run."""
# Another processor adds up in another order; the descriptors are unit vectors.
TOLERANCE = 1e-5


def test_it_is_small_enough_for_a_package() -> None:
    """The limits that were set for it: 3 million parameters, 6 MB."""
    assert starter.FILE.stat().st_size <= 6e6
    assert sum(leaf.size for leaf in jax.tree.leaves(load("starter").params)) <= 3e6
    with safetensors.safe_open(starter.FILE, framework="numpy") as file:
        types = {file.get_slice(name).get_dtype() for name in file.keys()}  # noqa: SIM118
    assert types == {"F16"}


def test_another_machine_gets_the_same_descriptors() -> None:
    golden = np.load(GOLDEN)
    params, config = load("starter")
    images = np.stack([prepare_image(image, config) for image in golden["images"]])
    found = np.asarray(describe(params, images, config))
    np.testing.assert_allclose(found, golden["descriptors"], rtol=0, atol=TOLERANCE)


def test_it_has_the_sources_of_its_parts() -> None:
    """Else each load tells that descriptors may differ: `save_weights` records them anew."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", Note)
        load("starter")


def test_it_tells_places_apart_that_it_never_saw(tmp_path: pathlib.Path) -> None:
    """On scenes of another seed it recalls more than HOG, which needs no training."""
    world = WorldConfig(scenes=1, stations=2, images_per_place=4, test_scenes=16, seed=20261125)
    write_world(tmp_path / "world", world)
    benchmark = open_benchmark(tmp_path / "world" / "test")
    params, config = load("starter")
    (result,) = evaluate(
        Model(params, config), benchmark, groupings=["single"], reading=Reading(quiet=True)
    )
    (hog,) = evaluate(load("hog"), benchmark, reading=Reading(quiet=True))
    assert result.recalls[1] > hog.recalls[1]
