"""torchvision's ResNet and VGG-16, by its names, against the torch reference."""

import dataclasses
import pathlib

import jax
import numpy as np
import pytest
import torch

from crisalad_jax import describe, init_crisalad
from crisalad_jax.checkpoints.formats import infer, public_shapes
from crisalad_jax.checkpoints.public import convert, read_backbone, read_checkpoint
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.backbones.vgg import VggConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.utils.errors import InputError
from parity.reference.model import Crisalad
from tests.random_checkpoints import blank

CHILDREN = {"0": "conv1", "1": "bn1"} | {str(4 + i): f"layer{1 + i}" for i in range(4)}
"""torchvision's names of a ResNet's children, by their places."""
COUNTS = "num_batches_tracked"
MODEL = ModelConfig(
    image_size=(64, 96),
    backbone=ResNetConfig(layers=18),
    aggregator="gem",
    cross_image="none",
)


def resnet() -> tuple[Crisalad, dict[str, torch.Tensor]]:
    """The reference, and its weights as torchvision stores them."""
    torch.manual_seed(0)
    model = Crisalad(MODEL).eval()
    state = {"fc.weight": torch.randn(1000, 512), "fc.bias": torch.randn(1000)}
    for name, array in model.backbone.state_dict().items():
        place, _, rest = name.partition(".")
        state[f"{CHILDREN[place]}.{rest}"] = array
    return model, state


def test_a_resnet_and_back(tmp_path: pathlib.Path) -> None:
    model, state = resnet()
    # torchvision's ResNet-18 has 122 tensors; its older files had 102, without counts.
    assert len(state) == 122
    state = {name: array for name, array in state.items() if not name.endswith(COUNTS)}
    assert len(state) == 102
    torch.save(state, tmp_path / "resnet18.pth")
    read = read_checkpoint(tmp_path / "resnet18.pth")
    assert read.format == "torchvision-resnet"
    images = np.random.default_rng(0).normal(size=(2, 64, 96, 3)).astype(np.float32)
    with torch.no_grad():
        expected = model(torch.from_numpy(images).permute(0, 3, 1, 2))
    # Unit vectors, after some thirty layers in float32.
    np.testing.assert_allclose(describe(read.params, images, read.config), expected, atol=1e-6)
    convert(tmp_path / "resnet18.pth", tmp_path / "ours.safetensors")
    convert(tmp_path / "ours.safetensors", tmp_path / "back.pth", read.format)
    back = torch.load(tmp_path / "back.pth", weights_only=True)
    assert {name for name in back if not name.endswith(COUNTS)} == state.keys()
    for name, array in state.items():
        assert torch.equal(back[name], array), name


def test_training_starts_from_the_first_stages(tmp_path: pathlib.Path) -> None:
    _, state = resnet()
    torch.save(state, tmp_path / "resnet18.pth")
    config = ResNetConfig(layers=18, stages=3)
    fresh = init_crisalad(jax.random.key(0), dataclasses.replace(MODEL, backbone=config)).backbone
    found = read_backbone(tmp_path / "resnet18.pth", config, fresh)
    assert jax.tree.structure(found) == jax.tree.structure(fresh)
    last = found.blocks[2].layers[1].convs[1].conv.weight
    expected = state["layer3.1.conv2.weight"].numpy().transpose(2, 3, 1, 0)
    np.testing.assert_array_equal(last, expected)
    with pytest.raises(
        InputError, match=r"differs from .*: backbone.layers: found 18, expected 50"
    ):
        read_backbone(tmp_path / "resnet18.pth", ResNetConfig(), None)


def test_vgg_16s_names_and_shapes() -> None:
    config = dataclasses.replace(MODEL, backbone=VggConfig())
    shapes = public_shapes(config, "torchvision-vgg")
    # 13 convolutions and 3 linear layers; 138,357,544 parameters, as torchvision's page says.
    assert len(shapes) == 32
    assert sum(int(np.prod(shape)) for shape in shapes.values()) == 138_357_544
    layout, found = infer(blank(shapes), source="vgg16.pth")
    assert (layout, found.backbone) == ("torchvision-vgg", VggConfig())
