"""Files that are no whole model, at each door that takes one: one line, and nothing written."""

import dataclasses
from collections.abc import Callable

import pytest
import torch

import crisalad_jax as cj
from crisalad_jax.checkpoints.formats import public_shapes
from crisalad_jax.checkpoints.public import read_backbone
from crisalad_jax.nn.aggregators.gem import CosPlaceConfig
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.utils.errors import InputError
from tests.cli.test_cli import fails, succeeds
from tests.random_checkpoints import random_state, save

Tensors = dict[str, torch.Tensor]
SALAD = ModelConfig(
    backbone=ViTConfig(dim=64, depth=2, heads=1, position_grid=2, adapter="none"),
    aggregator=SaladConfig(clusters=4, cluster_dim=8, token_dim=16, hidden=16),
    cross_image="none",
)
WIDE = dataclasses.replace(SALAD, backbone=dataclasses.replace(SALAD.backbone, dim=128, heads=2))


def salad(config: ModelConfig = SALAD) -> Tensors:
    return random_state(public_shapes(config, "dino-salad"))


def cosplace() -> Tensors:
    """Of the true names and shapes; each tensor stores one number."""
    config = dataclasses.replace(
        SALAD, backbone=ResNetConfig(layers=18), aggregator=CosPlaceConfig(dim=3)
    )
    return {
        name: torch.zeros((), dtype=torch.float32 if shape else torch.int64).expand(shape)
        for name, shape in public_shapes(config, "cosplace").items()
    }


def part(state: Tensors, of: str) -> Tensors:
    return {name: tensor for name, tensor in state.items() if name.startswith(of)}


STATES: dict[str, tuple[Callable[[], Tensors], str]] = {
    "SALAD's head": (
        lambda: part(salad(), "aggregator."),
        "found no checkpoint that we know (its first names: aggregator.cluster_features.0.bias, ",
    ),
    "CosPlace's backbone": (
        lambda: part(cosplace(), "backbone."),
        "found no checkpoint that we know (its first names: backbone.",
    ),
    "a head of another width": (
        lambda: salad() | part(salad(WIDE), "backbone."),
        "does not fit the format dino-salad of width 128 and 2 blocks: "
        "aggregator.cluster_features.0.weight found (16, 64, 1, 1), expected (16, 128, 1, 1)",
    ),
    "a ResNet without a block": (
        lambda: {k: x for k, x in cosplace().items() if not k.startswith("backbone.6.1.")},
        "found a ResNet of (2, 2, 1, 2) blocks of two convolutions, expected one of {18: (2, 2",
    ),
}


@pytest.mark.parametrize("name", STATES)
def test_a_part_of_a_model_or_one_of_another_size(capfd, tmp_path, name):
    make, words = STATES[name]
    file = save(tmp_path / "file.pth", make())
    fails(capfd, "convert", file, tmp_path / "ours.safetensors", words=(f"{file}: {words}",))
    with pytest.raises(InputError) as caught:
        cj.load(file)
    assert str(caught.value).startswith(f"{file}: {words}")
    assert [path.name for path in tmp_path.iterdir()] == ["file.pth"]


def test_public_files_are_told_from_ours_where_weights_are_asked_for(capfd, tmp_path):
    public, hugging = (save(tmp_path / name, salad()) for name in ("p.ckpt", "h.safetensors"))
    for file, kind in (
        (public, "not a whole safetensors file"),
        (hugging, "found metadata ['format'], expected a"),
    ):
        error = fails(capfd, "info", "--weights", file, words=(f"{file}: {kind}",))
        assert error.endswith("`crisalad convert` reads public checkpoints\n")
    page = tmp_path / "page.pth"
    page.write_text("\n<!DOCTYPE html><title>Too many downloads</title>")
    words = (f"{page}: found a page of HTML, expected",)
    fails(capfd, "convert", page, tmp_path / "x.safetensors", words=words)


def test_a_preset_beside_weights(capfd, tmp_path):
    ours = tmp_path / "ours.safetensors"
    succeeds(capfd, "convert", save(tmp_path / "p.ckpt", salad()), ours)
    words = ("--preset: found with --weights, expected only one of the two",)
    given = ("--weights", ours, "--preset", "l14")
    fails(capfd, "info", *given, words=words)
    fails(capfd, "evaluate", *given, "--data", tmp_path, words=words)


def test_training_from_another_size_or_kind(capfd, tmp_path):
    ours, public = tmp_path / "ours.safetensors", save(tmp_path / "p.ckpt", salad())
    succeeds(capfd, "convert", public, ours)
    train = ("train", "--preset", "tiny", "--data", tmp_path, "--out", tmp_path / "run")
    words = (
        f"{ours}: these weights are of another model: ",
        "backbone.dim: found 64, expected 128",
    )
    fails(capfd, *train, "--weights", ours, "--model.backbone.dim", 128, words=words)
    resnet = save(tmp_path / "cosplace.pth", cosplace())
    words = "this backbone differs from the model's: backbone: found resnet, expected vit"
    with pytest.raises(InputError, match=f"^{resnet}: {words}"):
        read_backbone(resnet, SALAD.backbone, None)
    assert not (tmp_path / "run").exists()


def test_a_published_name_is_no_file_to_convert(capfd, tmp_path):
    words = ("salad: found the name of a published model, expected a file; --weights salad",)
    fails(capfd, "convert", "salad", tmp_path / "x.safetensors", words=words)
