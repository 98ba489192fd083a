"""The same bits, types, files and digests whether or not a program has JAX's 64-bit mode on."""

import dataclasses
import functools
import json
import pathlib
import re
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from crisalad_jax.checkpoints.export import ExportConfig, export_model
from crisalad_jax.checkpoints.starter import FILE
from crisalad_jax.checkpoints.weights import load_weights, model_hash, read_weights, save_weights
from crisalad_jax.nn.aggregators import AGGREGATORS, Aggregator
from crisalad_jax.nn.aggregators.base import TokenShape
from crisalad_jax.nn.config import PRESETS, ModelConfig, with_aggregator
from crisalad_jax.nn.model import Model, check_params, describe, init_crisalad
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.training.losses import LOSSES, LossConfig, metric_loss
from crisalad_jax.training.losses.distil import DistilConfig
from crisalad_jax.training.optimiser import make_optimiser
from crisalad_jax.training.step import init_train_state, make_train_step, step_config
from crisalad_jax.utils.errors import InputError
from tests.conftest import MODEL, RECIPE, assert_equal, random_params
from tests.nn.conftest import slow_unless

IMAGES = np.random.default_rng(0).integers(0, 256, (4, *MODEL.image_size, 3), np.uint8)
LABELS = np.array([0, 0, 1, 1])
PARAMS = random_params(MODEL)


def in_both_modes(make: Callable[[], Any]) -> Any:
    """What `make` returns, which must be the same to the bit in both modes."""
    expected = make()
    with jax.enable_x64(True):
        found = make()
    assert_equal(found, expected)
    return found


# A hash head needs a backbone with two side paths, which no preset has.
@pytest.mark.parametrize(
    "name", slow_unless({"salad", "boq", "netvlad"}, sorted({*AGGREGATORS} - {"selavprpp-hash"}))
)
def test_parameters_are_float32_and_the_same(name: str) -> None:
    alone = "none"
    config = with_aggregator(PRESETS["tiny"], name, "tiny", cross_image=alone)
    params = in_both_modes(lambda: init_crisalad(jax.random.key(2), config))
    assert {leaf.dtype for leaf in jax.tree.leaves(params)} == {jnp.dtype("float32")}


def test_a_program_that_forbids_promotion_and_compiling_gets_the_same_descriptors() -> None:
    expected = describe(PARAMS, IMAGES, MODEL)
    with (
        jax.numpy_rank_promotion("raise"),
        jax.numpy_dtype_promotion("strict"),
        jax.disable_jit(),
    ):
        found = describe(PARAMS, IMAGES, MODEL)
    assert_equal(found, expected)


@dataclasses.dataclass(frozen=True)
class Shifted(Aggregator):
    """As people write them: of JAX's default types."""

    def token_shape(self, dim: int) -> TokenShape:
        return TokenShape(dim, 0, dim)

    def init(self, key: Any, backbone: Any, grid: Any) -> Any:
        return {"shift": jax.random.normal(key, (backbone.dim,)), "scale": jnp.ones(())}

    def apply(self, params: Any, features: Any, grid: Any, *, key: Any) -> Tokens:
        weights = jnp.linspace(0.0, 1.0, features.patches.shape[-2])
        mean = jnp.einsum("p,...pd->...d", weights, features.patches)
        return Tokens.of_global(params["scale"] * mean + params["shift"])


@pytest.mark.usefixtures("own_parts")
def test_so_are_those_and_the_descriptors_of_a_plug_in() -> None:
    AGGREGATORS.register("shifted")(Shifted)
    config = ModelConfig(
        image_size=MODEL.image_size,
        backbone=MODEL.backbone,
        aggregator=Shifted(),
        cross_image="none",
    )
    params = in_both_modes(lambda: init_crisalad(jax.random.key(2), config))
    in_both_modes(lambda: describe(params, IMAGES, config))


@pytest.mark.slow  # the next ones are quicker
def test_descriptors_and_gradients_are_the_same_within_a_program_of_the_users() -> None:
    how = dataclasses.replace(MODEL.preprocessing, normalisation="local-contrast")
    config = dataclasses.replace(MODEL, preprocessing=how)

    @jax.jit
    @jax.value_and_grad
    def slope(params: Any) -> jax.Array:
        return describe(params, IMAGES, config, key=jax.random.key(1))[:, ::7].sum()  # of dropout

    in_both_modes(lambda: slope(PARAMS))


def test_no_number_of_a_program_is_float64() -> None:
    with jax.enable_x64(True):
        traced = jax.make_jaxpr(functools.partial(describe, config=MODEL))(PARAMS, IMAGES)
        wide = dataclasses.replace(MODEL, compute_dtype="float64")
        truly = jax.make_jaxpr(functools.partial(describe, config=wide))(PARAMS, IMAGES)
        lowered = describe.lower(PARAMS, IMAGES, config=MODEL).as_text()
    assert not re.search(r"\b[fi]64\b", str(traced))
    assert "f64" not in lowered
    assert "f64" in str(truly)


