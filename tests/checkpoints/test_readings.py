"""Files as training tools write them: wrappers' names, objects with the weights, DINOv2 trainings.

torch itself writes them, most of a tiny random ViT of the reference. Parameters are those of the
plain file, bit for bit, and outputs those of the torch module.
"""

import argparse
import collections
import enum
import pathlib
import subprocess
import warnings
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import torch
from torch import nn

from crisalad_jax.checkpoints.public import Checkpoint, convert, read_backbone, read_checkpoint
from crisalad_jax.nn.backbones.base import FeatureSpec
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note
from parity.reference.vit import ViT
from tests.conftest import assert_equal
from tests.random_checkpoints import (
    bare_vit,
    fewer_blocks,
    narrow,
    nested,
    public_layout,
    random_state,
    save,
)

VIT = bare_vit(depth=4).backbone
PUBLIC = {"dino-salad": "dino_salad", "cricavpr": "CricaVPR"}


def network(seed: int = 0) -> ViT:
    """A tiny random network of the reference, whose biases and gains are random too."""
    torch.manual_seed(seed)
    made = ViT(VIT)
    for parameter in made.parameters():
        nn.init.normal_(parameter, std=0.1)
    return made.eval()


def read_quietly(path: pathlib.Path) -> Checkpoint:
    with warnings.catch_warnings():
        warnings.simplefilter("error", Note)
        return read_checkpoint(path)


class Lightning(nn.Module):
    """Any module that holds its network in a field."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model


WRAPPED = {
    "compiled": lambda net: torch.compile(net),
    "parallel, compiled": lambda net: torch.compile(nn.DataParallel(net)),
    "Lightning": Lightning,
    "all of it twice": lambda net: torch.compile(
        nn.DataParallel(Lightning(torch.compile(nn.DataParallel(Lightning(net)))))
    ),
}


@pytest.fixture
def plain(tmp_path: pathlib.Path) -> Checkpoint:
    """The parameters of `network()` as torch's documentation has them saved."""
    return read_quietly(save(tmp_path / "plain.pth", network().state_dict()))


@pytest.mark.parametrize("kind", WRAPPED)
def test_what_wraps_a_network_leaves_no_name(
    tmp_path: pathlib.Path, plain: Checkpoint, kind: str
) -> None:
    net = network()
    state = WRAPPED[kind](net).state_dict()
    assert state.keys().isdisjoint(net.state_dict())
    for name, content in (("bare.pth", state), ("under.ckpt", {"state_dict": state, "epoch": 3})):
        found = read_quietly(save(tmp_path / name, content))
        assert (found.format, found.config) == ("dinov2", plain.config)
        assert_equal(found.params, plain.params)
    assert_same_outputs(found, net)


def assert_same_outputs(found: Checkpoint, net: ViT) -> None:
    images = np.random.default_rng(0).normal(size=(2, 42, 28, 3)).astype(np.float32)
    request = FeatureSpec(class_token=True)
    ours, _ = found.config.backbone.apply(
        found.params.backbone, jnp.asarray(images), request, remat="none"
    )
    with torch.no_grad():
        theirs = net(torch.from_numpy(images).permute(0, 3, 1, 2))
    # Both are float32, after a layer norm: numbers of size 1 after four blocks of rounding.
    np.testing.assert_allclose(ours.class_token, theirs.class_token, atol=2e-5)
    np.testing.assert_allclose(ours.patches, theirs.patches.flatten(2).mT, atol=2e-5)


