"""How public checkpoints name the vision transformers: DINOv2, DINOv3, and Hugging Face's of both.

Names and shapes are those of facebookresearch/dinov2 and dinov3, and of transformers' Dinov2Model,
Dinov2WithRegistersModel and DINOv3ViTModel (Apache-2.0). Most of this field keep DINOv2's.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np

from crisalad_jax.checkpoints.formats.format import Reader, State
from crisalad_jax.checkpoints.formats.forms import (
    CLASS_TOKEN,
    CONV,
    DEPTHWISE,
    FIRST,
    LINEAR,
    PAIR,
    PAIR_BIAS,
    PATCHES,
    POINTWISE,
    POSITIONS,
    QKV,
    QKV_BIAS,
    SAME,
    Absent,
    Entry,
    Extra,
    Form,
    Lines,
    affine,
    batch_norm_lines,
    side,
)
from crisalad_jax.nn.adapter import AdapterConfig
from crisalad_jax.nn.backbones.dinov3 import DinoV3Config, rotary_periods
from crisalad_jax.nn.backbones.vit import VisionTransformer, ViTConfig
from crisalad_jax.utils.errors import InputError

_V = TypeVar("_V", bound=VisionTransformer)
_HEAD_WIDTH = 64
"""Width of an attention head in every DINOv2; no shape shows the number of heads."""
_SIDE_ALPHA = 0.5
"""Weight of EDTformer's adapters, which no shape shows."""
_EMBEDDINGS: Mapping[str, tuple[tuple[str, ...], Form]] = {
    "class": (("backbone.cls_token",), CLASS_TOKEN),
    "positions": (("backbone.pos_embed_cls", "backbone.pos_embed"), POSITIONS),
    "registers": (("backbone.register_tokens",), FIRST),
}
"""Our names of what comes before the blocks, and the forms of theirs."""


@dataclasses.dataclass(frozen=True)
class QkvNames:
    """How files name the products of a block that attention takes, after the block's name."""

    weights: tuple[str, ...]
    weight_form: Form
    biases: tuple[str, ...]
    bias_form: Form


