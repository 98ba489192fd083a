"""The names of public torch checkpoints: one table for every layout, and models from their names.

Key names and shapes are those of facebookresearch/dinov2, Hugging Face's Dinov2Model (with and
without registers), serizba/salad and Lu-Feng/CricaVPR, and of the torch reference in `parity/`,
which holds any model of ours. Every entry of a table is a permutation of numbers, so gradients can
be converted as well as weights, and the way back gives the same bits.
"""

import dataclasses
import math
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from crisalad_jax.config import (
    AGGREGATORS,
    AdapterConfig,
    BoqConfig,
    CrossImageConfig,
    MixVprConfig,
    ModelConfig,
    SaladConfig,
    ViTConfig,
    choose,
)
from crisalad_jax.errors import InputError
from crisalad_jax.model import Crisalad, parameter_shapes
from crisalad_jax.pytree import named_leaves
from crisalad_jax.serial import differences

State = Mapping[str, np.ndarray]
HEAD_WIDTH = 64
"""Width of an attention head in every DINOv2: the number of heads is in no shape."""
ENCODER_HEADS = 16
"""Heads of CricaVPR's encoder, for the same reason."""


class Layout(NamedTuple):
    """How a public checkpoint names its parts."""

    holds: str
    backbone: str
    """Prefix of the backbone's names."""
    module: str
    """Prefix of all names, as torch's DataParallel leaves it."""
    under: str | None
    """The key of the file's dictionary that holds the state; None: the file is the state."""


LAYOUTS: Mapping[str, Layout] = {
    "dinov2": Layout("DINOv2 .pth", "", "", None),
    "huggingface": Layout("Hugging Face Dinov2 .safetensors", "", "", None),
    "dino-salad": Layout("DINO-SALAD .ckpt", "backbone.model.", "", None),
    "cricavpr": Layout("CricaVPR .pth", "backbone.", "module.", "model_state_dict"),
    "reference": Layout("our torch reference", "backbone.", "", "state_dict"),
}


class Form(NamedTuple):
    """Two functions, each the other's inverse, between our arrays and theirs."""

    ours: Callable[..., tuple[np.ndarray, ...]]
    theirs: Callable[..., tuple[np.ndarray, ...]]


class Entry(NamedTuple):
    """One line of a table: some of our arrays are some of theirs. Blocks are numbered in both."""

    ours: tuple[str, ...]
    theirs: tuple[str, ...]
    form: Form


_SAME = Form(lambda x: (x,), lambda x: (x,))
_LINEAR = Form(lambda w: (w.T,), lambda w: (w.T,))
_FIRST = Form(lambda x: (x[0],), lambda x: (x[None],))
_CLASS_TOKEN = Form(lambda x: (x[0, 0],), lambda x: (x[None, None],))
_POINTWISE = Form(lambda w: (w[:, :, 0, 0].T,), lambda w: (w.T[:, :, None, None],))
_CONV = Form(lambda w: (w.transpose(2, 3, 1, 0),), lambda w: (w.transpose(3, 2, 0, 1),))
_DEPTHWISE = Form(
    lambda w: (w[:, 0].transpose(1, 2, 0),), lambda w: (w.transpose(2, 0, 1)[:, None],)
)


def _side(area: int) -> int:
    return math.isqrt(area)


