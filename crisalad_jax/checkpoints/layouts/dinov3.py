"""The layouts of DINOv3's backbones: facebookresearch/dinov3, and Hugging Face's DINOv3ViTModel.

Names and shapes are those of the public files and of transformers' module (Apache-2.0).
"""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np

from crisalad_jax.checkpoints.layouts.base import Layout, Lines, Reader, State, register_layout
from crisalad_jax.checkpoints.layouts.dinov2 import (
    HEAD_WIDTH,
    count_heads,
    parts_in_words,
    with_hidden,
)
from crisalad_jax.checkpoints.layouts.forms import (
    CLASS_TOKEN,
    FIRST,
    LINEAR,
    PAIR,
    PAIR_BIAS,
    PATCHES,
    QKV,
    SAME,
    Entry,
    Extra,
    Form,
    affine,
)
from crisalad_jax.nn.adapter import AdapterConfig
from crisalad_jax.nn.aggregators.backbone_tokens import ClassTokenConfig
from crisalad_jax.nn.backbones.dinov3 import DinoV3Config, rotary_periods
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.utils.errors import InputError

MASK = "backbone.mask_token"
PERIODS = "rope_embed.periods"


def _mask_of(bias: np.ndarray) -> np.ndarray:
    """Make `bias_mask`: 0 for keys, and for all where no bias is other than 0, as published."""
    mask = np.full_like(bias, float(bias.any()))
    mask[len(mask) // 3 : 2 * len(mask) // 3] = 0
    return mask


MASKED_BIAS = Form(
    lambda bias, mask: (bias * mask,),
    lambda bias: (bias, _mask_of(bias)),
)
QV_BIAS = Form(
    lambda q, v: (np.concatenate([q, np.zeros_like(q), v]),),
    lambda b: (b[: len(b) // 3], b[2 * len(b) // 3 :]),
)


def _accepts(config: ModelConfig) -> str | None:
    expected = "aggregator class-token, backbone dinov3, adapter none, no encoder"
    return None if parts_in_words(config) == expected else expected


def _backbone(config: ModelConfig) -> DinoV3Config:
    assert isinstance(config.backbone, DinoV3Config)  # `_accepts` has seen it
    return config.backbone


def _published_periods(head_dim: int) -> tuple[float, ...]:
    """Return a head's periods as the public files have them, rounded to bfloat16."""
    return tuple(rotary_periods(head_dim).astype(jnp.bfloat16).astype(float).tolist())


def _lines(model: ModelConfig) -> Lines:
    """Yield the backbone under facebookresearch/dinov3's names."""
    config = _backbone(model)
    yield Entry(("backbone.cls_token",), ("cls_token",), CLASS_TOKEN)
    if config.registers:
        yield Entry(("backbone.register_tokens",), ("storage_tokens",), FIRST)
    yield Extra(MASK, "mask_token", (1, config.dim), np.float32)
    yield from affine("backbone.patch_embed", "patch_embed.proj", PATCHES)
    periods = _published_periods(config.dim // config.heads)
    yield Extra(f"backbone.{PERIODS}", PERIODS, (len(periods),), np.float32, periods)
    for i in range(config.depth):
        ours, theirs = f"backbone.blocks.{i}", f"blocks.{i}"
        yield from affine(f"{ours}.norm1", f"{theirs}.norm1", SAME)
        qkv = f"{theirs}.attn.qkv"
        yield Entry((f"{ours}.attn.qkv.weight",), (f"{qkv}.weight",), LINEAR)
        masked = f"{qkv}.bias", f"{qkv}.bias_mask"
        yield Entry((f"{ours}.attn.qkv.bias",), masked, MASKED_BIAS)
        yield from affine(f"{ours}.attn.proj", f"{theirs}.attn.proj", LINEAR)
        yield Entry((f"{ours}.ls1",), (f"{theirs}.ls1.gamma",), SAME)
        yield from affine(f"{ours}.norm2", f"{theirs}.norm2", SAME)
        names = ("w1", "w2", "w3") if config.ffn == "swiglu" else ("fc1", "fc2")
        yield from _feed_forward(f"{ours}.mlp", f"{theirs}.mlp", names)
        yield Entry((f"{ours}.ls2",), (f"{theirs}.ls2.gamma",), SAME)
    yield from affine("backbone.norm", "norm", SAME)


def _feed_forward(ours: str, theirs: str, names: tuple[str, ...]) -> Iterator[Entry]:
    """Yield a feed-forward network whose layers have these names: three in SwiGLU, else two."""
    if len(names) == 2:
        for here, there in zip(("fc1", "fc2"), names, strict=True):
            yield from affine(f"{ours}.{here}", f"{theirs}.{there}", LINEAR)
        return
    gate, value, out = (f"{theirs}.{name}" for name in names)
    yield Entry((f"{ours}.w12.weight",), (f"{gate}.weight", f"{value}.weight"), PAIR)
    yield Entry((f"{ours}.w12.bias",), (f"{gate}.bias", f"{value}.bias"), PAIR_BIAS)
    yield from affine(f"{ours}.w3", out, LINEAR)


def _hugging_face_lines(model: ModelConfig) -> Lines:
    """Yield the backbone under the names of transformers' published files."""
    config, above = _backbone(model), "embeddings"
    yield Entry(("backbone.cls_token",), (f"{above}.cls_token",), CLASS_TOKEN)
    yield Extra(MASK, f"{above}.mask_token", (1, config.dim), np.float32, form=FIRST)
    if config.registers:
        yield Entry(("backbone.register_tokens",), (f"{above}.register_tokens",), FIRST)
    yield from affine("backbone.patch_embed", f"{above}.patch_embeddings", PATCHES)
    for i in range(config.depth):
        ours, theirs = f"backbone.blocks.{i}", f"layer.{i}"
        yield from affine(f"{ours}.norm1", f"{theirs}.norm1", SAME)
        q, k, v, out = (f"{theirs}.attention.{name}_proj" for name in "qkvo")
        weights = f"{q}.weight", f"{k}.weight", f"{v}.weight"
        yield Entry((f"{ours}.attn.qkv.weight",), weights, QKV)
        yield Entry((f"{ours}.attn.qkv.bias",), (f"{q}.bias", f"{v}.bias"), QV_BIAS)
        yield from affine(f"{ours}.attn.proj", out, LINEAR)
        yield Entry((f"{ours}.ls1",), (f"{theirs}.layer_scale1.lambda1",), SAME)
        yield from affine(f"{ours}.norm2", f"{theirs}.norm2", SAME)
        gate = ("gate_proj",) if config.ffn == "swiglu" else ()
        names = (*gate, "up_proj", "down_proj")
        yield from _feed_forward(f"{ours}.mlp", f"{theirs}.mlp", names)
        yield Entry((f"{ours}.ls2",), (f"{theirs}.layer_scale2.lambda1",), SAME)
    yield from affine("backbone.norm", "norm", SAME)


def _model(
    read: Reader, *, tokens: tuple[str, str], blocks: str, gate: str, hidden: str, head_dim: int
) -> ModelConfig:
    """Infer a model from the names of its class token and registers, its blocks and their MLPs."""
    class_token, registers = tokens
    dim = read.size(class_token, 2)
    gated = read.has(f"{blocks}0.mlp.{gate}.weight")
    config = DinoV3Config(
        dim=dim,
        depth=read.count(blocks),
        heads=count_heads(dim, head_dim),
        ffn="swiglu" if gated else "mlp",
        registers=read.size(registers, 1) if read.has(registers) else 0,
        adapter=AdapterConfig(kind="none"),
    )
    first = gate if gated else hidden
    return ModelConfig(
        backbone=with_hidden(config, read.size(f"{blocks}0.mlp.{first}.weight", 0)),
        aggregator=ClassTokenConfig(),
        cross_image=CrossImageConfig(layers=0),
    )


def _infer(state: State) -> ModelConfig:
    read = Reader(state)
    head_dim = 4 * read.size(PERIODS, 0)
    expected = rotary_periods(head_dim)
    # Half a step of bfloat16, in which the public files have them.
    if not np.allclose(state[PERIODS], expected, rtol=2.0**-8, atol=0):
        raise InputError(
            f"{PERIODS} found {state[PERIODS].tolist()}, expected about "
            f"{expected.round(2).tolist()}"
        )
    return _model(
        read,
        tokens=("cls_token", "storage_tokens"),
        blocks="blocks.",
        gate="w1",
        hidden="fc1",
        head_dim=head_dim,
    )


def _infer_hugging_face(state: State) -> ModelConfig:
    return _model(
        Reader(state),
        tokens=("embeddings.cls_token", "embeddings.register_tokens"),
        blocks="layer.",
        gate="gate_proj",
        hidden="up_proj",
        head_dim=HEAD_WIDTH,
    )


register_layout(
    Layout(
        "dinov3",
        "DINOv3 .pth",
        _accepts,
        _lines,
        lambda state: PERIODS in state,
        _infer,
    )
)
register_layout(
    Layout(
        "huggingface-dinov3",
        "Hugging Face DINOv3 .safetensors",
        _accepts,
        _hugging_face_lines,
        lambda state: "layer.0.attention.q_proj.weight" in state,
        _infer_hugging_face,
        stored="safetensors",
    )
)