@pytest.mark.parametrize("put", ["module._orig_mod.module.", "model._orig_mod."])
@pytest.mark.parametrize("name", PUBLIC)
def test_other_layouts_are_read_so(tmp_path: pathlib.Path, name: str, put: str) -> None:
    """In front of all names, and after the first part of each, as of a compiled submodule."""
    by = 4 if name == "cricavpr" else 12
    content = nested(random_state(fewer_blocks(narrow(public_layout(PUBLIC[name]), by), 2)))
    state = content.get("model_state_dict", content)
    plain = read_quietly(save(tmp_path / "plain.pth", content))
    assert plain.format == name
    front = {put + key: array for key, array in state.items()}
    within = {key.replace(".", "._orig_mod.", 1): array for key, array in state.items()}
    for number, each in enumerate((front, within)):
        found = read_quietly(save(tmp_path / f"{number}.pth", each))
        # Indoor-VPR publishes SALAD within `model`, for another image size: its layout comes first.
        assert found.format in (name, "salad-indoor")
        assert_equal(found.params, plain.params)


def test_a_name_stands_for_one_tensor(tmp_path: pathlib.Path) -> None:
    state = network().state_dict()
    both = state | {f"module.{name}": array for name, array in network(1).state_dict().items()}
    with pytest.raises(InputError, match=r"two\.pth: .* module\.blocks\.0\..* unknown"):
        read_checkpoint(save(tmp_path / "two.pth", both))


# Objects with the weights


class Kind(enum.Enum):
    SMALL = 1


class Config:
    """As OmegaConf's containers: an object whose content is a dictionary of such objects."""

    def __init__(self, **content: Any) -> None:
        self._content = content
        self._flags = None


class Beside(dict):
    """As EasyDict, CfgNode and AttributeDict: a dictionary with attributes."""

    def __init__(self) -> None:
        super().__init__(lr=0.1)
        self.frozen = True


OBJECTS = {
    "Namespace": argparse.Namespace(lr=0.1, out=pathlib.PosixPath("/tmp")),
    "PosixPath": pathlib.PosixPath("/tmp/run"),
    "defaultdict": collections.defaultdict(list, {"loss": [1.0]}),
    "DictConfig": Config(optim=Config(lr=0.1), kind=Kind.SMALL),
    "a dictionary with attributes": Beside(),
}


@pytest.mark.parametrize("kind", OBJECTS)
def test_objects_with_the_weights_are_not_made(
    tmp_path: pathlib.Path, plain: Checkpoint, kind: str
) -> None:
    state = network().state_dict()
    content = {"hyper_parameters": OBJECTS[kind], "state_dict": state, "epoch": 3}
    assert_equal(read_quietly(save(tmp_path / "file.ckpt", content)).params, plain.params)


def test_weights_in_a_defaultdict_are_weights(tmp_path: pathlib.Path, plain: Checkpoint) -> None:
    state = collections.defaultdict(list, network().state_dict())
    assert_equal(read_quietly(save(tmp_path / "d.pth", state)).params, plain.params)


