"""The layout of Hugging Face's Dinov2Model and Dinov2WithRegistersModel."""

import numpy as np

from crisalad_jax.checkpoints.layouts.base import Layout, Lines, Reader, State, register_layout
from crisalad_jax.checkpoints.layouts.dinov2 import accepts_bare_backbone, backbone_config, vit_of
from crisalad_jax.checkpoints.layouts.forms import (
    CLASS_TOKEN,
    FIRST,
    LINEAR,
    PATCHES,
    POSITIONS,
    QKV,
    QKV_BIAS,
    SAME,
    Entry,
    Extra,
    affine,
)
from crisalad_jax.nn.adapter import AdapterConfig
from crisalad_jax.nn.aggregators.backbone_tokens import ClassTokenConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig


def hugging_face_lines(config: ViTConfig) -> Lines:
    """Yield the backbone under the names of transformers' classes."""
    above = "embeddings"
    yield Entry(("backbone.cls_token",), (f"{above}.cls_token",), CLASS_TOKEN)
    yield Extra("backbone.mask_token", f"{above}.mask_token", (1, config.dim), np.float32)
    if config.registers:
        yield Entry(("backbone.register_tokens",), (f"{above}.register_tokens",), FIRST)
    yield Entry(
        ("backbone.pos_embed_cls", "backbone.pos_embed"),
        (f"{above}.position_embeddings",),
        POSITIONS,
    )
    yield from affine("backbone.patch_embed", f"{above}.patch_embeddings.projection", PATCHES)
    feed_forward = (
        (("w12", "weights_in"), ("w3", "weights_out"))
        if config.ffn == "swiglu"
        else (("fc1", "fc1"), ("fc2", "fc2"))
    )
    for i in range(config.depth):
        ours, theirs = f"backbone.blocks.{i}", f"encoder.layer.{i}"
        three = [f"{theirs}.attention.attention.{name}" for name in ("query", "key", "value")]
        yield from affine(f"{ours}.norm1", f"{theirs}.norm1", SAME)
        weights, biases = (tuple(f"{n}.{leaf}" for n in three) for leaf in ("weight", "bias"))
        yield Entry((f"{ours}.attn.qkv.weight",), weights, QKV)
        yield Entry((f"{ours}.attn.qkv.bias",), biases, QKV_BIAS)
        yield from affine(f"{ours}.attn.proj", f"{theirs}.attention.output.dense", LINEAR)
        yield Entry((f"{ours}.ls1",), (f"{theirs}.layer_scale1.lambda1",), SAME)
        yield from affine(f"{ours}.norm2", f"{theirs}.norm2", SAME)
        for here, there in feed_forward:
            yield from affine(f"{ours}.mlp.{here}", f"{theirs}.mlp.{there}", LINEAR)
        yield Entry((f"{ours}.ls2",), (f"{theirs}.layer_scale2.lambda1",), SAME)
    yield from affine("backbone.norm", "layernorm", SAME)


def _hugging_face_config(read: Reader) -> ViTConfig:
    block, above = "encoder.layer.0.mlp.", "embeddings."
    gated = read.has(f"{block}weights_in.weight")
    registers = f"{above}register_tokens"
    return backbone_config(
        dim=read.size(f"{above}cls_token", 2),
        depth=read.count("encoder.layer."),
        hidden=read.size(f"{block}{'weights_out' if gated else 'fc1'}.weight", gated),
        gated=gated,
        registers=read.size(registers, 1) if read.has(registers) else 0,
        positions=read.size(f"{above}position_embeddings", 1),
        adapter=AdapterConfig(kind="none"),
    )


def _infer(state: State) -> ModelConfig:
    return ModelConfig(
        backbone=_hugging_face_config(Reader(state)),
        aggregator=ClassTokenConfig(),
        cross_image=CrossImageConfig(layers=0),
    )


register_layout(
    Layout(
        "huggingface",
        "Hugging Face Dinov2 .safetensors",
        accepts_bare_backbone,
        lambda config: hugging_face_lines(vit_of(config)),
        lambda state: (
            not {"embeddings.cls_token", "embeddings.position_embeddings"}.isdisjoint(state)
        ),
        _infer,
        stored="safetensors",
    )
)