_PATCHES = Form(
    lambda w: (w.transpose(2, 3, 1, 0).reshape(-1, w.shape[0]),),
    lambda w: (w.reshape(_side(len(w) // 3), _side(len(w) // 3), 3, -1).transpose(3, 2, 0, 1),),
)
_POSITIONS = Form(
    lambda x: (x[0, 0], x[0, 1:].reshape(_side(x.shape[1]), _side(x.shape[1]), -1)),
    lambda first, grid: (np.concatenate([first[None], grid.reshape(-1, grid.shape[-1])])[None],),
)
_QKV = Form(lambda q, k, v: (np.concatenate([q, k, v]).T,), lambda w: tuple(np.split(w.T, 3)))
_QKV_BIAS = Form(lambda q, k, v: (np.concatenate([q, k, v]),), lambda b: tuple(np.split(b, 3)))


class Extra(NamedTuple):
    """An array of theirs that no model of ours uses, kept so that the way back is exact."""

    name: str
    theirs: str
    shape: tuple[int, ...]
    dtype: type


def _affine(ours: str, theirs: str, form: Form, *, bias: bool = True) -> Iterator[Entry]:
    yield Entry((f"{ours}.weight",), (f"{theirs}.weight",), form)
    if bias:
        yield Entry((f"{ours}.bias",), (f"{theirs}.bias",), _SAME)


def vit_lines(config: ViTConfig, prefix: str) -> Iterator[Entry | Extra]:
    """The backbone, under facebookresearch/dinov2's names, adapters under CricaVPR's."""
    yield Entry(("backbone.cls_token",), (f"{prefix}cls_token",), _CLASS_TOKEN)
    yield Entry(
        ("backbone.pos_embed_cls", "backbone.pos_embed"), (f"{prefix}pos_embed",), _POSITIONS
    )
    if config.registers:
        yield Entry(("backbone.register_tokens",), (f"{prefix}register_tokens",), _FIRST)
    yield Extra("backbone.mask_token", f"{prefix}mask_token", (1, config.dim), np.float32)
    yield from _affine("backbone.patch_embed", f"{prefix}patch_embed.proj", _PATCHES)
    for i in range(config.depth):
        ours, theirs = f"backbone.blocks.{i}", f"{prefix}blocks.{i}"
        yield from _affine(f"{ours}.norm1", f"{theirs}.norm1", _SAME)
        yield from _affine(f"{ours}.attn.qkv", f"{theirs}.attn.qkv", _LINEAR)
        yield from _affine(f"{ours}.attn.proj", f"{theirs}.attn.proj", _LINEAR)
        yield Entry((f"{ours}.ls1",), (f"{theirs}.ls1.gamma",), _SAME)
        yield from _affine(f"{ours}.norm2", f"{theirs}.norm2", _SAME)
        for name in ("w12", "w3") if config.ffn == "swiglu" else ("fc1", "fc2"):
            yield from _affine(f"{ours}.mlp.{name}", f"{theirs}.mlp.{name}", _LINEAR)
        yield Entry((f"{ours}.ls2",), (f"{theirs}.ls2.gamma",), _SAME)
        yield from adapter_lines(config, f"{ours}.adapter", f"{theirs}.adapter")
    yield from _affine("backbone.norm", f"{prefix}norm", _SAME)


def adapter_lines(config: ViTConfig, ours: str, theirs: str) -> Iterator[Entry | Extra]:
    """One block's adapter: CricaVPR's names, and for the others names in their manner."""
    kind = config.adapter.kind
    if kind == "multi-resolution":
        for branch in ("branch1", "branch2.0", "branch2.1", "branch3.0", "branch3.1"):
            here, there = f"{ours}.{branch}", f"{theirs}.{branch}"
            yield from _affine(f"{here}.conv", f"{there}.conv", _CONV)
            yield from _affine(f"{here}.norm", f"{there}.bn", _SAME)
            for name in ("running_mean", "running_var"):
                yield Entry((f"{here}.norm.{name}",), (f"{there}.bn.{name}",), _SAME)
            count = "num_batches_tracked"
            yield Extra(f"{here}.norm.{count}", f"{there}.bn.{count}", (), np.int64)
    bias = kind != "depthwise"
    if kind != "none":
        yield from _affine(f"{ours}.down", f"{theirs}.D_fc1", _LINEAR, bias=bias)
    if kind == "depthwise":
        yield from _affine(f"{ours}.depthwise", f"{theirs}.depthwise", _DEPTHWISE)
        yield from _affine(f"{ours}.pointwise", f"{theirs}.pointwise", _POINTWISE)
    if kind != "none":
        yield from _affine(f"{ours}.up", f"{theirs}.D_fc2", _LINEAR, bias=bias)


def hugging_face_lines(config: ViTConfig) -> Iterator[Entry | Extra]:
    """The backbone under the names of transformers' Dinov2Model and Dinov2WithRegistersModel."""
    above = "embeddings"
    yield Entry(("backbone.cls_token",), (f"{above}.cls_token",), _CLASS_TOKEN)
    yield Extra("backbone.mask_token", f"{above}.mask_token", (1, config.dim), np.float32)
    if config.registers:
        yield Entry(("backbone.register_tokens",), (f"{above}.register_tokens",), _FIRST)
    yield Entry(
        ("backbone.pos_embed_cls", "backbone.pos_embed"),
        (f"{above}.position_embeddings",),
        _POSITIONS,
    )
    yield from _affine("backbone.patch_embed", f"{above}.patch_embeddings.projection", _PATCHES)
    feed_forward = (
        (("w12", "weights_in"), ("w3", "weights_out"))
        if config.ffn == "swiglu"
        else (("fc1", "fc1"), ("fc2", "fc2"))
    )
    for i in range(config.depth):
        ours, theirs = f"backbone.blocks.{i}", f"encoder.layer.{i}"
        three = [f"{theirs}.attention.attention.{name}" for name in ("query", "key", "value")]
        yield from _affine(f"{ours}.norm1", f"{theirs}.norm1", _SAME)
        weights, biases = (tuple(f"{n}.{leaf}" for n in three) for leaf in ("weight", "bias"))
        yield Entry((f"{ours}.attn.qkv.weight",), weights, _QKV)
        yield Entry((f"{ours}.attn.qkv.bias",), biases, _QKV_BIAS)
        yield from _affine(f"{ours}.attn.proj", f"{theirs}.attention.output.dense", _LINEAR)
        yield Entry((f"{ours}.ls1",), (f"{theirs}.layer_scale1.lambda1",), _SAME)
        yield from _affine(f"{ours}.norm2", f"{theirs}.norm2", _SAME)
        for here, there in feed_forward:
            yield from _affine(f"{ours}.mlp.{here}", f"{theirs}.mlp.{there}", _LINEAR)
        yield Entry((f"{ours}.ls2",), (f"{theirs}.layer_scale2.lambda1",), _SAME)
    yield from _affine("backbone.norm", "layernorm", _SAME)


def aggregator_lines(config: ModelConfig) -> Iterator[Entry]:
    """Each aggregator under the names of its public checkpoint; TransVPR's and AnyLoc's are ours.

    Those are serizba/salad, Lu-Feng/CricaVPR, gmberton/CosPlace (and EigenPlaces), amaralibey's
    gsv-cities, MixVPR and Bag-of-Queries, and Nanne/pytorch-NetVlad.
    """
    if config.aggregator in ("gem-pyramid", "gem", "cosplace"):
        yield Entry(("aggregator.p",), ("aggregation.1.p",), _FIRST)
    if config.aggregator == "cosplace":
        yield from _affine("aggregator.fc", "aggregation.3", _LINEAR)
    if config.aggregator == "conv-ap":
        yield from _affine("aggregator.channel_pool", "aggregator.channel_pool", _POINTWISE)
    if config.aggregator == "mixvpr":
        yield from mixvpr_lines(config.mixvpr)
    if config.aggregator == "boq":
        yield from boq_lines(config.boq)
    if config.aggregator == "salad":
        yield from salad_lines(config.salad)
    if config.aggregator == "transvpr":
        yield from _affine("aggregator.attention", "aggregator.attention", _LINEAR, bias=False)
        yield from _affine("aggregator.reduction", "aggregator.reduction", _LINEAR)
    if config.aggregator == "netvlad":
        yield from _affine("aggregator.conv", "aggregator.conv", _POINTWISE, bias=False)
        yield Entry(("aggregator.centroids",), ("aggregator.centroids",), _SAME)
    if config.aggregator == "anyloc":
        yield Entry(("aggregator.words",), ("aggregator.words",), _SAME)
        yield Entry(("aggregator.backbone",), ("aggregator.backbone",), _SAME)


def mixvpr_lines(config: MixVprConfig) -> Iterator[Entry]:
    """MixVPR under amaralibey/MixVPR's names: mixers are layer norm, linear, ReLU, linear."""
    for i in range(config.depth):
        ours, theirs = f"aggregator.mix.{i}", f"aggregator.mix.{i}.mix"
        yield from _affine(f"{ours}.norm", f"{theirs}.0", _SAME)
        yield from _affine(f"{ours}.fc1", f"{theirs}.1", _LINEAR)
        yield from _affine(f"{ours}.fc2", f"{theirs}.3", _LINEAR)
    for name in ("channel_proj", "row_proj"):
        yield from _affine(f"aggregator.{name}", f"aggregator.{name}", _LINEAR)


def boq_lines(config: BoqConfig) -> Iterator[Entry]:
    """BoQ under amaralibey/Bag-of-Queries' names."""
    yield from _affine("aggregator.proj_c", "aggregator.proj_c", _CONV)
    yield from _affine("aggregator.norm_input", "aggregator.norm_input", _SAME)
    for i in range(config.layers):
        here = f"aggregator.boqs.{i}"
        yield Entry((f"{here}.queries",), (f"{here}.queries",), _FIRST)
        yield from _layer_lines(f"{here}.encoder")
        for attention, norm in (("self_attn", "norm_q"), ("cross_attn", "norm_out")):
            yield from _attention_lines(f"{here}.{attention}", f"{here}.{attention}")
            yield from _affine(f"{here}.{norm}", f"{here}.{norm}", _SAME)
    yield from _affine("aggregator.fc", "aggregator.fc", _LINEAR)


def salad_lines(config: SaladConfig) -> Iterator[Entry]:
    """SALAD under serizba/salad's names."""
    if config.sinkhorn.dustbin not in ("none", "token"):
        yield Entry(("aggregator.dust_bin",), ("aggregator.dust_bin",), _SAME)
    for name, second, form in (
        ("token_features", 2, _LINEAR),
        ("cluster_features", 3, _POINTWISE),
        ("score", 3, _POINTWISE),
    ):
        yield from _affine(f"aggregator.{name}.fc1", f"aggregator.{name}.0", form)
        yield from _affine(f"aggregator.{name}.fc2", f"aggregator.{name}.{second}", form)


def encoder_lines(config: CrossImageConfig) -> Iterator[Entry]:
    """The cross-image encoder under torch.nn.TransformerEncoder's names."""
    for i in range(config.layers):
        yield from _layer_lines(f"encoder.layers.{i}")


def _layer_lines(here: str) -> Iterator[Entry]:
    """One layer, under torch.nn.TransformerEncoderLayer's names."""
    yield from _attention_lines(f"{here}.attn", f"{here}.self_attn")
    for name, form in (
        ("linear1", _LINEAR),
        ("linear2", _LINEAR),
        ("norm1", _SAME),
        ("norm2", _SAME),
    ):
        yield from _affine(f"{here}.{name}", f"{here}.{name}", form)


def _attention_lines(ours: str, theirs: str) -> Iterator[Entry]:
    """One attention, under torch.nn.MultiheadAttention's names."""
    for leaf, form in (("weight", _LINEAR), ("bias", _SAME)):
        yield Entry((f"{ours}.qkv.{leaf}",), (f"{theirs}.in_proj_{leaf}",), form)
    yield from _affine(f"{ours}.proj", f"{theirs}.out_proj", _LINEAR)


def table(config: ModelConfig, layout: str) -> list[Entry | Extra]:
    """What `layout` holds of a model, in the public order, without the prefix `module.`.

    Raises:
        InputError: no such layout, or the model has parts that it cannot hold.
    """
    names = choose("layout", layout, LAYOUTS)
    parts = (config.aggregator, config.backbone.adapter.kind, config.encoder.layers > 0)
    wanted = {
        "dinov2": ("class-token", "none", False),
        "huggingface": ("class-token", "none", False),
        "dino-salad": ("salad", "none", False),
        "cricavpr": ("gem-pyramid", "multi-resolution", True),
        "reference": parts,
    }[layout]
    if parts != wanted:
        raise InputError(
            f"layout {layout}: found a model of {_words(parts)}, expected {_words(wanted)} "
            "(layout reference holds any)"
        )
    if layout == "huggingface":
        return list(hugging_face_lines(config.backbone))
    return [
        *vit_lines(config.backbone, names.backbone),
        *aggregator_lines(config),
        *encoder_lines(config.encoder),
    ]


def check_holds(config: ModelConfig, layout: str, extras: State | None = None) -> None:
    """Check that a model can be written in `layout` and read back as the same model.

    Raises:
        InputError: what `table` raises; a setting that no shape tells and that differs from the
            published one, which reading would take for it; or extras that the layout has no place
            for.
    """
    lines = [line for line in table(config, layout) if isinstance(line, Extra)]
    if layout != "reference":
        shapes = public_shapes(config, layout)
        blank = {name: np.broadcast_to(np.float32(0), shape) for name, shape in shapes.items()}
        read_back = dataclasses.replace(_infer(blank)[1], image_size=config.image_size)
        wrong = differences(_told(read_back), _told(config))
        if wrong:
            raise InputError(
                f"layout {layout}: cannot tell these apart from the published ones: "
                f"{'; '.join(wrong)} (layout reference can)"
            )
    for line in lines:
        array = (extras or {}).get(line.name)
        if array is None:
            continue
        if (array.shape, array.dtype) != (line.shape, np.dtype(line.dtype)):
            raise InputError(
                f"extra.{line.name}: found {array.dtype} {array.shape}, expected "
                f"{np.dtype(line.dtype)} {line.shape}"
            )
        if not np.isfinite(array).all():
            raise InputError(f"extra.{line.name}: holds NaN or infinity")


def _told(config: ModelConfig) -> ModelConfig:
    """A configuration with the same value in all that says nothing about the finished model."""
    backbone, adapter = config.backbone, config.backbone.adapter
    if adapter.kind == "none":
        adapter = AdapterConfig(kind="none")
    elif adapter.kind != "depthwise":
        adapter = dataclasses.replace(adapter, kernel_size=AdapterConfig.kernel_size)
    if adapter.kind != "none":
        adapter = dataclasses.replace(adapter, bottleneck=backbone.adapter_dim / backbone.dim)
    backbone = dataclasses.replace(
        backbone,
        mlp_ratio=backbone.hidden / backbone.dim,
        position_start=ViTConfig.position_start,
        layer_scale_start=ViTConfig.layer_scale_start,
        adapter=adapter,
    )
    others = {
        f: type(getattr(config, f))() for n, f in AGGREGATORS.items() if n != config.aggregator
    }
    config = dataclasses.replace(config, **others)
    encoder = config.encoder if config.encoder.layers else CrossImageConfig(layers=0)
    return dataclasses.replace(
        config,
        backbone=backbone,
        salad=dataclasses.replace(config.salad, dropout=0.0),
        encoder=dataclasses.replace(encoder, dropout=0.0),
        compute_dtype=ModelConfig.compute_dtype,
    )


def public_shapes(config: ModelConfig, layout: str) -> dict[str, tuple[int, ...]]:
    """Every name of a layout and its shape, in the public order.

    Raises:
        InputError: what `table` raises.
    """
    wanted = _numbered(named_leaves(parameter_shapes(config)))
    shapes: dict[str, tuple[int, ...]] = {}
    for line in table(config, layout):
        if isinstance(line, Extra):
            shapes[line.theirs] = line.shape
        else:
            # Arrays that repeat one number tell shapes without memory of their own.
            blanks = (np.broadcast_to(np.float32(0), wanted[name].shape) for name in line.ours)
            arrays = line.form.theirs(*blanks)
            shapes |= {name: x.shape for name, x in zip(line.theirs, arrays, strict=True)}
    return shapes


def _words(parts: tuple[str, str, bool]) -> str:
    aggregator, adapter, encoder = parts
    return f"aggregator {aggregator}, adapter {adapter}, {'an' if encoder else 'no'} encoder"


def to_params(
    state: State, config: ModelConfig, layout: str, *, source: str
) -> tuple[Crisalad, dict[str, np.ndarray]]:
    """Arrays by public name to (parameters, extras), as numpy arrays of the types they have.

    The extras are what public checkpoints hold and no description needs: DINOv2's mask token, and
    batch norm's count of batches.

    Raises:
        InputError: naming `source` and every name that is missing, unknown or misshaped.
    """
    shapes = public_shapes(config, layout)
    problems = [f"{name} missing" for name in shapes.keys() - state.keys()]
    problems += [f"{name} unknown" for name in state.keys() - shapes.keys()]
    problems += [
        f"{name} found {state[name].shape}, expected {shape}"
        for name, shape in shapes.items()
        if name in state and state[name].shape != shape
    ]
    if problems:
        raise InputError(
            f"{source}: does not fit the layout {layout} of {_size(config)}: "
            f"{'; '.join(sorted(problems, key=_natural))}"
        )
    ours: dict[str, np.ndarray] = {}
    extras: dict[str, np.ndarray] = {}
    for line in table(config, layout):
        if isinstance(line, Extra):
            extras[line.name] = state[line.theirs]
        else:
            arrays = line.form.ours(*(state[name] for name in line.theirs))
            ours |= zip(line.ours, arrays, strict=True)
    return _from_numbered(ours, config), extras


def to_state(
    params: Crisalad, config: ModelConfig, layout: str, extras: State
) -> dict[str, np.ndarray]:
    """Undo `to_params`, in the public order. Extras that are not given are 0, as at the start.

    Raises:
        InputError: the layout has no place for a part of this model.
    """
    ours = _numbered(named_leaves(params))
    state: dict[str, np.ndarray] = {}
    for line in table(config, layout):
        if isinstance(line, Extra):
            state[line.theirs] = extras.get(line.name, np.zeros(line.shape, line.dtype))
        else:
            arrays = line.form.theirs(*(np.asarray(ours[name]) for name in line.ours))
            for name, array in zip(line.theirs, arrays, strict=True):
                state[name] = np.ascontiguousarray(array).reshape(array.shape)
    return state


_BLOCKS = "backbone.blocks."


def _numbered(leaves: Mapping[str, Any]) -> dict[str, Any]:
    """Stacks of blocks cut into the blocks, under names that number them."""
    cut: dict[str, Any] = {}
    for name, leaf in leaves.items():
        if not name.startswith(_BLOCKS):
            cut[name] = leaf
            continue
        for i in range(leaf.shape[0]):
            if isinstance(leaf, jax.ShapeDtypeStruct):
                one: Any = jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype)
            else:
                one = leaf[i]
            cut[f"{_BLOCKS}{i}.{name.removeprefix(_BLOCKS)}"] = one
    return cut


def _from_numbered(ours: State, config: ModelConfig) -> Crisalad:
    template = parameter_shapes(config)
    leaves = []
    for name, leaf in named_leaves(template).items():
        if name.startswith(_BLOCKS):
            inner = name.removeprefix(_BLOCKS)
            leaves.append(np.stack([ours[f"{_BLOCKS}{i}.{inner}"] for i in range(leaf.shape[0])]))
        else:
            # What has no numbers, such as absent registers, has no line in any table.
            leaves.append(ours[name] if leaf.size else np.zeros(leaf.shape, leaf.dtype))
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def _size(config: ModelConfig) -> str:
    backbone = config.backbone
    return f"width {backbone.dim} and {backbone.depth} blocks"


def _natural(text: str) -> list[Any]:
    """A key under which block 10 comes after block 9."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", text)]


def infer(state: State, *, source: str) -> tuple[str, ModelConfig]:
    """The layout and the configuration of a state, from its names and shapes.

    What no shape tells is as published: heads of width 64 in the backbone and 16 heads in the
    encoder, alpha 0.2, three Sinkhorn iterations, and images of 224 x 224 (DINO-SALAD: 322 x 322).

    Raises:
        InputError: naming `source`, if the names are of no layout or the widths of no model.
    """
    try:
        return _infer(state)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error


def _infer(state: State) -> tuple[str, ModelConfig]:
    layout = _layout_of(state)
    if layout == "huggingface":
        backbone = _hugging_face_config(_Reader(state))
        return layout, _whole(backbone=backbone, aggregator="class-token", layers=0)
    backbone = _vit_config(_Reader(state, LAYOUTS[layout].backbone))
    head = _Reader(state)
    if "aggregator.score.3.weight" in state:
        salad = SaladConfig(
            clusters=head.size("aggregator.score.3.weight", 0),
            cluster_dim=head.size("aggregator.cluster_features.3.weight", 0),
            token_dim=head.size("aggregator.token_features.2.weight", 0),
            hidden=head.size("aggregator.score.0.weight", 0),
        )
        aggregator = "salad"
    else:
        salad = None
        aggregator = "gem-pyramid" if "aggregation.1.p" in state else "class-token"
    layers = head.count("encoder.layers.")
    return layout, _whole(
        backbone=backbone,
        aggregator=aggregator,
        salad=salad,
        layers=layers,
        feedforward=head.size("encoder.layers.0.linear1.weight", 0) if layers else None,
        image_size=(322, 322) if layout == "dino-salad" else (224, 224),
    )


def _layout_of(state: State) -> str:
    if "embeddings.cls_token" in state or "embeddings.position_embeddings" in state:
        return "huggingface"
    for layout in ("dino-salad", "cricavpr", "dinov2"):
        prefix = LAYOUTS[layout].backbone
        if f"{prefix}cls_token" in state or f"{prefix}pos_embed" in state:
            reference = layout == "cricavpr" and "aggregation.1.p" not in state
            return "reference" if reference else layout
    names = ", ".join(sorted(state)[:3]) or "none"
    raise InputError(
        f"found no checkpoint that we know (its first names: {names}); expected "
        f"{', '.join(layout.holds for layout in LAYOUTS.values())}"
    )


class _Reader(NamedTuple):
    """Shapes of a state under a prefix, with one clear error where a name is missing."""

    state: State
    prefix: str = ""

    def size(self, name: str, axis: int) -> int:
        name = self.prefix + name
        if name not in self.state:
            raise InputError(f"found no {name}, expected it beside the others")
        shape = self.state[name].shape
        if len(shape) <= axis or not shape[axis]:
            raise InputError(
                f"{name} found of shape {shape}, expected more than {axis} axes, none of them empty"
            )
        return shape[axis]

    def has(self, name: str) -> bool:
        return self.prefix + name in self.state

    def count(self, name: str) -> int:
        """How many numbers from 0 on follow a name."""
        heads = {key[: key.find(".", len(self.prefix + name))] for key in self.state}
        return next(i for i in range(len(heads) + 1) if f"{self.prefix}{name}{i}" not in heads)


def _vit_config(read: _Reader) -> ViTConfig:
    gated = read.has("blocks.0.mlp.w12.weight")
    width = read.size("cls_token", 2)
    if read.has("blocks.0.adapter.branch1.conv.weight"):
        kind = "multi-resolution"
    elif read.has("blocks.0.adapter.depthwise.weight"):
        kind = "depthwise"
    else:
        kind = "mlp" if read.has("blocks.0.adapter.D_fc1.weight") else "none"
    adapter = AdapterConfig(kind=kind)
    if kind != "none":
        down = read.size("blocks.0.adapter.D_fc1.weight", 0)
        adapter = dataclasses.replace(adapter, bottleneck=down / width)
    if kind == "depthwise":
        side = read.size("blocks.0.adapter.depthwise.weight", 2)
        adapter = dataclasses.replace(adapter, kernel_size=side)
    return _backbone(
        dim=width,
        depth=read.count("blocks."),
        hidden=read.size("blocks.0.mlp.w3.weight" if gated else "blocks.0.mlp.fc1.weight", gated),
        gated=gated,
        registers=read.size("register_tokens", 1) if read.has("register_tokens") else 0,
        positions=read.size("pos_embed", 1),
        adapter=adapter,
    )


def _hugging_face_config(read: _Reader) -> ViTConfig:
    block, above = "encoder.layer.0.mlp.", "embeddings."
    gated = read.has(f"{block}weights_in.weight")
    registers = f"{above}register_tokens"
    return _backbone(
        dim=read.size(f"{above}cls_token", 2),
        depth=read.count("encoder.layer."),
        hidden=read.size(f"{block}{'weights_out' if gated else 'fc1'}.weight", gated),
        gated=gated,
        registers=read.size(registers, 1) if read.has(registers) else 0,
        positions=read.size(f"{above}position_embeddings", 1),
        adapter=AdapterConfig(kind="none"),
    )


def _backbone(
    *,
    dim: int,
    depth: int,
    hidden: int,
    gated: bool,
    registers: int,
    positions: int,
    adapter: AdapterConfig,
) -> ViTConfig:
    side = _side(positions - 1)
    if side**2 != positions - 1 or not side:
        raise InputError(f"found {positions} position embeddings, expected 1 and a square number")
    if dim % HEAD_WIDTH:
        raise InputError(
            f"found a backbone of width {dim}, expected a multiple of {HEAD_WIDTH}: "
            "DINOv2's heads have that width, and no shape tells another"
        )
    # The configuration knows the ratio: of SwiGLU's two thirds, 4 where they are DINOv2's.
    ratios = (4.0, 1.5 * hidden / dim) if gated else (hidden / dim,)
    for ratio in ratios:
        config = ViTConfig(
            dim=dim,
            depth=depth,
            heads=dim // HEAD_WIDTH,
            mlp_ratio=ratio,
            ffn="swiglu" if gated else "mlp",
            registers=registers,
            position_grid=side,
            adapter=adapter,
        )
        if config.hidden == hidden:
            return config
    raise InputError(f"found a feed-forward width of {hidden}, expected a multiple of 8 for SwiGLU")


def _whole(
    *,
    backbone: ViTConfig,
    aggregator: Any,
    layers: int,
    salad: SaladConfig | None = None,
    feedforward: int | None = None,
    image_size: tuple[int, int] = (224, 224),
) -> ModelConfig:
    encoder = CrossImageConfig(layers=layers, heads=ENCODER_HEADS)
    if feedforward is not None:
        encoder = dataclasses.replace(encoder, feedforward=feedforward)
    return ModelConfig(
        image_size=image_size,
        backbone=backbone,
        aggregator=aggregator,
        salad=salad or SaladConfig(),
        encoder=encoder,
    )