@dataclasses.dataclass(frozen=True)
class VitNames:
    """How files name a vision transformer."""

    kind: type[VisionTransformer]
    embeddings: Mapping[str, str]
    """Names by part, in the public order: "class", "positions", "registers", "mask", "patches" and
    "periods"."""
    blocks: str
    qkv: QkvNames
    proj: str
    """Name of the product after attention."""
    scale: str
    """Name of a layer scale, with {} for its number."""
    mlp: tuple[str, ...]
    """Names of a feed-forward network's layers."""
    swiglu: tuple[str, ...]
    """Names of SwiGLU's layers: three where gate and value are two."""
    norm: str | None
    """Name of the last layer norm; None in files that leave it out."""
    prefix: str = ""
    mask_form: Form = SAME
    fields: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Fields of the configuration that no shape tells."""

    @property
    def kinds(self) -> tuple[type[VisionTransformer], ...]:
        """Classes of the backbones."""
        return (self.kind,)

    @property
    def marks(self) -> tuple[str, ...]:
        """Names of which any file with such a backbone has at least one."""
        named = self.embeddings
        parts = ("periods",) if "periods" in named else ("class", "positions")
        return tuple(self.prefix + named[part] for part in parts if part in named)

    def under(self, prefix: str, *, mask_token: bool = True, **changes: Any) -> "VitNames":
        """Return the names after a prefix, and without the mask token where files have none."""
        named = {k: v for k, v in self.embeddings.items() if mask_token or k != "mask"}
        return dataclasses.replace(self, prefix=prefix, embeddings=named, **changes)

    def lines(self, config: VisionTransformer) -> Lines:
        """Yield the table, in the public order."""
        for part, name in self.embeddings.items():
            theirs = self.prefix + name
            if part == "mask":
                mask, shape = "backbone.mask_token", (1, config.dim)
                yield Extra(mask, theirs, shape, np.float32, form=self.mask_form)
            elif part == "patches":
                yield from affine("backbone.patch_embed", theirs, PATCHES)
            elif part == "periods":
                periods = _published_periods(config.dim // config.heads)
                yield Extra(f"backbone.{name}", theirs, (len(periods),), np.float32, periods)
            elif part != "registers" or config.registers:
                ours, form = _EMBEDDINGS[part]
                yield Entry(ours, (theirs,), form)
        for i in range(config.depth):
            yield from self._block(config, f"backbone.blocks.{i}", f"{self.prefix}{self.blocks}{i}")
        if config.adapter.kind == "side":
            for i in range(config.depth):
                yield from _bottleneck(f"backbone.blocks.{i}.adapter", f"{self.prefix}adapters.{i}")
        if self.norm is not None:
            yield from affine("backbone.norm", self.prefix + self.norm, SAME)
        else:
            yield Absent("backbone.norm.weight", 1.0)
            yield Absent("backbone.norm.bias", 0.0)

    def _block(self, config: VisionTransformer, ours: str, theirs: str) -> Lines:
        qkv = self.qkv
        weights, biases = (
            tuple(f"{theirs}.{name}" for name in names) for names in (qkv.weights, qkv.biases)
        )
        yield from affine(f"{ours}.norm1", f"{theirs}.norm1", SAME)
        yield Entry((f"{ours}.attn.qkv.weight",), weights, qkv.weight_form)
        yield Entry((f"{ours}.attn.qkv.bias",), biases, qkv.bias_form)
        yield from affine(f"{ours}.attn.proj", f"{theirs}.{self.proj}", LINEAR)
        yield Entry((f"{ours}.ls1",), (f"{theirs}.{self.scale.format(1)}",), SAME)
        yield from affine(f"{ours}.norm2", f"{theirs}.norm2", SAME)
        yield from self._feed_forward(config, f"{ours}.mlp", f"{theirs}.mlp")
        yield Entry((f"{ours}.ls2",), (f"{theirs}.{self.scale.format(2)}",), SAME)
        yield from adapter_lines(config, f"{ours}.adapter", f"{theirs}.adapter")

    def _feed_forward(self, config: VisionTransformer, ours: str, theirs: str) -> Lines:
        gated = config.ffn == "swiglu"
        first, last = ("w12", "w3") if gated else ("fc1", "fc2")
        *names, out = (f"{theirs}.{name}" for name in (self.swiglu if gated else self.mlp))
        if len(names) == 2:
            for leaf, form in (("weight", PAIR), ("bias", PAIR_BIAS)):
                yield Entry((f"{ours}.{first}.{leaf}",), tuple(f"{n}.{leaf}" for n in names), form)
        else:
            yield from affine(f"{ours}.{first}", names[0], LINEAR)
        yield from affine(f"{ours}.{last}", out, LINEAR)

    def infer(self, state: State) -> VisionTransformer:
        """Make the configuration from names and shapes."""
        read, named = Reader(state, self.prefix), self.embeddings
        dim, registers = read.size(named["class"], 2), named["registers"]
        gated = read.has(f"{self.blocks}0.mlp.{self.swiglu[0]}.weight")
        last = (self.swiglu if gated else self.mlp)[-1]
        hidden = read.size(f"{self.blocks}0.mlp.{last}.weight", 1)
        width = _check_periods(read, named["periods"]) if "periods" in named else _HEAD_WIDTH
        fields = dict(self.fields)
        if "positions" in named:
            fields["position_grid"] = _grid(read.size(named["positions"], 1))
        config = self.kind(
            dim=dim,
            depth=read.count(self.blocks),
            heads=_count_heads(dim, width),
            ffn="swiglu" if gated else "mlp",
            registers=read.size(registers, 1) if read.has(registers) else 0,
            adapter=_adapter_config(read, dim),
            **fields,
        )
        return _with_hidden(config, hidden)


def _published_periods(head_dim: int) -> tuple[float, ...]:
    """Return a head's periods as DINOv3's public files have them, rounded to bfloat16."""
    return tuple(rotary_periods(head_dim).astype(jnp.bfloat16).astype(float).tolist())


def _check_periods(read: Reader, name: str) -> int:
    """Return the width of a head, whose periods are to be DINOv3's."""
    head_dim = 4 * read.size(name, 0)
    expected, found = rotary_periods(head_dim), read.state[read.prefix + name]
    # Half a step of bfloat16, in which the public files have them.
    if not np.allclose(found, expected, rtol=2.0**-8, atol=0):
        raise InputError(
            f"{name} found {found.tolist()}, expected about {expected.round(2).tolist()}"
        )
    return head_dim


def _grid(positions: int) -> int:
    """Return the side of the grid of so many position embeddings, the class token's included."""
    grid = side(positions - 1)
    if grid**2 != positions - 1 or not grid:
        raise InputError(f"found {positions} position embeddings, expected 1 and a square number")
    return grid


def _count_heads(dim: int, width: int) -> int:
    if dim % width:
        raise InputError(
            f"found a backbone of width {dim}, expected a multiple of {width}: "
            "DINOv2's heads have that width, and no shape tells another"
        )
    return dim // width


def _with_hidden(config: _V, hidden: int) -> _V:
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


def adapter_lines(config: VisionTransformer, ours: str, theirs: str) -> Lines:
    """Yield one block's adapter, under CricaVPR's names, or SelaVPR's or similar ones.

    Side adapters are in no block.
    """
    kind = config.adapter.kind
    if kind in ("none", "side"):
        return
    if kind == "serial-parallel":
        for i, name in enumerate(("serial", "parallel"), 1):
            yield from _bottleneck(f"{ours}.{name}", f"{theirs}{i}")
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


