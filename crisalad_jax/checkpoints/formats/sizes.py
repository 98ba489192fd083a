"""Infer configurations from the names and shapes of a public checkpoint."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np

from crisalad_jax.checkpoints.formats.rows import Rows, first_names
from crisalad_jax.nn.adapters import ADAPTERS, Adapter
from crisalad_jax.nn.backbones.base import Backbone
from crisalad_jax.nn.backbones.dinov3 import rotary_periods
from crisalad_jax.nn.backbones.resnet import BLOCKS, STEM_SIDE, ResNetConfig
from crisalad_jax.nn.backbones.tetra import TetraVitConfig
from crisalad_jax.nn.backbones.transvpr import TransVprNetConfig
from crisalad_jax.nn.backbones.vgg import VggConfig
from crisalad_jax.nn.backbones.vit import VisionTransformer
from crisalad_jax.nn.cross_image import (
    CrossImage,
    CrossImageConfig,
    NoCrossImage,
    SageCrossImageConfig,
)
from crisalad_jax.utils.errors import InputError

_V = TypeVar("_V", bound=VisionTransformer)
State = Mapping[str, np.ndarray]
_HEAD_WIDTH = 64
"""Width of an attention head in every DINOv2 and TransVPR; shapes do not show the head count."""
_SIDE_ALPHA = 0.5
"""Weight of EDTformer's adapters, which shapes do not show."""
_PERIODS = "rope_embed.periods"
_ENCODER_HEADS = 16
"""Number of heads of the published cross-image encoder, which shapes do not show."""


class Reader(NamedTuple):
    """A reader of the shapes of a checkpoint's arrays, whose names all start with a prefix."""

    state: State
    prefix: str = ""

    def size(self, name: str, axis: int, default: int | None = None) -> int:
        """Return the size of an array's axis, or `default` if there is no such array.

        Raises:
            InputError: there is neither the array nor a default, or the axis is absent or empty.
        """
        if default is not None and not self.has(name):
            return default
        whole = self.prefix + name
        shape = self.state[whole].shape if whole in self.state else ()
        if len(shape) <= axis or not shape[axis]:
            found = f"{whole} of shape {shape}" if whole in self.state else f"no {whole}"
            raise InputError(
                f"found {found}, expected an array of more than {axis} axes, none of them empty"
            )
        return shape[axis]

    def has(self, name: str) -> bool:
        """Return whether an array of this name exists."""
        return self.prefix + name in self.state

    def count(self, name: str) -> int:
        """Count the consecutive numbers from 0 that follow `name`, such as those of "blocks."."""
        heads = {key[: key.find(".", len(self.prefix + name))] for key in self.state}
        return next(i for i in range(len(heads) + 1) if f"{self.prefix}{name}{i}" not in heads)

    def read(self, where: str) -> int:
        """Read a size at "NAME AXIS" or "NAME AXIS?" (0 if absent), or the count at "NAME#"."""
        name, _, axis = where.partition(" ")
        if not axis:
            return self.count(name.removesuffix("#"))
        return self.size(name, int(axis.removesuffix("?")), 0 if axis.endswith("?") else None)


def infer_backbone(kinds: tuple[type[Any], ...], rows: Rows, read: Reader) -> Backbone:
    """Infer the configuration of a backbone, one of `kinds`, from the names and shapes in `read`.

    Raises:
        InputError: no configuration has the sizes found.
    """
    theirs = first_names(rows)
    if issubclass(kinds[0], VisionTransformer):
        return _infer_vit(kinds[0], theirs, read)
    if kinds[0] is TransVprNetConfig:
        return _infer_transvpr(read)
    if kinds[0] is TetraVitConfig:
        return _infer_tetra(read)
    stem = next(iter(theirs.values()))
    is_vgg = ResNetConfig not in kinds or (VggConfig in kinds and read.size(stem, 2) != STEM_SIDE)
    return VggConfig() if is_vgg else _infer_resnet(theirs, read)


def _infer_vit(kind: type[_V], theirs: dict[str, str], read: Reader) -> _V:
    dim = read.size(theirs["cls_token"], 2)
    gated = read.has(theirs["blocks.0.mlp.w12.weight"])
    hidden = read.size(theirs[f"blocks.0.mlp.{'w3' if gated else 'fc2'}.weight"], 1)
    width = _check_periods(read) if _PERIODS in theirs else _HEAD_WIDTH
    if dim % width:
        raise InputError(f"found a backbone of width {dim}, expected a multiple of {width}")
    fields: dict[str, Any] = {}
    if "pos_embed_cls" in theirs:
        positions = read.size(theirs["pos_embed_cls"], 1)
        words = f"found {positions} position embeddings, expected 1 and a square number"
        fields["position_grid"] = square_side(positions - 1, words)
    config = kind(
        dim=dim,
        depth=read.count(theirs["blocks.0.ls1"].partition("0.")[0]),
        heads=dim // width,
        ffn="swiglu" if gated else "mlp",
        registers=read.size(theirs["register_tokens"], 1, 0),
        adapter=_infer_adapter(read, dim),
        **fields,
    )
    # SwiGLU's width is two thirds of the ratio's: try DINOv2's ratio of 4 first.
    for ratio in (4.0, 1.5 * hidden / dim) if gated else (hidden / dim,):
        found = dataclasses.replace(config, mlp_ratio=ratio)
        if found.hidden == hidden:
            return found
    raise InputError(f"found a feed-forward width of {hidden}, expected a multiple of 8 for SwiGLU")