@pytest.mark.slow
def test_a_training_step_is_the_same() -> None:
    """With Adam's own numbers, and those of an optimiser of JAX's default types."""

    def init(_: Any) -> Any:
        return jnp.zeros(())

    def update(updates: Any, state: Any, params: Any = None) -> Any:
        scale = 1 / (1.7 + state)
        return jax.tree.map(lambda each: scale * each, updates), state + 1 / 3

    optimiser = optax.chain(
        make_optimiser(RECIPE.optimiser, steps=8), optax.GradientTransformation(init, update)
    )
    static = step_config(RECIPE, steps=8, optimiser=optimiser)

    def train() -> Any:
        step = make_train_step(static)
        state, frozen = init_train_state(PARAMS, "all", static)
        for _ in range(3):
            labels = jnp.asarray(LABELS)  # int64 in the 64-bit mode
            state, metrics = step(state, frozen, IMAGES, labels, jax.random.key(4))
        return state, metrics

    in_both_modes(train)


@pytest.mark.parametrize("name", list(LOSSES))
def test_losses_of_float32_are_float32(name: str) -> None:
    rows = np.random.default_rng(0).normal(size=(4, 6)).astype(np.float32)
    config = LossConfig(kind=LOSSES.make(name), miner="none")
    if config.kind.grouping is not None or config.kind.reads_tokens == "dense":
        pytest.skip("takes more than descriptors; the training step is tested above")
    tokens = jnp.asarray(rows[:, :, None]) if config.kind.reads_tokens else None
    more: dict[str, Any] = {"tokens": tokens}
    if isinstance(config.kind, DistilConfig):
        more["params"] = config.kind.init(jax.random.key(0), 1, 6)
        more["targets"] = jnp.ones((4, config.kind.teacher_dim), jnp.float32)
    with jax.enable_x64(True):
        result = metric_loss(jnp.asarray(rows), jnp.asarray(LABELS), config, **more)
    assert {leaf.dtype for leaf in jax.tree.leaves(result)} == {jnp.dtype("float32")}


def test_files_and_digests_are_the_same(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "weights.safetensors"

    def written() -> bytes:
        save_weights(path, Model(init_crisalad(jax.random.key(0), MODEL), MODEL))
        return path.read_bytes()

    expected, digest = written(), model_hash(*load_weights(path))
    with jax.enable_x64(True):
        assert written() == expected
        assert model_hash(*load_weights(path)) == digest


@pytest.mark.usefixtures("_unchecked")  # symbolic shapes
def test_an_exported_program_is_the_same() -> None:
    def exported() -> bytes:
        return bytes(export_model(PARAMS, MODEL, ExportConfig()).serialize())

    expected = exported()
    with jax.enable_x64(True):
        assert exported() == expected


BY_ITSELF = """
import json, sys
import jax
import numpy as np
import crisalad_jax as cj
from crisalad_jax.checkpoints.weights import model_hash
params, config = cj.load("starter")
images = np.random.default_rng(0).integers(0, 256, (1, 96, 128, 3), np.uint8)
found = np.asarray(cj.describe(params, images, config))
print(json.dumps([jax.config.jax_enable_x64, str(found.dtype), found.tobytes().hex(),
    model_hash(params, config)]))
"""


def test_the_starter_loads_and_describes_in_a_program_of_the_64_bit_mode(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = []
    for mode in ("0", "1"):
        monkeypatch.setenv("JAX_ENABLE_X64", mode)
        run = [sys.executable, "-c", BY_ITSELF]
        done = subprocess.run(run, capture_output=True, text=True, check=True)
        found.append(json.loads(done.stdout))
    assert [each.pop(0) for each in found] == [False, True]
    assert found[0] == found[1]
    assert found[0][-1] == read_weights(FILE).digest  # what the file itself says


def wide(params: Any, make: Any = np.asarray) -> Any:
    return jax.tree.map(lambda leaf: make(np.asarray(leaf, np.float64)), params)


def test_float64_parameters_are_told_unless_the_model_computes_in_float64() -> None:
    message = r"found float64 .*, expected float32"
    config = dataclasses.replace(MODEL, compute_dtype="float64")
    with jax.enable_x64(True):
        with pytest.raises(InputError, match=message):
            describe(wide(PARAMS, jnp.asarray), IMAGES, MODEL)
        with pytest.raises(InputError, match=message):
            check_params(wide(PARAMS), MODEL, stored=True)
        found = describe(wide(PARAMS, jnp.asarray), IMAGES, config)
        assert found.dtype == jnp.float64
        # They hold the same numbers.
        np.testing.assert_array_equal(describe(PARAMS, IMAGES, config), found)
    # Float32 keeps 6e-8 of a number; some tens of layers add up to some tens of that.
    np.testing.assert_allclose(describe(PARAMS, IMAGES, MODEL), found, atol=3e-6)


def test_a_model_of_float64_is_refused_in_the_32_bit_mode() -> None:
    config = dataclasses.replace(MODEL, compute_dtype="float64")
    message = r"^ModelConfig.compute_dtype: found float64 in JAX's 32-bit mode, expected JAX_ENA"
    with pytest.raises(InputError, match=message):
        describe(PARAMS, IMAGES, config)
    static = step_config(dataclasses.replace(RECIPE, model=config), steps=8)
    with pytest.raises(InputError, match=message):
        init_train_state(PARAMS, "all", static)