def _bottleneck(ours: str, theirs: str) -> Lines:
    yield from affine(f"{ours}.down", f"{theirs}.D_fc1", LINEAR)
    yield from affine(f"{ours}.up", f"{theirs}.D_fc2", LINEAR)


def _adapter_config(read: Reader, width: int) -> AdapterConfig:
    """Infer the kind and the sizes of the adapters; how much they weigh is as published."""
    first = {
        "side": "adapters.0",
        "serial-parallel": "blocks.0.adapter1",
        "mlp": "blocks.0.adapter",
    }
    downs = {kind: f"{name}.D_fc1.weight" for kind, name in first.items()}
    kind = next((kind for kind, down in downs.items() if read.has(down)), None)
    if kind is None:
        return AdapterConfig(kind="none")
    bottleneck = read.size(downs[kind], 0) / width
    if kind == "side":
        return AdapterConfig(kind=kind, bottleneck=bottleneck, alpha=_SIDE_ALPHA)
    if read.has("blocks.0.adapter.branch1.conv.weight"):
        return AdapterConfig(kind="multi-resolution", bottleneck=bottleneck)
    if not read.has("blocks.0.adapter.depthwise.weight"):
        return AdapterConfig(kind=kind, bottleneck=bottleneck)  # pyright: ignore
    kernel = read.size("blocks.0.adapter.depthwise.weight", 2)
    bias = "convolutions" if read.has("blocks.0.adapter.depthwise.bias") else "up"
    return AdapterConfig("depthwise", bottleneck, kernel_size=kernel, bias=bias)


def _mask_of(bias: np.ndarray) -> np.ndarray:
    """Make `bias_mask`: 0 for keys, and for all where no bias is other than 0, as published."""
    mask = np.full_like(bias, float(bias.any()))
    mask[len(mask) // 3 : 2 * len(mask) // 3] = 0
    return mask


_MASKED_BIAS = Form(lambda bias, mask: (bias * mask,), lambda bias: (bias, _mask_of(bias)))
_QV_BIAS = Form(
    lambda q, v: (np.concatenate([q, np.zeros_like(q), v]),),
    lambda b: (b[: len(b) // 3], b[2 * len(b) // 3 :]),
)

DINOV2 = VitNames(
    kind=ViTConfig,
    embeddings={
        "class": "cls_token",
        "positions": "pos_embed",
        "registers": "register_tokens",
        "mask": "mask_token",
        "patches": "patch_embed.proj",
    },
    blocks="blocks.",
    qkv=QkvNames(("attn.qkv.weight",), LINEAR, ("attn.qkv.bias",), SAME),
    proj="attn.proj",
    scale="ls{}.gamma",
    mlp=("fc1", "fc2"),
    swiglu=("w12", "w3"),
    norm="norm",
)
DINOV3 = dataclasses.replace(
    DINOV2,
    kind=DinoV3Config,
    embeddings={
        "class": "cls_token",
        "registers": "storage_tokens",
        "mask": "mask_token",
        "patches": "patch_embed.proj",
        "periods": "rope_embed.periods",
    },
    qkv=QkvNames(
        ("attn.qkv.weight",), LINEAR, ("attn.qkv.bias", "attn.qkv.bias_mask"), _MASKED_BIAS
    ),
    swiglu=("w1", "w2", "w3"),
)
_ATTENTION = "attention.attention."
HUGGING_FACE = dataclasses.replace(
    DINOV2,
    embeddings={
        "class": "embeddings.cls_token",
        "mask": "embeddings.mask_token",
        "registers": "embeddings.register_tokens",
        "positions": "embeddings.position_embeddings",
        "patches": "embeddings.patch_embeddings.projection",
    },
    blocks="encoder.layer.",
    qkv=QkvNames(
        tuple(f"{_ATTENTION}{name}.weight" for name in ("query", "key", "value")),
        QKV,
        tuple(f"{_ATTENTION}{name}.bias" for name in ("query", "key", "value")),
        QKV_BIAS,
    ),
    proj="attention.output.dense",
    scale="layer_scale{}.lambda1",
    swiglu=("weights_in", "weights_out"),
    norm="layernorm",
)
HUGGING_FACE_DINOV3 = dataclasses.replace(
    HUGGING_FACE,
    kind=DinoV3Config,
    embeddings={
        "class": "embeddings.cls_token",
        "mask": "embeddings.mask_token",
        "registers": "embeddings.register_tokens",
        "patches": "embeddings.patch_embeddings",
    },
    blocks="layer.",
    qkv=QkvNames(
        tuple(f"attention.{name}_proj.weight" for name in "qkv"),
        QKV,
        tuple(f"attention.{name}_proj.bias" for name in "qv"),
        _QV_BIAS,
    ),
    proj="attention.o_proj",
    mlp=("up_proj", "down_proj"),
    swiglu=("gate_proj", "up_proj", "down_proj"),
    norm="norm",
    mask_form=FIRST,
)
