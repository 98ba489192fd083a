"""How public checkpoints name the convolutional backbones: ResNet, VGG and TransVPR's network."""

import math
from collections.abc import Iterator
from typing import NamedTuple

from crisalad_jax.checkpoints.formats.format import Reader, State
from crisalad_jax.checkpoints.formats.forms import (
    CLASS_TOKEN,
    CONV,
    LINEAR,
    SAME,
    Entry,
    Lines,
    affine,
    affines,
    batch_norm_lines,
)
from crisalad_jax.nn.backbones.base import Backbone
from crisalad_jax.nn.backbones.resnet import BLOCKS, STEM_SIDE, ResNetConfig
from crisalad_jax.nn.backbones.transvpr import WIDTHS as TRANSVPR_WIDTHS
from crisalad_jax.nn.backbones.transvpr import TransVprNetConfig
from crisalad_jax.nn.backbones.vgg import WIDTHS, VggConfig
from crisalad_jax.utils.errors import InputError

_HEAD_WIDTH = 64
"""Width of an attention head of TransVPR, as published; no shape shows the number of heads."""


class CnnNames(NamedTuple):
    """How files name a ResNet's or a VGG's layers: as torchvision does, or by numbers."""

    prefix: str
    numbered: bool
    """Whether a ResNet's layers are numbers, as in a `torch.nn.Sequential` of torchvision's; a
    VGG's always are."""
    kinds: tuple[type[Backbone], ...]

    def _stem(self, part: str) -> str:
        """Return the name of a ResNet's first convolution, "conv1", or of its norm, "bn1"."""
        return self.prefix + (str(("conv1", "bn1").index(part)) if self.numbered else part)

    def _stage(self, number: int) -> str:
        """Return the name of a ResNet's stage, from 0; a ReLU and a maximum come before it."""
        return self.prefix + (str(4 + number) if self.numbered else f"layer{1 + number}")

    @property
    def marks(self) -> tuple[str, ...]:
        """Name of the first convolution's weights."""
        return (f"{self._stem('conv1')}.weight",)

    def lines(self, config: Backbone) -> Lines:
        """Yield the table, in the public order."""
        if isinstance(config, ResNetConfig):
            yield from self._resnet_lines(config)
            return
        for (stage, layer), number in vgg_numbers():
            ours = f"backbone.blocks.{stage}.layers.{layer}"
            yield from affine(ours, f"{self.prefix}{number}", CONV)

    def _resnet_lines(self, config: ResNetConfig) -> Lines:
        yield from self._normed("backbone.stem", self._stem("conv1"), self._stem("bn1"))
        width = config.widths(0)[0]
        for stage in range(config.stages):
            widths = config.widths(stage)
            for i in range(BLOCKS[config.layers][stage]):
                ours = f"backbone.blocks.{stage}.layers.{i}"
                theirs = f"{self._stage(stage)}.{i}"
                for j in range(len(widths)):
                    names = f"{theirs}.conv{1 + j}", f"{theirs}.bn{1 + j}"
                    yield from self._normed(f"{ours}.convs.{j}", *names)
                if width != widths[-1]:
                    names = f"{theirs}.downsample.0", f"{theirs}.downsample.1"
                    yield from self._normed(f"{ours}.shortcut", *names)
                width = widths[-1]

    def _normed(self, ours: str, conv: str, norm: str) -> Lines:
        """Yield a convolution and its batch norm."""
        yield from affine(f"{ours}.conv", conv, CONV, bias=False)
        yield from batch_norm_lines(f"{ours}.norm", norm)

    def infer(self, state: State) -> Backbone:
        """Infer the backbone from names and shapes.

        Raises:
            InputError: it is none of `kinds`, or a ResNet that `ResNetConfig` lacks.
        """
        read = Reader(state)
        is_vgg = read.size(self.marks[0], 2) != STEM_SIDE
        kind = VggConfig if is_vgg else ResNetConfig
        if kind not in self.kinds:
            wanted = " or ".join(each.part_name for each in self.kinds)
            raise InputError(f"found backbone {kind.part_name}, expected {wanted}")
        return VggConfig() if is_vgg else self._resnet(read)

    def _resnet(self, read: Reader) -> ResNetConfig:
        counts = [read.count(f"{self._stage(i)}.") for i in range(4)]
        stages = counts.index(0) if 0 in counts else 4
        found, basic = tuple(counts[:stages]), not read.has(f"{self._stage(0)}.0.conv3.weight")
        for layers, blocks in BLOCKS.items():
            if found == blocks[:stages] and basic == (layers == 18):
                return ResNetConfig(layers=layers, stages=stages)
        of = "two" if basic else "three"
        raise InputError(
            f"found a ResNet with {found} blocks of {of} convolutions, expected one of "
            f"{', '.join(f'ResNet-{layers} {blocks}' for layers, blocks in BLOCKS.items())}"
        )


def vgg_numbers() -> Iterator[tuple[tuple[int, int], int]]:
    """Yield each convolution's stage and place in it, and its number in torchvision's VGG-16."""
    number = 0
    for stage, widths in enumerate(WIDTHS):
        for layer in range(len(widths)):
            yield (stage, layer), number
            number += 2  # a ReLU follows
        number += 1  # a maximum follows


class TransVprNames(NamedTuple):
    """How RuotongWANG/TransVPR-model-implementation names its backbone's layers."""

    kinds: tuple[type[Backbone], ...] = (TransVprNetConfig,)
    marks: tuple[str, ...] = ("transformer.class_emb",)

    def lines(self, config: TransVprNetConfig) -> Lines:
        """Yield the table, in the public order."""
        levels = range(len(TRANSVPR_WIDTHS))
        for i in levels:
            yield from affine(f"backbone.convs.{i}.conv", f"conv{i + 1}.0", CONV)
            yield from batch_norm_lines(f"backbone.convs.{i}.norm", f"conv{i + 1}.1")
        for i in levels:
            yield from affine(f"backbone.tokenizers.{i}", f"tokenizer{i + 1}.conv_layer", CONV)
        yield Entry(("backbone.cls_token",), ("transformer.class_emb",), CLASS_TOKEN)
        for i in range(config.depth):
            ours, theirs = f"backbone.blocks.{i}.", f"transformer.blocks.{i}."
            yield from affine(f"{ours}pre_norm", f"{theirs}pre_norm", SAME)
            qkv = "self_attn.qkv"
            yield from affine(f"{ours}{qkv}", f"{theirs}{qkv}", LINEAR, bias=False)
            layers = {"linear1": LINEAR, "norm1": SAME, "linear2": LINEAR}
            yield from affines(ours, theirs, {"self_attn.proj": LINEAR} | layers)
        yield from affine("backbone.norm", "transformer.norm", SAME)

    def infer(self, state: State) -> TransVprNetConfig:
        """Infer the backbone from names and shapes."""
        read = Reader(state, "transformer.")
        dim = read.size("class_emb", 2)
        return TransVprNetConfig(
            dim=dim,
            depth=read.count("blocks."),
            heads=max(1, dim // _HEAD_WIDTH),
            hidden=read.size("blocks.0.linear1.weight", 0),
        )


def square_image(state: State, name: str, patch_size: int) -> tuple[int, int]:
    """Return the size in pixels of the square images whose positions a linear layer takes.

    Raises:
        InputError: the number of positions is no square.
    """
    positions = Reader(state).size(name, 1)
    length = math.isqrt(positions)
    if length**2 != positions:
        raise InputError(f"{name} found for {positions} positions, expected a square number")
    return length * patch_size, length * patch_size
