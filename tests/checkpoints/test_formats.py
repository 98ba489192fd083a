"""The tables of names against the stored layouts of the public checkpoints."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from crisalad_jax.checkpoints.formats import (
    check_holds,
    infer,
    public_shapes,
    table,
    to_params,
    to_state,
)
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.adapters.bottleneck import DepthwiseConfig, SideMultiResolutionConfig
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.aggregators.vlad import AnyLocConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import PRESETS, ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.utils.errors import InputError
from tests.checkpoints.test_export import OTHERS
from tests.conftest import MODEL, assert_equal, random_params
from tests.random_checkpoints import LAYOUTS as FOLDER
from tests.random_checkpoints import UNDER, as_arrays, bare_vit, blank, public_layout, random_state

PUBLIC = sorted(path.stem for path in FOLDER.glob("*.json"))
BARE = "none"
NO_ADAPTER = "none"


def inner(name: str) -> dict[str, tuple[int, ...]]:
    """A public layout as tables have it: without the way into the file."""
    return {
        key.removeprefix(UNDER).removeprefix("module."): shape
        for key, shape in public_layout(name).items()
    }


def expected(name: str) -> tuple[str, ModelConfig]:
    if name == "CricaVPR":
        adapter = "multi-resolution"
        backbone = dataclasses.replace(PRESETS["b14"].backbone, adapter=adapter)
        floats = PreprocessingConfig(antialias=False, pixels="floats")
        return "cricavpr", ModelConfig(
            aggregator="gem-pyramid", backbone=backbone, preprocessing=floats
        )
    preset = "b14" if name == "dino_salad" else f"{name.removeprefix('dinov2_vit')[0]}14"
    backbone = dataclasses.replace(
        PRESETS[preset].backbone, adapter=NO_ADAPTER, registers=4 if "reg4" in name else 0
    )
    if name == "dino_salad":
        return "dino-salad", ModelConfig(image_size=(322, 322), backbone=backbone, cross_image=BARE)
    return "dinov2", ModelConfig(aggregator="class-token", backbone=backbone, cross_image=BARE)


@pytest.mark.parametrize("name", PUBLIC)
def test_a_public_format_is_read_to_the_name_and_its_model_inferred(name: str) -> None:
    shapes = inner(name)
    layout, config = infer(blank(shapes), source=name)
    assert (layout, config) == expected(name)
    assert list(public_shapes(config, layout).items()) == list(shapes.items())


def test_all_layouts_are_there() -> None:
    assert len(PUBLIC) == 10


BACKBONES = {
    "registers, SwiGLU, MLP adapter": {
        "registers": 3,
        "ffn": "swiglu",
        "adapter": "mlp",
    },
    "multi-resolution": {"adapter": "multi-resolution"},
    "serial and parallel": {"adapter": "serial-parallel"},
    "side": {"adapter": "side"},
    "two sides of the last block": {
        "adapter": SideMultiResolutionConfig(last=1, paths=2),
    },
    "bias of the up-projection": {"adapter": DepthwiseConfig(bias="up")},
}
MODELS = {
    "crisalad": MODEL,
    "anyloc": dataclasses.replace(MODEL, aggregator=AnyLocConfig(layer=0), cross_image=BARE),
    **{
        name: dataclasses.replace(MODEL, backbone=dataclasses.replace(MODEL.backbone, **fields))
        for name, fields in BACKBONES.items()
    },
    "netvlad": dataclasses.replace(MODEL, aggregator="netvlad"),
    **{
        f"dustbin {name}": dataclasses.replace(
            MODEL, aggregator=dataclasses.replace(MODEL.aggregator, dustbin=name)
        )
        for name in ("token", "mass", "none")
    },
    **OTHERS,
}


@pytest.mark.parametrize("name", MODELS)
def test_any_model_survives_the_reference_format_bit_for_bit(name: str) -> None:
    config = MODELS[name]
    params = random_params(config)
    state = to_state(params, config, "reference", {})
    assert {key: array.shape for key, array in state.items()} == public_shapes(config, "reference")
    back, extras = to_params(state, config, "reference", source="state")
    assert all(not array.any() for array in extras.values())
    assert_equal(back, params)


def small_state() -> dict[str, np.ndarray]:
    """A small DINOv2's."""
    return as_arrays(random_state(public_shapes(bare_vit(), "dinov2")))