def _check_periods(read: Reader) -> int:
    """Return the width of a head, and check that its periods are DINOv3's."""
    head_dim = 4 * read.size(_PERIODS, 0)
    expected, found = rotary_periods(head_dim), read.state[read.prefix + _PERIODS]
    # Half a step of bfloat16, in which the public files store them.
    if not np.allclose(found, expected, rtol=2.0**-8, atol=0):
        raise InputError(f"{_PERIODS} found {found.tolist()}, expected about {expected.tolist()}")
    return head_dim


def square_side(area: int, otherwise: str) -> int:
    """Return the side of a square grid of `area` cells.

    Raises:
        InputError: the area is not a square number above 0; the message is `otherwise`.
    """
    length = math.isqrt(area)
    if length**2 != area or not length:
        raise InputError(otherwise)
    return length


def _infer_adapter(read: Reader, width: int) -> Adapter:
    """Infer the adapters and their sizes; their weight (alpha) is the published one."""
    if count := read.count("gpn_norms."):
        hidden = read.size("gpn_norms.0.projection.0.weight", 0)
        return ADAPTERS.make("dynamic-power", last=count, hidden=hidden)
    in_block = "blocks.0.adapter"
    names = {"side": "adapters.0", "serial-parallel": f"{in_block}1", "mlp": in_block}
    has = [name for name, start in names.items() if read.has(f"{start}.D_fc1.weight")]
    if not has:
        return ADAPTERS.make("none")
    name = has[0]
    fields: dict[str, Any] = {"bottleneck": read.size(f"{names[name]}.D_fc1.weight", 0) / width}
    if read.has("adapters.0.branch1.conv.weight"):
        name, last = "side-multi-resolution", read.count("adapters.")
        fields["last"] = last if last < read.count("blocks.") else None
        fields["paths"] = 2 if read.has("adapters_hashing.0.D_fc1.weight") else 1
    elif name == "side":
        fields["alpha"] = _SIDE_ALPHA
    elif read.has(f"{in_block}.branch1.conv.weight"):
        name = "multi-resolution"
    elif read.has(f"{in_block}.depthwise.weight"):
        name = "depthwise"
        fields["kernel_size"] = read.size(f"{in_block}.depthwise.weight", 2)
        fields["bias"] = "convolutions" if read.has(f"{in_block}.depthwise.bias") else "up"
    return ADAPTERS.make(name, **fields)


def _infer_resnet(theirs: dict[str, str], read: Reader) -> ResNetConfig:
    firsts = (theirs[f"blocks.{i}.layers.0.convs.0.conv.weight"] for i in range(4))
    counts = [read.count(first.removesuffix("0.conv1.weight")) for first in firsts]
    stages = counts.index(0) if 0 in counts else 4
    third = theirs["blocks.0.layers.0.convs.2.conv.weight"]
    found, basic = tuple(counts[:stages]), not read.has(third)
    for layers, blocks in BLOCKS.items():
        if found == blocks[:stages] and basic == (layers == 18):
            return ResNetConfig(layers=layers, stages=stages)
    of = "two" if basic else "three"
    raise InputError(
        f"found a ResNet of {found} blocks of {of} convolutions, expected one of {BLOCKS}"
    )


def _infer_transvpr(read: Reader) -> TransVprNetConfig:
    read = Reader(read.state, f"{read.prefix}transformer.")
    dim = read.size("class_emb", 2)
    return TransVprNetConfig(
        dim=dim,
        depth=read.count("blocks."),
        heads=max(1, dim // _HEAD_WIDTH),
        hidden=read.size("blocks.0.linear1.weight", 0),
    )


def _infer_tetra(read: Reader) -> TetraVitConfig:
    dim, positions = read.size("cls_token", 2), read.size("pos_embedding", 1)
    words = f"found {positions} position embeddings, expected 1 and a square number"
    return TetraVitConfig(
        dim=dim,
        depth=read.count("transformer.layers."),
        heads=max(1, dim // _HEAD_WIDTH),
        hidden=read.size("transformer.layers.0.1.net.1.bias", 0),
        position_grid=square_side(positions - 1, words),
    )


def infer_encoder(state: State, names: str) -> CrossImage:
    """Infer the cross-image encoder, with the published number of heads; see `Format.encoder`."""
    read = Reader(state)
    layers = read.count("encoder.layers.")
    if not layers:
        return NoCrossImage()
    feedforward = read.size("encoder.layers.0.linear1.weight", 0)
    sizes: Any = {"layers": layers, "heads": _ENCODER_HEADS, "feedforward": feedforward}
    if "sage" not in names:
        return CrossImageConfig(**sizes)
    return SageCrossImageConfig(**sizes, width=read.size("encoder.layers.0.linear1.weight", 1))
