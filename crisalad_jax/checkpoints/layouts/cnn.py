"""The names of ResNet and VGG in public checkpoints: torchvision's, or numbers in its order."""

import math
from collections.abc import Iterator
from typing import NamedTuple

from crisalad_jax.checkpoints.layouts.base import Lines, Reader, State
from crisalad_jax.checkpoints.layouts.forms import CONV, affine, batch_norm_lines
from crisalad_jax.nn.backbones.base import Backbone
from crisalad_jax.nn.backbones.resnet import BLOCKS, STEM_SIDE, ResNetConfig
from crisalad_jax.nn.backbones.vgg import WIDTHS, VggConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.utils.errors import InputError


class Names(NamedTuple):
    """How the files of a family name a backbone's layers."""

    prefix: str
    numbered: bool
    """Whether a ResNet's layers are numbers, as in a `torch.nn.Sequential` of torchvision's; a
    VGG's always are."""

    def stem(self, part: str) -> str:
        """Return the name of a ResNet's first convolution, "conv1", or of its norm, "bn1"."""
        return self.prefix + (str(("conv1", "bn1").index(part)) if self.numbered else part)

    def stage(self, number: int) -> str:
        """Return the name of a ResNet's stage, from 0; a ReLU and a maximum come before it."""
        return self.prefix + (str(4 + number) if self.numbered else f"layer{1 + number}")

    @property
    def first(self) -> str:
        """Name of the first convolution's weights."""
        return f"{self.stem('conv1')}.weight"


def cnn_lines(config: Backbone, names: Names, *, counts: bool = True) -> Lines:
    """Yield the table of a ResNet or a VGG; see `batch_norm_lines` for `counts`."""
    if isinstance(config, VggConfig):
        yield from _vgg_lines(names)
    else:
        assert isinstance(config, ResNetConfig)
        yield from _resnet_lines(config, names, counts)


def _vgg_lines(names: Names) -> Lines:
    for (stage, layer), number in vgg_numbers():
        ours = f"backbone.blocks.{stage}.layers.{layer}"
        yield from affine(ours, f"{names.prefix}{number}", CONV)


def vgg_numbers() -> Iterator[tuple[tuple[int, int], int]]:
    """Yield each convolution's stage and place in it, and its number in torchvision's VGG-16."""
    number = 0
    for stage, widths in enumerate(WIDTHS):
        for layer in range(len(widths)):
            yield (stage, layer), number
            number += 2  # a ReLU follows
        number += 1  # a maximum follows


def _resnet_lines(config: ResNetConfig, names: Names, counts: bool) -> Lines:
    yield from affine("backbone.stem.conv", names.stem("conv1"), CONV, bias=False)
    yield from batch_norm_lines("backbone.stem.norm", names.stem("bn1"), counts=counts)
    width = config.widths(0)[0]
    for stage in range(config.stages):
        for i in range(BLOCKS[config.layers][stage]):
            ours = f"backbone.blocks.{stage}.layers.{i}"
            theirs = f"{names.stage(stage)}.{i}"
            widths = config.widths(stage)
            for j in range(len(widths)):
                yield from affine(
                    f"{ours}.convs.{j}.conv", f"{theirs}.conv{1 + j}", CONV, bias=False
                )
                norm = f"{theirs}.bn{1 + j}"
                yield from batch_norm_lines(f"{ours}.convs.{j}.norm", norm, counts=counts)
            if width != widths[-1]:
                shortcut = f"{theirs}.downsample"
                yield from affine(f"{ours}.shortcut.conv", f"{shortcut}.0", CONV, bias=False)
                norm = f"{shortcut}.1"
                yield from batch_norm_lines(f"{ours}.shortcut.norm", norm, counts=counts)
            width = widths[-1]


def infer_cnn(state: State, names: Names) -> Backbone:
    """Infer the backbone from names and shapes.

    Raises:
        InputError: it is neither VGG-16 nor one of the ResNets that `ResNetConfig` has.
    """
    read = Reader(state)
    if read.size(names.first, 2) != STEM_SIDE:
        return VggConfig()
    stages = next(i for i in range(5) if i == 4 or read.count(f"{names.stage(i)}.") == 0)
    found = tuple(read.count(f"{names.stage(i)}.") for i in range(stages))
    basic = f"{names.stage(0)}.0.conv3.weight" not in state
    for layers, blocks in BLOCKS.items():
        if found == blocks[:stages] and basic == (layers == 18):
            return ResNetConfig(layers=layers, stages=stages)
    of = "two" if basic else "three"
    raise InputError(
        f"found a ResNet with {found} blocks of {of} convolutions, expected one of "
        f"{', '.join(f'ResNet-{layers} {blocks}' for layers, blocks in BLOCKS.items())}"
    )


def accepts_head_over(
    config: ModelConfig,
    aggregator: str,
    backbones: tuple[type[Backbone], ...],
    *,
    projection: bool = False,
) -> str | None:
    """Accept this aggregator over one of these backbones; else return what is expected in words."""
    fits = (
        isinstance(config.backbone, backbones)
        and config.aggregator.part_name == aggregator
        and not config.cross_image.layers
        and bool(config.projection.dim) == projection
    )
    names = " or ".join(kind.part_name for kind in backbones)
    expected = (
        f"aggregator {aggregator}, backbone {names}, no encoder" + ", a projection" * projection
    )
    return None if fits else expected


def square_image(state: State, name: str, patch_size: int) -> tuple[int, int]:
    """Return the size in pixels of the square images whose positions a linear layer takes.

    Raises:
        InputError: the number of positions is no square.
    """
    positions = Reader(state).size(name, 1)
    side = math.isqrt(positions)
    if side**2 != positions:
        raise InputError(f"{name} found for {positions} positions, expected a square number")
    return side * patch_size, side * patch_size
