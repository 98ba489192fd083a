"""Compare DINOv3 with Hugging Face's DINOv3ViTModel: names, features, facets, gradients, sizes.

Weights are random and reach transformers through files. The bounds are those of DINOv2
(test_independent.py), 1e-5 on outputs and 1e-4 on gradients; 1.8e-6 and 5e-6 are measured here.
Swapped rows and columns, another pairing of dimensions, or a key bias show at 1e-2 and more.
"""

import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from safetensors.numpy import load_file
from transformers import DINOv3ViTConfig, DINOv3ViTModel

from crisalad_jax.checkpoints.formats import infer, to_params, to_state
from crisalad_jax.checkpoints.public import convert, read_checkpoint, write_checkpoint
from crisalad_jax.checkpoints.published import PUBLISHED, published_model
from crisalad_jax.nn.aggregators.backbone_tokens import ClassTokenConfig
from crisalad_jax.nn.backbones import FeatureSpec
from crisalad_jax.nn.backbones.dinov3 import DinoV3Config
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, parameter_shapes
from parity.test_goldens import GRADIENT_BOUND, OUTPUT_BOUND, golden_loss, relative_error
from parity.test_independent import (
    gradients_by_public_name,
    one_thread,  # noqa: F401  (used by itself)
    our_features,
    saved,
    shake,
    their_features,
    torch_loss,
)

LAYOUT, REGISTERS = "huggingface-dinov3", 4
OBLONG = (3, 5)
GATED = [False, True]
PERIODS = [1, 1.3359375, 1.78125, 2.375, 3.15625, 4.21875, 5.625, 7.5]
PERIODS += [10, 13.3125, 17.75, 23.75, 31.625, 42.25, 56.25, 75]
"""The periods in the public .pth files, rounded to bfloat16."""


def hugging_face(gated: bool) -> Any:
    """Make a model of two blocks with random parameters, none at its initial value."""
    torch.manual_seed(0)
    config = DINOv3ViTConfig(
        hidden_size=128,
        intermediate_size=512,
        num_hidden_layers=2,
        num_attention_heads=2,
        num_register_tokens=REGISTERS,
        use_gated_mlp=gated,
        hidden_act="silu" if gated else "gelu",
        attn_implementation="eager",
    )
    model = DINOv3ViTModel(config)
    shake(model)
    return model.eval()


def expected_config(gated: bool) -> ModelConfig:
    # As published: SwiGLU with two thirds of six times the width.
    sizes: dict[str, Any] = {"ffn": "swiglu", "mlp_ratio": 6.0} if gated else {}
    backbone = DinoV3Config(dim=128, depth=2, heads=2, adapter="none", **sizes)
    return ModelConfig(backbone=backbone, aggregator=ClassTokenConfig(), cross_image="none")


def pixels(grid: tuple[int, int]) -> np.ndarray:
    shape = (2, grid[0] * 16, grid[1] * 16, 3)
    return np.random.default_rng(0).standard_normal(shape, np.float32)


@pytest.mark.parametrize("gated", GATED)
def test_names_are_transformers_own(gated: bool, tmp_path: pathlib.Path) -> None:
    """Converting its file to ours and back gives the same file, also via the other layout."""
    model = hugging_face(gated)
    path = saved(model, tmp_path)
    theirs = load_file(path)
    found = read_checkpoint(path)
    assert found.format == LAYOUT
    assert found.config == expected_config(gated)
    write_checkpoint(tmp_path / "meta.pth", found.params, found.config, "dinov3", found.extras)
    other = read_checkpoint(tmp_path / "meta.pth")
    assert (other.format, other.config) == ("dinov3", found.config)
    for each in (found, other):
        state = to_state(each.params, each.config, LAYOUT, each.extras)
        assert state.keys() == theirs.keys()
        for name, array in theirs.items():
            np.testing.assert_array_equal(state[name], array)

    path.unlink()
    write_checkpoint(path, found.params, found.config, LAYOUT, found.extras)
    loaded, report = type(model).from_pretrained(
        tmp_path, local_files_only=True, output_loading_info=True
    )
    assert not any(report.values()), report
    parameters = dict(model.named_parameters())
    for name, parameter in loaded.named_parameters():
        assert torch.equal(parameter, parameters[name]), name


