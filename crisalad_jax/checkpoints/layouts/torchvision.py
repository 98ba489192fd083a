"""The layouts of torchvision's ResNet and VGG-16, from whose ImageNet weights training starts.

As a model they are described by the generalised mean of their last features, with an exponent of 3.
"""

import functools

import numpy as np

from crisalad_jax.checkpoints.layouts.base import Layout, Lines, State, register_layout
from crisalad_jax.checkpoints.layouts.cnn import Names, accepts_head_over, cnn_lines, infer_cnn
from crisalad_jax.checkpoints.layouts.forms import Absent, Extra
from crisalad_jax.nn.aggregators.gem import START, GemConfig
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.backbones.stages import StagedBackbone
from crisalad_jax.nn.backbones.vgg import VggConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig

_CLASSES = 1000
_RESNET, _VGG = Names("", numbered=False), Names("features.", numbered=True)
_VGG_CLASSIFIER = {"0": (4096, 512 * 7 * 7), "3": (4096, 4096), "6": (_CLASSES, 4096)}
"""Shapes of the linear layers, by their numbers."""


def _accepts(config: ModelConfig, kind: type[StagedBackbone]) -> str | None:
    backbone = config.backbone
    whole = not isinstance(backbone, ResNetConfig) or backbone.stages == 4
    fits = whole and accepts_head_over(config, "gem", (kind,)) is None
    return None if fits else f"aggregator gem, backbone {kind.part_name} of all stages, no encoder"


def _extra(name: str, shape: tuple[int, ...]) -> Lines:
    yield Extra(f"classifier.{name}.weight", f"{name}.weight", shape, np.float32)
    yield Extra(f"classifier.{name}.bias", f"{name}.bias", shape[:1], np.float32)


def _resnet_lines(config: ModelConfig, *, counts: bool) -> Lines:
    yield from cnn_lines(config.backbone, _RESNET, counts=counts)
    yield from _extra("fc", (_CLASSES, config.backbone.dim))
    yield Absent("aggregator.p", START)


def _vgg_lines(config: ModelConfig) -> Lines:
    yield from cnn_lines(config.backbone, _VGG)
    for number, shape in _VGG_CLASSIFIER.items():
        yield from _extra(f"classifier.{number}", shape)
    yield Absent("aggregator.p", START)


def _infer(state: State, names: Names) -> ModelConfig:
    return ModelConfig(
        backbone=infer_cnn(state, names),
        aggregator=GemConfig(),
        cross_image=CrossImageConfig(layers=0),
    )


for _name, _holds, _counts in (
    ("torchvision-resnet", "torchvision's ResNet .pth", True),
    ("torchvision-resnet-old", "torchvision's older ResNet .pth, without counts of batches", False),
):
    register_layout(
        Layout(
            _name,
            _holds,
            functools.partial(_accepts, kind=ResNetConfig),
            functools.partial(_resnet_lines, counts=_counts),
            lambda state: "conv1.weight" in state and "fc.weight" in state,
            functools.partial(_infer, names=_RESNET),
        )
    )
register_layout(
    Layout(
        "torchvision-vgg",
        "torchvision's VGG-16 .pth",
        functools.partial(_accepts, kind=VggConfig),
        _vgg_lines,
        lambda state: "features.0.weight" in state and "classifier.0.weight" in state,
        functools.partial(_infer, names=_VGG),
    )
)