def test_the_first_of_what_is_wrong_is_listed() -> None:
    state, config = small_state(), bare_vit()
    del state["norm.weight"]
    state["cls_token"] = np.zeros((1, 64), np.float32)
    state |= {"head.weight": np.zeros(1), "blocks.10.x": np.zeros(1), "blocks.9.x": np.zeros(1)}
    with pytest.raises(InputError) as caught:
        to_params(state, config, "dinov2", source="file.pth")
    # The others are `head.weight`, unknown, and the norm, missing.
    assert str(caught.value).endswith(
        "width 64 and 2 blocks: blocks.10.x unknown; blocks.9.x unknown; "
        "cls_token found (1, 64), expected (1, 1, 64); and 2 more"
    )


@pytest.mark.parametrize(
    ("name", "shape", "words"),
    [
        ("cls_token", None, "found no cls_token"),
        ("cls_token", (1, 1, 48), "backbone of width 48, expected a multiple of 64"),
        ("pos_embed", (1, 7, 64), "found 7 position embeddings, expected 1 and a square"),
        ("blocks.0.mlp.fc2.weight", None, "found no blocks.0.mlp.fc2.weight, expected an array of"),
    ],
)
def test_what_is_no_model_is_refused(name: str, shape: Any, words: str) -> None:
    state = small_state()
    array = state.pop(name)
    if shape is not None:
        state[name] = np.zeros(shape, array.dtype)
    with pytest.raises(InputError, match=rf"^file\.pth: .*{words}"):
        infer(state, source="file.pth")


@pytest.mark.parametrize("layout", ["dinov2", "huggingface", "dino-salad", "cricavpr"])
def test_a_format_holds_its_own_models_only(layout: str) -> None:
    part = "adapter depthwise" if layout == "dino-salad" else "aggregator salad"
    with pytest.raises(InputError, match=f"format {layout}: found a model of {part}, expected"):
        table(MODEL, layout)
    assert table(MODEL, "reference")


def test_unusual_widths_are_inferred() -> None:
    config = ModelConfig(
        backbone=ViTConfig(
            dim=128,
            depth=3,
            heads=2,
            mlp_ratio=2.5,
            position_grid=4,
            adapter=DepthwiseConfig(kernel_size=5, bottleneck=0.25),
        ),
        aggregator=SaladConfig(clusters=5, cluster_dim=32, token_dim=64, hidden=48),
        cross_image=CrossImageConfig(layers=1, feedforward=40),
    )
    state = blank(public_shapes(config, "reference"))
    assert infer(state, source="state") == ("reference", config)


def bare_salad(**fields: Any) -> ModelConfig:
    """SALAD over a DINOv2, with other fields."""
    aggregator = dataclasses.replace(MODEL.aggregator, **fields)
    return dataclasses.replace(bare_vit(), aggregator=aggregator)


def test_another_dustbin_is_no_dino_salad() -> None:
    config = bare_salad(dustbin="token")
    with pytest.raises(
        InputError, match=r"format dino-salad: cannot store settings .*dustbin.*token"
    ):
        check_holds(config, "dino-salad")


@pytest.mark.parametrize("name", ["reference", "dino-salad"])
def test_no_array_is_left_out_of_a_file_in_silence(name) -> None:
    config = bare_salad(learn_epsilon=True)
    with pytest.raises(InputError, match=f"format {name}: found aggregator.log_epsilon, expected"):
        table(config, name)