def as_facebooks(state: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Rename a transformers state to facebookresearch/dinov3's names.

    These are the names that transformers' conversion script maps from: w1 is SwiGLU's gate, w2 its
    value, and keys have no bias.
    """
    words = {
        "embeddings.patch_embeddings": "patch_embed.proj",
        "embeddings.": "",
        "register_tokens": "storage_tokens",
        "layer.": "blocks.",
        "attention.o_proj": "attn.proj",
        "layer_scale1.lambda1": "ls1.gamma",
        "layer_scale2.lambda1": "ls2.gamma",
    }
    gated = any("gate_proj" in name for name in state)
    up, down = ("w2", "w3") if gated else ("fc1", "fc2")
    words |= {"gate_proj": "w1", "up_proj": up, "down_proj": down}
    renamed = {}
    for name, array in state.items():
        for old, new in words.items():
            name = name.replace(old, new)
        renamed[name] = array
    renamed["mask_token"] = renamed["mask_token"][0]
    for i in range(2):
        here = f"blocks.{i}.attention."
        bias, rest = (renamed.pop(f"{here}{each}_proj.bias") for each in "qv")
        weights = [renamed.pop(f"{here}{each}_proj.weight") for each in "qkv"]
        there = f"blocks.{i}.attn.qkv"
        renamed[f"{there}.weight"] = np.concatenate(weights)
        renamed[f"{there}.bias"] = np.concatenate([bias, np.zeros_like(bias), rest])
        renamed[f"{there}.bias_mask"] = np.repeat(np.float32([1, 0, 1]), len(bias))
    return renamed | {"rope_embed.periods": np.float32(PERIODS)}


@pytest.mark.parametrize("gated", GATED)
def test_names_are_facebooks_too(gated: bool, tmp_path: pathlib.Path) -> None:
    path = saved(hugging_face(gated), tmp_path)
    expected = read_checkpoint(path)
    state = as_facebooks(load_file(path))
    layout, config = infer(state, source="file")
    assert (layout, config) == ("dinov3", expected.config)
    params, extras = to_params(state, config, layout, source="file")
    jax.tree.map(np.testing.assert_array_equal, params, expected.params)
    for name, array in to_state(params, config, layout, extras).items():
        np.testing.assert_array_equal(array, state[name])


@pytest.mark.parametrize(("gated", "grid"), [(False, OBLONG), (True, (4, 4))])
def test_dinov3_is_transformers(gated: bool, grid: tuple[int, int], tmp_path: pathlib.Path) -> None:
    """Features and all gradients."""
    model = hugging_face(gated)
    found = read_checkpoint(saved(model, tmp_path))
    images = torch.tensor(pixels(grid), requires_grad=True)
    theirs = their_features(model, images, REGISTERS)
    torch_loss(theirs).backward()
    assert images.grad is not None

    def loss(params: Crisalad, x: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        outputs = our_features(params, x, found.config)
        return golden_loss(outputs), outputs

    (params_gradient, gradient), ours = jax.jit(jax.grad(loss, argnums=(0, 1), has_aux=True))(
        found.params, jnp.asarray(pixels(grid))
    )
    for name, output in theirs.items():
        assert relative_error(ours[name], output.detach()) < OUTPUT_BOUND, name
    assert relative_error(gradient, images.grad) < GRADIENT_BOUND
    expected = gradients_by_public_name(model, tmp_path)
    actual = to_state(params_gradient, found.config, LAYOUT, extras={})
    assert actual.keys() == expected.keys()
    for name, array in expected.items():
        if name.endswith("mask_token"):
            assert not array.any()
        else:
            assert relative_error(actual[name], array) < GRADIENT_BOUND, name
    # No weight decay or step moves the absent bias.
    of_keys = np.split(params_gradient.backbone.blocks.attn.qkv.bias, 3, axis=1)[1]
    assert not of_keys.any()


def test_facets_are_transformers(tmp_path: pathlib.Path) -> None:
    """Outputs of the linear layers, before queries and keys are rotated."""
    model = hugging_face(gated=False)
    found = read_checkpoint(saved(model, tmp_path))
    images = pixels(OBLONG)
    inner = model.model.layer[1].attention
    sources = {"query": inner.q_proj, "key": inner.k_proj, "value": inner.v_proj}
    outputs: dict[str, np.ndarray] = {}
    for name, part in sources.items():
        part.register_forward_hook(
            lambda _, __, output, name=name: outputs.__setitem__(name, output.detach().numpy())
        )
    with torch.no_grad():
        their_features(model, torch.from_numpy(images), REGISTERS)
    backbone, config = found.params.backbone, found.config.backbone
    for name, expected in outputs.items():
        request = FeatureSpec((2,), name, norm=False)
        ours, _ = config.apply(backbone, jnp.asarray(images), request)
        assert relative_error(ours.patches, expected[:, 1 + REGISTERS :]) < OUTPUT_BOUND
        assert relative_error(ours.class_token, expected[:, 0]) < OUTPUT_BOUND


SIZES: dict[str, tuple[int, int, int, int, bool]] = {
    "dinov3-vits16": (384, 12, 6, 1536, False),
    "dinov3-vits16plus": (384, 12, 6, 1536, True),
    "dinov3-vitb16": (768, 12, 12, 3072, False),
    "dinov3-vitl16": (1024, 24, 16, 4096, False),
    "dinov3-vith16plus": (1280, 32, 20, 5120, True),
}
"""Width, blocks, heads and hidden width of the published models, and whether they have SwiGLU."""


@pytest.mark.parametrize("name", SIZES)
def test_published_sizes_are_transformers(name: str) -> None:
    dim, depth, heads, hidden, gated = SIZES[name]
    config = DINOv3ViTConfig(
        hidden_size=dim,
        num_hidden_layers=depth,
        num_attention_heads=heads,
        intermediate_size=hidden,
        use_gated_mlp=gated,
        num_register_tokens=REGISTERS,
    )
    with torch.device("meta"):
        shapes = {key: tuple(x.shape) for key, x in DINOv3ViTModel(config).named_parameters()}
    blank = {
        key.removeprefix("model."): np.broadcast_to(np.float32(0), shape)
        for key, shape in shapes.items()
    }
    layout, found = infer(blank, source=name)
    assert layout == LAYOUT
    assert found.backbone.heads == heads
    model = published_model(name)
    parameters = sum(leaf.size for leaf in jax.tree.leaves(parameter_shapes(found)))
    assert (model.descriptor, model.parameters) == (found.descriptor_dim, parameters)
    # Ours have a key bias, always 0, and no mask token.
    theirs = sum(array.size for array in blank.values())
    assert parameters == theirs + depth * dim - dim


def test_all_published_sizes_are_there() -> None:
    assert {name for name in PUBLISHED if name.startswith("dinov3-")} == SIZES.keys()


def test_a_file_of_facebooks_is_the_same_bytes(tmp_path: pathlib.Path) -> None:
    """Round trip; a file written from a transformers state has the published periods."""
    found = read_checkpoint(saved(hugging_face(gated=False), tmp_path))
    path = tmp_path / "meta.pth"
    write_checkpoint(path, found.params, found.config, "dinov3", found.extras)
    assert torch.load(path)["rope_embed.periods"].tolist() == PERIODS
    convert(path, tmp_path / "ours.safetensors")
    convert(tmp_path / "ours.safetensors", tmp_path / "back.pth")
    assert (tmp_path / "back.pth").read_bytes() == path.read_bytes()


def test_the_class_tokens_attention_turns_keys(tmp_path: pathlib.Path) -> None:
    model = hugging_face(gated=False)
    checkpoint = read_checkpoint(saved(model, tmp_path))
    images = pixels(OBLONG)
    with torch.no_grad():
        weights = model(torch.from_numpy(images).permute(0, 3, 1, 2), output_attentions=True)
    expected = weights.attentions[-1][:, :, 0, 1 + REGISTERS :].sum(dim=1).numpy()
    backbone, request = checkpoint.config.backbone, FeatureSpec(class_attention=True)
    found, _ = backbone.apply(
        checkpoint.params.backbone, jnp.asarray(images), request, remat="none"
    )
    assert found.class_attention is not None
    assert relative_error(found.class_attention, expected) < OUTPUT_BOUND
