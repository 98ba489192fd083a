"""AnyLoc's published vocabularies: one tensor by itself, beside its backbone's file."""

import pathlib

import numpy as np
import pytest
import torch

from crisalad_jax.checkpoints.formats import VOCABULARY, public_shapes
from crisalad_jax.checkpoints.public import convert, read_checkpoint, read_vocabulary
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.nn.aggregators.vlad import AnyLocConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.utils.errors import InputError
from tests.cli.test_cli import fails, succeeds
from tests.conftest import assert_equal
from tests.random_checkpoints import random_state, save

BARE = ModelConfig(
    backbone=ViTConfig(dim=64, depth=2, heads=1, position_grid=2, adapter="none"),
    aggregator="class-token",
    cross_image="none",
)


@pytest.fixture
def files(tmp_path: pathlib.Path) -> tuple[pathlib.Path, pathlib.Path]:
    """A vocabulary of three words, and its backbone."""
    words = tmp_path / "c_centers.pt"
    with words.open("wb") as file:
        torch.save(torch.randn(3, 64, generator=torch.Generator().manual_seed(0)), file)
    state = random_state(public_shapes(BARE, "dinov2"))
    return words, save(tmp_path / "dinov2.pth", dict(state))


def test_there_and_back_are_the_same_bytes(files, capfd, tmp_path):
    words, backbone = files
    ours, back = tmp_path / "anyloc.safetensors", tmp_path / "back.pt"
    flags = ("--backbone", backbone, "--layer", 1, "--facet", "key")
    said = succeeds(capfd, "convert", words, ours, *flags)
    assert said.startswith(f"{words} (AnyLoc c_centers.pt) -> {ours} (crisalad-jax): ")
    params, config = load_weights(ours)  # which compares the backbone with the vocabulary's
    assert config.aggregator == AnyLocConfig(3, 1, "key", "cosine")
    assert config.preprocessing.size_rule == "native"
    np.testing.assert_array_equal(params.aggregator.words, torch.load(words).numpy())
    assert_equal(params.backbone, read_checkpoint(backbone).params.backbone)

    succeeds(capfd, "convert", ours, back, "--format", VOCABULARY)
    assert back.read_bytes() == words.read_bytes()
    # Unless asked for the words alone, the whole model goes.
    assert convert(ours, tmp_path / "whole.pth").target == "reference"


def test_what_does_not_belong_together(files, capfd, tmp_path):
    words, backbone = files
    wide = tmp_path / "wide.pt"
    torch.save(torch.ones(3, 96), wide)
    with pytest.raises(InputError, match=r"wide.pt: found .* shape .3, 96., expected .words, 64."):
        read_vocabulary(wide, backbone)
    with pytest.raises(InputError, match=r"AnyLocConfig.layer: found 5, expected -2 to 1"):
        read_vocabulary(words, backbone, {"layer": 5})
    with pytest.raises(InputError, match=r"one tensor by itself, of shape .3, 64. .*--backbone"):
        read_checkpoint(words)
    command = ("convert", words, tmp_path / "x.safetensors", "--layer", 1)
    fails(capfd, *command, words=("--layer: found without --backbone, expected both",))
    assert not (tmp_path / "x.safetensors").exists()
