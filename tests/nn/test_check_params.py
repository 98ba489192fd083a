"""Parameters of another configuration, and images of another kind: refused at every public door."""

import dataclasses
import pathlib
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.checkpoints.export import ExportConfig, write_export
from crisalad_jax.checkpoints.weights import load_weights, save_weights
from crisalad_jax.data.benchmarks import open_benchmark
from crisalad_jax.data.places import read_places
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import (
    Crisalad,
    Model,
    attend_across_images,
    cast_params,
    check_params,
    describe,
    extract_features,
    extract_tokens,
    transport_masses,
    unit_features,
)
from crisalad_jax.retrieval.extract import extract
from crisalad_jax.retrieval.maps.build import index
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.loop import fit
from crisalad_jax.training.step import (
    init_train_state,
    make_train_step,
    step_config,
)
from crisalad_jax.training.trainable import merge_params, split_params
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.target import GPU, lowering_for
from tests.conftest import MODEL, RECIPE, random_params

PARAMS = random_params(MODEL)
IMAGES = np.random.default_rng(0).integers(0, 256, (2, 42, 56, 3), dtype=np.uint8)
LABELS = np.array([0, 0])


FEWER = dataclasses.replace(MODEL, aggregator=dataclasses.replace(MODEL.aggregator, clusters=2))


class At(NamedTuple):
    """What a door is tried with."""

    params: Crisalad
    config: ModelConfig
    out: pathlib.Path
    shared: pathlib.Path

    @property
    def model(self) -> Model:
        return Model(self.params, self.config)

    @property
    def recipe(self) -> TrainConfig:
        return dataclasses.replace(RECIPE, model=self.config)


def a_step(at: At) -> None:
    """A state of MODEL in a step of the other configuration."""
    state, frozen = init_train_state(PARAMS, "head,-adapters", step_config(RECIPE, steps=2))
    state = state._replace(trainable=at.params)
    step = make_train_step(step_config(at.recipe, steps=2))
    step(state, jax.tree.map(lambda _: None, frozen), IMAGES, LABELS, jax.random.key(0))


def of_images(function: Callable[..., Any]) -> Callable[[At], Any]:
    return lambda at: function(at.params, IMAGES, at.config)


def a_run(at: At) -> None:
    places = read_places(at.shared / "city", min_images=2)
    fit(at.recipe, places, at.out / "run", initial=at.params, quiet=True)


OF_IMAGES = (describe, extract_tokens, extract_features)
QUIET = Reading(quiet=True)
DOORS: dict[str, Callable[[At], Any]] = {
    **{door.__name__: of_images(door) for door in (*OF_IMAGES, unit_features, transport_masses)},
    "attend_across_images": lambda at: attend_across_images(
        at.params, extract_tokens(PARAMS, IMAGES, MODEL), at.config
    ),
    "describe, jitted": lambda at: jax.jit(lambda x: describe(x, IMAGES, at.config))(at.params),
    "init_train_state": lambda at: init_train_state(
        at.params, "head,-adapters", step_config(at.recipe, steps=2)
    ),
    "a step": a_step,
    "fit": a_run,
    "extract": lambda at: extract(at.model, at.shared / "town", at.out / "d.npy", reading=QUIET),
    "index": lambda at: index(
        at.model, at.shared / "town", at.out / "map", weights=at.out / "none", reading=QUIET
    ),
    "evaluate": lambda at: evaluate(at.model, open_benchmark(at.shared / "town"), reading=QUIET),
    "write_export": lambda at: write_export(
        at.out / "export", at.model, ExportConfig(platforms=("cpu",))
    ),
    "save_weights": lambda at: save_weights(at.out / "w.safetensors", at.model),
}
DIFFERENCES: dict[str, tuple[Any, ModelConfig, str]] = {
    "clusters": (
        PARAMS,
        FEWER,
        "aggregator.score.fc2.weight found float32 (16, 4), expected float32 (16, 2); "
        "aggregator.score.fc2.bias found float32 (4,), expected float32 (2,)",
    ),
    "no encoder": (
        dataclasses.replace(PARAMS, cross_image=None),
        MODEL,
        "cross_image.layers.0.attn.qkv.weight missing; ",
    ),
    "one encoder too many": (
        PARAMS,
        dataclasses.replace(MODEL, cross_image="none"),
        "cross_image.layers.0.attn.qkv.weight unknown; ",
    ),
    "half precision": (
        jax.tree.map(lambda leaf: leaf.astype(jnp.bfloat16), PARAMS),
        MODEL,
        "found bfloat16 (",
    ),
    "half a model": (
        split_params(PARAMS, MODEL, "head,-adapters")[0],
        MODEL,
        "patch_embed.weight missing",
    ),
    "no Crisalad": ((PARAMS, MODEL), MODEL, "params: found tuple, expected Crisalad"),
}


@pytest.mark.parametrize(
    ("door", "difference"),
    [*((door, "clusters") for door in DOORS), *(("describe", each) for each in DIFFERENCES)],
)
@pytest.mark.usefixtures("_unchecked")
def test_every_door_refuses_parameters_of_another_configuration(
    door: str, difference: str, tmp_path: pathlib.Path, shared: pathlib.Path
) -> None:
    params, config, words = DIFFERENCES[difference]
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        DOORS[door](At(params, config, tmp_path, shared))
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_numpy_arrays_and_free_fields_make_no_misfit() -> None:
    expected = np.asarray(describe(PARAMS, IMAGES, MODEL))
    arrays = jax.tree.map(np.asarray, PARAMS)
    np.testing.assert_array_equal(describe(arrays, IMAGES, MODEL), expected)
    other = dataclasses.replace(
        MODEL,
        image_size=(56, 56),
        backbone=dataclasses.replace(MODEL.backbone, position_init="sincos"),
        cross_image=dataclasses.replace(MODEL.cross_image, dropout=0.5),
        remat="full",
    )
    np.testing.assert_array_equal(describe(PARAMS, IMAGES, other), expected)