class Runs:
    """What an attacker puts beside weights: unpickling it would run a command."""

    def __init__(self, path: pathlib.Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return subprocess.check_call, (["touch", str(self.path)],)


def test_nothing_of_a_file_is_run(tmp_path: pathlib.Path) -> None:
    content = {"args": Runs(tmp_path / "made"), "model": network().state_dict()}
    read_quietly(save(tmp_path / "file.pth", content))
    assert not (tmp_path / "made").exists()


HOW = r"torch\.save\(model\.state_dict\(\), FILE\) writes a file of only the weights"


@pytest.mark.parametrize("under", [None, "model"])
def test_a_whole_module_is_named_with_what_to_do(tmp_path: pathlib.Path, under: str | None) -> None:
    net = network()
    path = save(tmp_path / "whole.pth", net if under is None else {under: net})
    with pytest.raises(InputError, match=rf"found parity\.reference\.vit\.ViT, expected .*{HOW}$"):
        read_checkpoint(path)


class Slots:
    """An object without a dictionary of its attributes."""

    __slots__ = ("value",)

    def __init__(self) -> None:
        self.value = 1


@pytest.mark.parametrize(
    ("given", "name"),
    [(Slots(), r"test_readings\.Slots"), ({pathlib.PosixPath("/a")}, r"pathlib.*\.PosixPath")],
)
def test_an_object_that_has_no_stand_in_is_named_with_what_to_do(
    tmp_path: pathlib.Path, given: Any, name: str
) -> None:
    path = save(tmp_path / "file.pth", {"args": given, "model": network().state_dict()})
    with pytest.raises(InputError, match=rf"{name} with the weights: {HOW}"):
        read_checkpoint(path)


# One's own training of DINOv2


def heads(prefix: str) -> dict[str, torch.Tensor]:
    """The names of a head of DINOv2's training, in small."""
    made = {
        "mlp.0.weight": (8, 64),
        "mlp.0.bias": (8,),
        "last_layer.weight_g": (16, 1),
        "last_layer.weight_v": (16, 8),
    }
    return {f"{prefix}{name}": torch.randn(shape) for name, shape in made.items()}


def chunked(net: ViT, prefix: str, chunks: int) -> dict[str, torch.Tensor]:
    """Blocks in chunks, as `block_chunks` of the public code names them: blocks count on."""
    named = {}
    for name, array in net.state_dict().items():
        kind, *rest = name.split(".")
        if kind == "blocks":
            rest.insert(0, str(int(rest[0]) // (VIT.depth // chunks)))
        named[".".join([prefix.removesuffix("."), kind, *rest])] = array
    return named


def training(kind: str, net: ViT) -> tuple[dict[str, Any], int]:
    """A file, and how many tensors a note says are left out of it."""
    plain = {f"backbone.{name}": array for name, array in net.state_dict().items()}
    both = heads("dino_head.") | heads("ibot_head.")
    if kind == "the teacher":
        return {"teacher": chunked(net, "backbone.", 2) | both}, 8
    if kind == "without a mask token":
        state = {n: x for n, x in plain.items() if n != "backbone.mask_token"}
        return {"teacher": state | heads("dino_head.")}, 4
    other = {f"student.{n}": x for n, x in chunked(network(1), "backbone.", 4).items()}
    state = other | {f"student.{n}": x for n, x in both.items()}
    wrapped = "_fsdp_wrapped_module." if kind == "wrapped by FSDP" else ""
    state |= {
        f"teacher.{name.replace('backbone.', f'backbone.{wrapped}')}": array
        for name, array in (chunked(net, "backbone.", 4) | both).items()
    }
    state |= {"dino_loss.center": torch.zeros(1, 16), "ibot_patch_loss.center": torch.zeros(16)}
    count = len(other) + 2 * len(both) + 2
    content = {"model": state, "optimizer": {"state": {}}, "iteration": 9}
    return content, count


@pytest.mark.parametrize(
    "kind", ["the teacher", "without a mask token", "the whole training", "wrapped by FSDP"]
)
def test_the_teacher_of_a_training_is_a_backbone(
    tmp_path: pathlib.Path, plain: Checkpoint, kind: str
) -> None:
    net = network()
    content, left_out = training(kind, net)
    path = save(tmp_path / "training.pth", content)
    words = rf"under (teacher\.)?backbone, and left out {left_out} other tensors$"
    with pytest.warns(Note, match=words) as notes:
        found = read_checkpoint(path)
    assert len(notes) == 1
    assert (found.format, found.config) == ("dinov2", plain.config)
    assert_equal(found.params, plain.params)
    assert_same_outputs(found, net)
    with pytest.warns(Note):
        assert_equal(read_backbone(path, VIT, plain.params.backbone), plain.params.backbone)


def test_a_file_without_a_mask_token_goes_back_with_a_blank_one(tmp_path: pathlib.Path) -> None:
    state = network().state_dict()
    del state["mask_token"]
    convert(save(tmp_path / "a.pth", state), tmp_path / "ours.safetensors")
    convert(tmp_path / "ours.safetensors", tmp_path / "back.pth")
    back = torch.load(tmp_path / "back.pth")
    assert not back.pop("mask_token").any()
    assert all(torch.equal(array, state[name]) for name, array in back.items())
