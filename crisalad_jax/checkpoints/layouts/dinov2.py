"""The layout of facebookresearch/dinov2, whose names most checkpoints of this field keep."""

import dataclasses
from typing import TypeVar

import numpy as np

from crisalad_jax.checkpoints.layouts.base import Layout, Lines, Reader, State, register_layout
from crisalad_jax.checkpoints.layouts.forms import (
    CLASS_TOKEN,
    CONV,
    DEPTHWISE,
    FIRST,
    LINEAR,
    PATCHES,
    POINTWISE,
    POSITIONS,
    SAME,
    Absent,
    Entry,
    Extra,
    affine,
    batch_norm_lines,
    side,
)
from crisalad_jax.nn.adapter import AdapterConfig
from crisalad_jax.nn.aggregators.backbone_tokens import ClassTokenConfig
from crisalad_jax.nn.backbones.vit import VisionTransformer, ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.utils.errors import InputError

_V = TypeVar("_V", bound=VisionTransformer)
HEAD_WIDTH = 64
"""Width of an attention head in every DINOv2; no shape shows the number of heads."""

SIDE_ALPHA = 0.5
"""Weight of EDTformer's adapters, which no shape shows."""


def accepts_bare_backbone(config: ModelConfig) -> str | None:
    """Accept DINOv2 alone, whose descriptor is its class token."""
    return accepts_parts(config, "class-token", "none", cross_image=False)


def accepts_parts(
    config: ModelConfig,
    aggregator: str,
    adapter: str,
    *,
    cross_image: bool,
    projection: bool = False,
) -> str | None:
    """Accept a vision transformer with exactly these parts; else return them in words."""
    parts = parts_in_words(config)
    encoder = "an" if cross_image else "no"
    expected = f"aggregator {aggregator}, adapter {adapter}, {encoder} encoder"
    expected += ", a projection" * projection
    return None if parts == expected else expected


def parts_in_words(config: ModelConfig) -> str:
    """Name a model's parts."""
    backbone = config.backbone
    encoder = "an" if config.cross_image.layers else "no"
    projection = ", a projection" if config.projection.dim else ""
    words = f"aggregator {config.aggregator.part_name}"
    if not isinstance(backbone, ViTConfig):
        words += f", backbone {backbone.part_name}"
    if isinstance(backbone, VisionTransformer):
        words += f", adapter {backbone.adapter.kind}"
    return f"{words}, {encoder} encoder{projection}"


def has_vit(state: State, prefix: str) -> bool:
    """Return whether there is a vision transformer under a prefix, which is not DINOv3's."""
    found = f"{prefix}cls_token" in state or f"{prefix}pos_embed" in state
    return found and f"{prefix}storage_tokens" not in state


def vit_of(config: ModelConfig) -> ViTConfig:
    """Return the backbone of a model that `accepts_parts` accepted."""
    assert isinstance(config.backbone, ViTConfig)
    return config.backbone


def vit_lines(
    config: ViTConfig, prefix: str, *, mask_token: bool = True, norm: bool = True
) -> Lines:
    """Yield the backbone under facebookresearch/dinov2's names, adapters under CricaVPR's.

    Some files leave out what they do not use: the mask token, or the last layer norm.
    """
    yield Entry(("backbone.cls_token",), (f"{prefix}cls_token",), CLASS_TOKEN)
    yield Entry(
        ("backbone.pos_embed_cls", "backbone.pos_embed"), (f"{prefix}pos_embed",), POSITIONS
    )
    if config.registers:
        yield Entry(("backbone.register_tokens",), (f"{prefix}register_tokens",), FIRST)
    if mask_token:
        yield Extra("backbone.mask_token", f"{prefix}mask_token", (1, config.dim), np.float32)
    yield from affine("backbone.patch_embed", f"{prefix}patch_embed.proj", PATCHES)
    for i in range(config.depth):
        ours, theirs = f"backbone.blocks.{i}", f"{prefix}blocks.{i}"
        yield from affine(f"{ours}.norm1", f"{theirs}.norm1", SAME)
        yield from affine(f"{ours}.attn.qkv", f"{theirs}.attn.qkv", LINEAR)
        yield from affine(f"{ours}.attn.proj", f"{theirs}.attn.proj", LINEAR)
        yield Entry((f"{ours}.ls1",), (f"{theirs}.ls1.gamma",), SAME)
        yield from affine(f"{ours}.norm2", f"{theirs}.norm2", SAME)
        for name in ("w12", "w3") if config.ffn == "swiglu" else ("fc1", "fc2"):
            yield from affine(f"{ours}.mlp.{name}", f"{theirs}.mlp.{name}", LINEAR)
        yield Entry((f"{ours}.ls2",), (f"{theirs}.ls2.gamma",), SAME)
        yield from adapter_lines(config, f"{ours}.adapter", f"{theirs}.adapter")
    if config.adapter.kind == "side":
        for i in range(config.depth):
            ours, theirs = f"backbone.blocks.{i}.adapter", f"{prefix}adapters.{i}"
            yield from affine(f"{ours}.down", f"{theirs}.D_fc1", LINEAR)
            yield from affine(f"{ours}.up", f"{theirs}.D_fc2", LINEAR)
    if norm:
        yield from affine("backbone.norm", f"{prefix}norm", SAME)
    else:
        yield Absent("backbone.norm.weight", 1.0)
        yield Absent("backbone.norm.bias", 0.0)