@pytest.mark.parametrize(
    "trainable", ["head,-adapters", "adapters,head", "last-1-blocks,norm,head"]
)
def test_what_training_has_cast_and_cut_still_fits(trainable: str) -> None:
    config = dataclasses.replace(MODEL, compute_dtype="bfloat16")
    chosen, frozen = split_params(PARAMS, config, trainable)
    with lowering_for(GPU):  # as on a CPU from jax 0.11 on
        cast = cast_params(frozen, config)
    assert any(leaf.dtype == jnp.bfloat16 for leaf in jax.tree.leaves(cast))
    whole = jax.tree.map(
        lambda a, b: b if a is None else a, chosen, cast, is_leaf=lambda leaf: leaf is None
    )
    check_params(whole, config)
    check_params(merge_params(chosen, frozen, config), config, stored=True)
    with pytest.raises(InputError, match="not of this configuration"):
        check_params(whole, config, stored=True)


def test_trees_of_another_model_are_not_merged() -> None:
    chosen, frozen = split_params(PARAMS, MODEL, "head,-adapters")
    other = dataclasses.replace(MODEL, cross_image=dataclasses.replace(MODEL.cross_image, layers=1))
    with pytest.raises(InputError, match=r"params: not of this configuration: cross_image\."):
        merge_params(chosen, frozen, other)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_no_file_of_weights_holds_what_cannot_be_loaded(value: float, tmp_path) -> None:
    path = tmp_path / "weights.safetensors"
    token = PARAMS.backbone.cls_token.at[0].set(value)
    backbone = dataclasses.replace(PARAMS.backbone, cls_token=token)
    broken = dataclasses.replace(PARAMS, backbone=backbone)
    words = r"^params: .*: backbone\.cls_token holds NaN or infinity$"
    with pytest.raises(InputError, match=words):
        save_weights(path, Model(broken, MODEL))
    assert not path.exists()
    save_weights(path, Model(PARAMS, MODEL))
    assert load_weights(path, expected=MODEL)[1] == MODEL


PICTURES: dict[str, tuple[Any, str]] = {
    "a list": (list(IMAGES), "found list, expected an array of shape (image, height, width, 3)"),
    "a name": ("a.jpg", "found str, expected an array of shape (image, height, width, 3)"),
    "one image": (IMAGES[0], "found uint8 of shape (42, 56, 3), expected uint8 pixels, or floats"),
    "none": (IMAGES[:0], "found uint8 of shape (0, 42, 56, 3), expected"),
    "int32": (IMAGES.astype(np.int32), "found int32 of shape (2, 42, 56, 3), expected"),
    "0 to 255": (
        IMAGES.astype(np.float32),
        "found float32 from 0 to 255, which are pixels, expected floats that are normalised, or "
        "uint8: images.round().astype(np.uint8)",
    ),
    "0 to 255 of JAX": (jnp.asarray(IMAGES, jnp.float32), "found float32 from 0 to 255, which are"),
    "resized by cubic splines": (IMAGES * 1.04 - 5.0, "found float64 from -5 to 260, which are"),
    "0 to 1": (
        IMAGES / 255,
        "found float64 from 0 to 1, which are pixels, expected floats that are normalised, or "
        "uint8: (255 * images).round().astype(np.uint8)",
    ),
}


@pytest.mark.parametrize("door", OF_IMAGES)
@pytest.mark.parametrize("kind", PICTURES)
@pytest.mark.usefixtures("_unchecked")
def test_every_door_refuses_images_of_another_kind(door: Callable[..., Any], kind: str) -> None:
    images, words = PICTURES[kind]
    with pytest.raises(InputError, match=f"^images: {re.escape(words)}") as caught:
        door(PARAMS, images, MODEL)
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("_unchecked")
def test_a_step_refuses_pixels_as_floats() -> None:
    static = step_config(RECIPE, steps=2)
    state, frozen = init_train_state(PARAMS, "head,-adapters", static)
    with pytest.raises(InputError, match=r"^images: found float64 from 0 to 1, which"):
        make_train_step(static)(state, frozen, IMAGES / 255, LABELS, jax.random.key(0))


@pytest.mark.parametrize(
    ("low", "high"),
    # ImageNet's range, the largest outlier of a window of 21 x 21, a bright and a uniform image.
    [(-2.118, 2.64), (-3.0, 20.98), (0.0, 2.64), (0.2, 0.6), (0.0, 0.0), (1.0, 1.0)],
)
def test_normalised_floats_are_described(low: float, high: float) -> None:
    images = np.linspace(low, high, IMAGES.size, dtype=np.float32).reshape(IMAGES.shape)
    assert np.isfinite(describe(PARAMS, images, MODEL)).all()


@pytest.mark.usefixtures("_unchecked")
def test_tokens_of_another_model_are_refused() -> None:
    tokens = extract_tokens(PARAMS, IMAGES, MODEL)
    shorter = tokens._replace(local=tokens.local[:, :2], transport=None)
    words = r"^tokens: found .* local tokens of \(2, 2, 8\), expected .* and \(2, 4, 8\)"
    with pytest.raises(InputError, match=words):
        attend_across_images(PARAMS, shorter, MODEL)
    with pytest.raises(InputError, match=r"^tokens: found ndarray, expected Tokens"):
        attend_across_images(PARAMS, IMAGES, MODEL)
