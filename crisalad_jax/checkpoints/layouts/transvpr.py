"""The layout of RuotongWANG/TransVPR-model-implementation, and its head on other backbones."""

from collections.abc import Iterator

import numpy as np

from crisalad_jax.checkpoints.layouts.base import (
    Layout,
    Lines,
    Reader,
    State,
    register_head,
    register_layout,
)
from crisalad_jax.checkpoints.layouts.cnn import accepts_head_over
from crisalad_jax.checkpoints.layouts.forms import (
    CLASS_TOKEN,
    CONV,
    LINEAR,
    SAME,
    Entry,
    Extra,
    affine,
    batch_norm_lines,
)
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators.transvpr import TransVprConfig
from crisalad_jax.nn.backbones.transvpr import WIDTHS, TransVprNetConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig

_ATTENTION, _REDUCTION = "pool.attention_pool", "pool.fc.1"
_HEAD_WIDTH = 64
"""Width of an attention head, as published; no shape shows the number of heads."""


@register_head("transvpr")
def transvpr_lines(config: TransVprConfig) -> Iterator[Entry]:
    """Yield both linear layers, under our own names."""
    yield from affine("aggregator.attention", "aggregator.attention", LINEAR, bias=False)
    yield from affine("aggregator.reduction", "aggregator.reduction", LINEAR)


def _lines(config: ModelConfig) -> Lines:
    assert isinstance(config.aggregator, TransVprConfig)
    for i in range(len(WIDTHS)):
        yield from affine(f"backbone.convs.{i}.conv", f"conv{i + 1}.0", CONV)
        yield from batch_norm_lines(f"backbone.convs.{i}.norm", f"conv{i + 1}.1")
    for i in range(len(WIDTHS)):
        yield from affine(f"backbone.tokenizers.{i}", f"tokenizer{i + 1}.conv_layer", CONV)
    yield Entry(("backbone.cls_token",), ("transformer.class_emb",), CLASS_TOKEN)
    for i in range(config.backbone.depth):
        ours, theirs = f"backbone.blocks.{i}", f"transformer.blocks.{i}"
        yield from affine(f"{ours}.pre_norm", f"{theirs}.pre_norm", SAME)
        yield from affine(f"{ours}.self_attn.qkv", f"{theirs}.self_attn.qkv", LINEAR, bias=False)
        yield from affine(f"{ours}.self_attn.proj", f"{theirs}.self_attn.proj", LINEAR)
        for name, form in (("linear1", LINEAR), ("norm1", SAME), ("linear2", LINEAR)):
            yield from affine(f"{ours}.{name}", f"{theirs}.{name}", form)
    yield from affine("backbone.norm", "transformer.norm", SAME)
    yield from affine("aggregator.reduction", _REDUCTION, LINEAR)
    yield from affine("aggregator.attention", _ATTENTION, LINEAR, bias=False)
    # The same for all patches, it has no effect on their softmax.
    levels = config.aggregator.levels
    yield Extra("aggregator.attention.bias", f"{_ATTENTION}.bias", (levels,), np.float32)


def _infer(state: State) -> ModelConfig:
    read = Reader(state)
    dim = read.size("transformer.class_emb", 2)
    return ModelConfig(
        image_size=(480, 640),
        # Tensors at a torchvision of 2022, which does not antialias them unasked.
        preprocessing=PreprocessingConfig(antialias=False, pixels="floats"),
        backbone=TransVprNetConfig(
            dim=dim,
            depth=read.count("transformer.blocks."),
            heads=max(1, dim // _HEAD_WIDTH),
            hidden=read.size("transformer.blocks.0.linear1.weight", 0),
        ),
        aggregator=TransVprConfig(
            levels=read.size(f"{_ATTENTION}.weight", 0), dim=read.size(f"{_REDUCTION}.weight", 0)
        ),
        cross_image=CrossImageConfig(layers=0),
    )


register_layout(
    Layout(
        "transvpr",
        "TransVPR .pth",
        lambda config: accepts_head_over(config, "transvpr", (TransVprNetConfig,)),
        _lines,
        lambda state: "transformer.class_emb" in state,
        _infer,
    )
)
