"""A model and data sets so small that a training run takes a second, shared by the tests.

All tests use the same shapes, so that each program is compiled once for the whole session.
"""

import csv
import dataclasses
import importlib
import os
import pathlib
import signal
import sys
import unittest.mock
from collections.abc import Callable, Iterator, Sequence
from types import ModuleType
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

from crisalad_jax.checkpoints import runtime
from crisalad_jax.checkpoints.formats import families
from crisalad_jax.checkpoints.published import PUBLISHED
from crisalad_jax.checkpoints.weights import save_weights
from crisalad_jax.config import plugins
from crisalad_jax.config.io import to_plain
from crisalad_jax.config.registry import REGISTRIES
from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.places import COLUMNS, read_places
from crisalad_jax.data.reading import Reading
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.nn.model import Crisalad, Model, parameter_shapes
from crisalad_jax.retrieval.describe import TokenSet
from crisalad_jax.retrieval.describer import describer_of
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.loop import fit
from crisalad_jax.training.losses import LossConfig
from crisalad_jax.training.losses.pairwise import MultiSimilarityConfig
from crisalad_jax.utils import compiler
from crisalad_jax.utils.files import write_json
from crisalad_jax.utils.pytree import named_leaves
from scripts.compile_check.absent import assuming_cudnn

# A shell that runs the tests in the background has SIGINT ignored, and so would the commands that
# they interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

PHOTOGRAPHS = pathlib.Path(__file__).parents[2] / "shared" / "data"
"""Real photographs beside the checkout, where there are any."""
MODEL = ModelConfig(
    image_size=(42, 56),
    backbone=ViTConfig(dim=32, depth=2, heads=2, position_grid=3),
    aggregator=SaladConfig(clusters=4, cluster_dim=8, token_dim=16, hidden=16),
    cross_image=CrossImageConfig(heads=2, feedforward=16),
)
# Eight places make two batches of three an epoch: six steps in all. The dropouts of MODEL and the
# light augmentation draw random numbers in every step.
RECIPE = TrainConfig(
    model=MODEL,
    loss=LossConfig(kind=MultiSimilarityConfig(base=0.5)),
    optimiser=OptimiserConfig(learning_rate=1e-3),
    trainable="all",
    augmentation="light",
    places_per_batch=3,
    images_per_place=2,
    min_images=2,
    epochs=3,
    patience=2,
    seed=5,
)
_HAS_ACCELERATOR = runtime._has_accelerator
STEPS = 6
CITIES, PLACES_PER_CITY, IMAGES_PER_PLACE = ("Aston", "Brill"), 4, 3
BATCH = 4
"""Of evaluation: the town's seven database images and five queries leave a last batch unfilled."""


def write_picture(path: pathlib.Path, seed: int, noise: float = 0.0) -> None:
    """A smooth random picture; the same seed with noise is another view of the same place."""
    generator = np.random.default_rng(seed)
    coarse = generator.uniform(0, 255, (4, 5, 3)).astype(np.float32)
    picture = cv2.resize(coarse, (70, 50), interpolation=cv2.INTER_CUBIC)
    picture += generator.normal(0, noise, picture.shape)
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.clip(picture, 0, 255).astype(np.uint8))