def adapter_lines(config: ViTConfig, ours: str, theirs: str) -> Lines:
    """Yield one block's adapter, under CricaVPR's names, or SelaVPR's or similar ones.

    Side adapters are in no block.
    """
    kind = config.adapter.kind
    if kind in ("none", "side"):
        return
    if kind == "serial-parallel":
        for i, name in enumerate(("serial", "parallel"), 1):
            yield from affine(f"{ours}.{name}.down", f"{theirs}{i}.D_fc1", LINEAR)
            yield from affine(f"{ours}.{name}.up", f"{theirs}{i}.D_fc2", LINEAR)
        return
    if kind == "multi-resolution":
        for branch in ("branch1", "branch2.0", "branch2.1", "branch3.0", "branch3.1"):
            here, there = f"{ours}.{branch}", f"{theirs}.{branch}"
            yield from affine(f"{here}.conv", f"{there}.conv", CONV)
            yield from batch_norm_lines(f"{here}.norm", f"{there}.bn")
    depthwise, bias = kind == "depthwise", config.adapter.bias == "convolutions"
    yield from affine(f"{ours}.down", f"{theirs}.D_fc1", LINEAR, bias=not depthwise)
    if depthwise:
        yield from affine(f"{ours}.depthwise", f"{theirs}.depthwise", DEPTHWISE, bias=bias)
        yield from affine(f"{ours}.pointwise", f"{theirs}.pointwise", POINTWISE, bias=bias)
    yield from affine(f"{ours}.up", f"{theirs}.D_fc2", LINEAR, bias=not (depthwise and bias))


def vit_config(read: Reader) -> ViTConfig:
    """Infer a backbone from facebookresearch/dinov2's names."""
    gated = read.has("blocks.0.mlp.w12.weight")
    width = read.size("cls_token", 2)
    return backbone_config(
        dim=width,
        depth=read.count("blocks."),
        hidden=read.size("blocks.0.mlp.w3.weight" if gated else "blocks.0.mlp.fc1.weight", gated),
        gated=gated,
        registers=read.size("register_tokens", 1) if read.has("register_tokens") else 0,
        positions=read.size("pos_embed", 1),
        adapter=_adapter_config(read, width),
    )


def _adapter_config(read: Reader, width: int) -> AdapterConfig:
    """Infer the kind and the sizes of the adapters; how much they weigh is as published."""
    if read.has("adapters.0.D_fc1.weight"):
        down = read.size("adapters.0.D_fc1.weight", 0)
        return AdapterConfig(kind="side", bottleneck=down / width, alpha=SIDE_ALPHA)
    if read.has("blocks.0.adapter1.D_fc1.weight"):
        down = read.size("blocks.0.adapter1.D_fc1.weight", 0)
        return AdapterConfig(kind="serial-parallel", bottleneck=down / width)
    if not read.has("blocks.0.adapter.D_fc1.weight"):
        return AdapterConfig(kind="none")
    adapter = AdapterConfig("mlp", read.size("blocks.0.adapter.D_fc1.weight", 0) / width)
    if read.has("blocks.0.adapter.branch1.conv.weight"):
        return dataclasses.replace(adapter, kind="multi-resolution")
    if not read.has("blocks.0.adapter.depthwise.weight"):
        return adapter
    side = read.size("blocks.0.adapter.depthwise.weight", 2)
    bias = "convolutions" if read.has("blocks.0.adapter.depthwise.bias") else "up"
    return dataclasses.replace(adapter, kind="depthwise", kernel_size=side, bias=bias)


def backbone_config(
    *,
    dim: int,
    depth: int,
    hidden: int,
    gated: bool,
    registers: int,
    positions: int,
    adapter: AdapterConfig,
) -> ViTConfig:
    """Make a backbone's configuration from its sizes.

    Raises:
        InputError: they are the sizes of no backbone.
    """
    grid = side(positions - 1)
    if grid**2 != positions - 1 or not grid:
        raise InputError(f"found {positions} position embeddings, expected 1 and a square number")
    config = ViTConfig(
        dim=dim,
        depth=depth,
        heads=count_heads(dim),
        ffn="swiglu" if gated else "mlp",
        registers=registers,
        position_grid=grid,
        adapter=adapter,
    )
    return with_hidden(config, hidden)


def count_heads(dim: int, width: int = HEAD_WIDTH) -> int:
    """Return the number of attention heads, by the width of one.

    Raises:
        InputError: the backbone's width is no multiple of it.
    """
    if dim % width:
        raise InputError(
            f"found a backbone of width {dim}, expected a multiple of {width}: "
            "DINOv2's heads have that width, and no shape tells another"
        )
    return dim // width


def with_hidden(config: _V, hidden: int) -> _V:
    """Return a configuration with the ratio that gives a hidden width of the feed-forward network.

    Raises:
        InputError: none does.
    """
    gated, ratio = config.ffn == "swiglu", hidden / config.dim
    # Of SwiGLU's two thirds, the ratio is 4 where they are DINOv2's.
    for each in (4.0, 1.5 * ratio) if gated else (ratio,):
        found = dataclasses.replace(config, mlp_ratio=each)
        if found.hidden == hidden:
            return found
    raise InputError(f"found a feed-forward width of {hidden}, expected a multiple of 8 for SwiGLU")


def _infer(state: State) -> ModelConfig:
    return ModelConfig(
        backbone=vit_config(Reader(state)),
        aggregator=ClassTokenConfig(),
        cross_image=CrossImageConfig(layers=0),
    )


register_layout(
    Layout(
        "dinov2",
        "DINOv2 .pth",
        accepts_bare_backbone,
        lambda config: vit_lines(vit_of(config), ""),
        lambda state: has_vit(state, ""),
        _infer,
    )
)