def write_video(
    path: pathlib.Path,
    frames: int,
    *,
    step: int = 10,
    first: int = 0,
    colour: tuple[int, int, int] = (1, 1, 1),
    rate: int = 10,
) -> pathlib.Path:
    """A video of `rate` flat frames a second; frame i has the level `step` * (first + i)."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate, (64, 48))
    assert writer.isOpened()
    for number in range(first, first + frames):
        writer.write(np.full((48, 64, 3), np.multiply(colour, step * number), np.uint8))
    writer.release()
    return path


def write_city(root: pathlib.Path) -> pathlib.Path:
    """A training set in the layout of GSV-Cities."""
    for city_number, city in enumerate(CITIES):
        rows = []
        for place in range(PLACES_PER_CITY):
            for view in range(IMAGES_PER_PLACE):
                rows.append([place, 2020, 5, view, city, "1.5", "2.5", "pano"])
                name = f"{city}_{place:07d}_2020_05_{view:03d}_1.5_2.5_pano.jpg"
                seed = 100 * city_number + place
                write_picture(root / "Images" / city / name, seed, noise=10.0 * (1 + view))
        (root / "Dataframes").mkdir(exist_ok=True)
        with (root / "Dataframes" / f"{city}.csv").open("w", newline="") as file:
            csv.writer(file).writerows([COLUMNS, *rows])
    return root


def write_town(root: pathlib.Path) -> pathlib.Path:
    """An evaluation set with @UTM names; the last query is far from everything."""
    for part, eastings in (
        ("database", [0, 40, 80, 120, 160, 200, 210]),
        ("queries", [3, 45, 130, 205, 9000]),
    ):
        for east in eastings:
            name = f"@{east:07.2f}@5000000.00@10@S@@@{part}@@@@@@@@.jpg"
            seed = 500 + round(east / 40)
            write_picture(root / "images" / "test" / part / name, seed, noise=20.0)
    return root


def assert_equal(found: Any, expected: Any) -> None:
    """The same tree of arrays, of the same types, to the last bit."""
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for (name, a), b in zip(named_leaves(found).items(), jax.tree.leaves(expected), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b, err_msg=name)


@pytest.fixture(scope="session")
def scripts() -> Iterator[Callable[[str], ModuleType]]:
    """Imports a script by its name. What it sets in the environment ends with that."""
    root = pathlib.Path(__file__).parents[1] / "scripts"
    folders = [str(root), str(root / "bench")]

    def load(name: str) -> ModuleType:
        with unittest.mock.patch.dict(os.environ):
            return importlib.import_module(name)

    sys.path[:0] = folders
    yield load
    for folder in folders:
        sys.path.remove(folder)


@pytest.fixture(scope="session", autouse=True)
def absent_gpu() -> Iterator[None]:
    """Let programs for a GPU be traced where there is none."""
    with assuming_cudnn():
        yield


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    """No test fills the user's compile cache, nor changes for others how this process computes."""
    monkeypatch.setattr(compiler, "configure", lambda devices=None: None)
    monkeypatch.delenv("CRISALAD_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.fixture
def _unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """As users run it: the types and shapes in annotations are checked in tests alone."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture(scope="module")
def symbolic_shapes() -> Iterator[None]:
    """For a module: the check of annotations cannot broadcast symbolic dimensions."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jaxtyping.config, "jaxtyping_disable", True)
        yield


@pytest.fixture
def city(tmp_path: pathlib.Path) -> pathlib.Path:
    """A training set that a test may spoil."""
    return write_city(tmp_path / "city")


@pytest.fixture
def town(tmp_path: pathlib.Path) -> pathlib.Path:
    """An evaluation set that a test may spoil."""
    return write_town(tmp_path / "town")


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """Files to read only: city/, town/, weights.safetensors, recipe.json."""
    root = tmp_path_factory.mktemp("shared")
    write_city(root / "city")
    write_town(root / "town")
    write_json(root / "recipe.json", to_plain(RECIPE))
    save_weights(root / "weights.safetensors", Model(random_params(MODEL), MODEL))
    return root


def random_params(config: ModelConfig) -> Crisalad:
    """Parameters whose every number matters: an untrained model has zeros and ones."""
    generator = np.random.default_rng(3)
    template = parameter_shapes(config)
    leaves = []
    for name, leaf in named_leaves(template).items():
        noise = generator.standard_normal(leaf.shape)
        if name.endswith("bias"):
            value = 0.1 * noise
        elif leaf.ndim < 2 or ".norm" in name or ".ls" in name:  # scales
            value = 1 + 0.1 * noise
        else:
            value = noise / np.sqrt(leaf.shape[-2])
        leaves.append(jnp.asarray(value, leaf.dtype))
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


LONGEST = ("test_step.py", "test_processes.py", "test_interruption.py")
"""Files that take minutes; run last, one of them would leave the other worker without work."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.path.name not in LONGEST)


@pytest.fixture(scope="session")
def params() -> Crisalad:
    """The parameters in weights.safetensors."""
    return random_params(MODEL)


@pytest.fixture(scope="session")
def benchmark(shared: pathlib.Path) -> Benchmark:
    """The town, opened."""
    return open_benchmark(shared / "town")


@pytest.fixture(scope="session")
def run(shared: pathlib.Path, params: Crisalad, benchmark: Benchmark) -> pathlib.Path:
    """A finished run of RECIPE from `params`, never stopped early, to read only."""
    places = read_places(shared / "city", min_images=2)
    recipe = dataclasses.replace(RECIPE, patience=None)
    out = shared / "run"
    fit(recipe, places, out, validation=benchmark, initial=params, quiet=True)
    return out


@pytest.fixture
def own_parts(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a test registers ends with it."""
    for registry in REGISTRIES.values():
        for name in ("_parts", "_presets"):
            monkeypatch.setattr(registry, name, dict(getattr(registry, name)))
    monkeypatch.setattr(plugins, "_LOADED", {})
    before = set(sys.modules)
    named = (families.FORMATS, families.HEADS, families.TABLES, PUBLISHED)
    copies = [dict(each) for each in named]
    yield
    for each, copy in zip(named, copies, strict=True):
        each.clear()
        each.update(copy)
    for name in set(sys.modules) - before:
        if name.startswith("crisalad_plugin_"):
            del sys.modules[name]


def read_options(options: dict[str, Any]) -> dict[str, Any]:
    """Put the options that a `Reading` has into one; quiet, with batches of `BATCH`."""
    fields = {field.name for field in dataclasses.fields(Reading)}
    chosen = {name: options[name] for name in fields & options.keys()}
    others = {name: value for name, value in options.items() if name not in fields}
    return others | {"reading": Reading(**{"batch_size": BATCH, "quiet": True} | chosen)}


def describe_single(model: Model, paths: Sequence[pathlib.Path]) -> np.ndarray:
    """Describe images independently, by tokens and their grouping, in batches of `BATCH`."""
    describer = describer_of(model)
    tokens = TokenSet(describer, paths, Reading(batch_size=BATCH, quiet=True))
    return tokens.describe(tokens.batches("single", None))


@pytest.fixture(autouse=True)
def jax_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    """Describe queries by JAX, as where it has an accelerator: an export takes seconds."""
    monkeypatch.setattr(runtime, "_has_accelerator", lambda: True)


@pytest.fixture
def engines_by_default(monkeypatch: pytest.MonkeyPatch, jax_by_default: None) -> None:
    """Undo `jax_by_default`."""
    monkeypatch.setattr(runtime, "_has_accelerator", _HAS_ACCELERATOR)
