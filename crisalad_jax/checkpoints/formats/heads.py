"""How public checkpoints name the parameters of each aggregator."""

from typing import Any

import numpy as np

from crisalad_jax.checkpoints.formats.format import Head, Reader
from crisalad_jax.checkpoints.formats.forms import (
    CONV,
    FIRST,
    LINEAR,
    POINTWISE,
    SAME,
    UPCONV,
    Absent,
    Entry,
    Extra,
    Form,
    Lines,
    affine,
    affines,
    torch_attention,
    transformer_layer,
)
from crisalad_jax.nn.aggregators import Aggregator
from crisalad_jax.nn.aggregators.backbone_tokens import AggregationTokensConfig, ClassTokenConfig
from crisalad_jax.nn.aggregators.conv_ap import ConvApConfig
from crisalad_jax.nn.aggregators.gem import START, CosPlaceConfig, GemConfig, GemPyramidConfig
from crisalad_jax.nn.aggregators.mixvpr import MixVprConfig
from crisalad_jax.nn.aggregators.queries import BoqConfig, EdtFormerConfig
from crisalad_jax.nn.aggregators.salad import FolConfig, SaladConfig
from crisalad_jax.nn.aggregators.selavpr import SelaVprConfig
from crisalad_jax.nn.aggregators.transvpr import TransVprConfig
from crisalad_jax.nn.aggregators.vlad import (
    AnyLocConfig,
    NetVladConfig,
    SuperVladConfig,
    VladBuffConfig,
)
from crisalad_jax.nn.backbones.vgg import VggConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import parameter_shapes
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.pytree import named_leaves

_EXPONENT = "aggregation.1.p"


def head_lines(config: ModelConfig) -> Lines:
    """Yield an aggregator's table, with its own names where no public checkpoint has others."""
    head = HEADS.get(config.aggregator.part_name)
    if head is not None:
        yield from head.lines(config.aggregator, head.prefix)
        return
    for name, leaf in named_leaves(parameter_shapes(config)).items():
        if name.startswith("aggregator") and leaf.size:
            yield Entry((name,), (name,), SAME)


# SALAD (serizba/salad), and FoL (chenshunpeng/FoL), which has its networks.


def _salad_lines(config: SaladConfig, prefix: str) -> Lines:
    if config.dustbin.part_name in ("column", "row and column", "mass"):
        yield Entry(("aggregator.dust_bin",), (f"{prefix}dust_bin",), SAME)
    yield from _network_lines(prefix)


def _network_lines(prefix: str) -> Lines:
    """Yield the three networks over features."""
    for name, second, form in (
        ("token_features", 2, LINEAR),
        ("cluster_features", 3, POINTWISE),
        ("score", 3, POINTWISE),
    ):
        yield from affine(f"aggregator.{name}.fc1", f"{prefix}{name}.0", form)
        yield from affine(f"aggregator.{name}.fc2", f"{prefix}{name}.{second}", form)


def _network_sizes(read: Reader) -> dict[str, Any]:
    return {
        "clusters": read.size("score.3.weight", 0),
        "cluster_dim": read.size("cluster_features.3.weight", 0),
        "token_dim": read.size("token_features.2.weight", 0),
        "hidden": read.size("score.0.weight", 0),
    }


SALAD = Head(
    "salad", _salad_lines, lambda read: SaladConfig(**_network_sizes(read)), "score.3.weight"
)


def _fol_lines(config: FolConfig, prefix: str) -> Lines:
    yield from _network_lines(f"{prefix}aggregator.")
    for ours, theirs in (("upconv1", "upconv"), ("upconv2", "upconv2")):
        yield from affine(f"aggregator.{ours}", f"{prefix}{theirs}", UPCONV)


def _infer_fol(read: Reader) -> FolConfig:
    return FolConfig(
        **_network_sizes(Reader(read.state, f"{read.prefix}aggregator.")),
        local_hidden=read.size("upconv.bias", 0),
        local=read.size("upconv2.bias", 0),
    )


FOL = Head("fol", _fol_lines, _infer_fol, "upconv.weight", "")


def _published_fol_lines(config: FolConfig, prefix: str) -> Lines:
    """Yield the dustbin's score of the SALAD that training began from, then the rest.

    The public code no longer reads it, but who loads FoL_large.pth strictly finds it there.
    """
    dustbin = f"{prefix}aggregator.dust_bin"
    yield Extra("aggregator.dust_bin", dustbin, (), np.float32)
    yield from _fol_lines(config, prefix)


PUBLISHED_FOL = FOL._replace(lines=_published_fol_lines)


# Generalised means: CosPlace and EigenPlaces (gmberton), CricaVPR and SelaVPR (Lu-Feng).


def _exponent_lines(config: Aggregator, prefix: str) -> Lines:
    yield Entry(("aggregator.p",), (f"{prefix}{_EXPONENT}",), FIRST)


GEM = Head("gem", _exponent_lines, lambda read: GemConfig(), _EXPONENT, "")
GEM_PYRAMID = Head("gem-pyramid", _exponent_lines, lambda read: GemPyramidConfig(), _EXPONENT, "")


def _cosplace_lines(config: CosPlaceConfig, prefix: str) -> Lines:
    yield from _exponent_lines(config, prefix)
    yield from affine("aggregator.fc", f"{prefix}aggregation.3", LINEAR)


COSPLACE = Head(
    "cosplace",
    _cosplace_lines,
    lambda read: CosPlaceConfig(dim=read.size("aggregation.3.weight", 0)),
    "aggregation.3.weight",
    "",
)


def _selavpr_lines(config: SelaVprConfig, prefix: str) -> Lines:
    yield from _exponent_lines(config, prefix)
    layers = {"upconv1": UPCONV, "upconv2": UPCONV}
    yield from affines("aggregator.", f"{prefix}LocalAdapt.", layers)


SELAVPR = Head(
    "selavpr",
    _selavpr_lines,
    lambda read: SelaVprConfig(*(read.size(f"LocalAdapt.upconv{i}.bias", 0) for i in (1, 2))),
    "LocalAdapt.upconv1.weight",
    "",
)


# torchvision's files have none: the exponent is 3.
WITHOUT_EXPONENT = GEM._replace(lines=lambda config, prefix: iter([Absent("aggregator.p", START)]))


# VLAD: NetVLAD (Nanne/pytorch-NetVlad, hloc, the authors' own), SuperVLAD and VLAD-BuFF.


def _netvlad_lines(config: NetVladConfig, prefix: str) -> Lines:
    yield Entry(("aggregator.centroids",), (f"{prefix}centroids",), SAME)
    yield from affine("aggregator.conv", f"{prefix}conv", POINTWISE, bias=False)


NETVLAD = Head(
    "netvlad",
    _netvlad_lines,
    lambda read: NetVladConfig(clusters=read.size("centroids", 0)),
    "centroids",
)


def _hloc_lines(config: NetVladConfig, prefix: str) -> Lines:
    scores = Form(lambda w: (w[:, :, 0].T,), lambda w: (w.T[:, :, None],))
    yield Entry(("aggregator.centroids",), (f"{prefix}centers",), LINEAR)
    yield Entry(("aggregator.conv.weight",), (f"{prefix}score_proj.weight",), scores)


NETVLAD_HLOC = Head(
    "netvlad",
    _hloc_lines,
    lambda read: NetVladConfig(clusters=read.size("centers", 1)),
    "centers",
    "netvlad.",
)


def _by_cluster(rows: np.ndarray) -> np.ndarray:
    """Reorder rows of (channel, cluster) to rows of (cluster, channel)."""
    return rows.reshape(VggConfig().dim, -1, rows.shape[1]).swapaxes(0, 1).reshape(rows.shape)


def _by_channel(rows: np.ndarray) -> np.ndarray:
    return rows.reshape(-1, VggConfig().dim, rows.shape[1]).swapaxes(0, 1).reshape(rows.shape)


# There a descriptor has all clusters' first channel before whitening, then all their second.
HLOC_WHITENING = Form(lambda w: (_by_cluster(w.T),), lambda w: (_by_channel(w).T,))


def _supervlad_lines(config: SuperVladConfig, prefix: str) -> Lines:
    yield from affine("aggregator.conv", f"{prefix}conv", POINTWISE, bias=False)


def _infer_supervlad(read: Reader) -> SuperVladConfig:
    """Infer the number of clusters; no shape tells the published files' ghosts from them."""
    name = f"{read.prefix}conv.weight"
    count = read.size("conv.weight", 0)
    if count not in (3, 5):
        raise InputError(f"{name} found of {count} clusters, expected 5 (1 ghost) or 3 (2 ghosts)")
    ghosts = 1 if count == 5 else 2
    if ghosts == 2:
        warn(
            f"{name}: found 3 clusters, read as 1 and 2 ghosts, as in 1-clusterVLAD.pth; "
            "one of 2 and a ghost (--supervlad_clusters=2) has the same shape, and cannot be read"
        )
    return SuperVladConfig(count - ghosts, ghosts)


SUPERVLAD = Head("supervlad", _supervlad_lines, _infer_supervlad, "conv.weight", "aggregation.")


def _vlad_buff_lines(config: VladBuffConfig, prefix: str) -> Lines:
    if config.reduced:
        yield Entry(("aggregator.reduction.mean",), (f"{prefix}pca_mean",), SAME)
        yield Entry(("aggregator.reduction.rotation",), (f"{prefix}pca_rot",), LINEAR)
    yield Entry(("aggregator.centroids",), (f"{prefix}centroids",), SAME)
    yield Entry(("aggregator.burst",), (f"{prefix}ab_params",), SAME)
    yield from affine("aggregator.conv", f"{prefix}conv", POINTWISE, bias=False)


def _infer_vlad_buff(read: Reader) -> VladBuffConfig:
    return VladBuffConfig(
        clusters=read.size("centroids", 0),
        reduced=read.size("pca_rot", 0) if read.has("pca_rot") else 0,
    )


VLAD_BUFF = Head("vlad-buff", _vlad_buff_lines, _infer_vlad_buff, "ab_params")


# Decoders and mixers: BoQ, MixVPR and Conv-AP (amaralibey), EDTformer (Tong-Jin01).


def _boq_lines(config: BoqConfig, prefix: str) -> Lines:
    yield from affine("aggregator.proj_c", f"{prefix}proj_c", CONV)
    yield from affine("aggregator.norm_input", f"{prefix}norm_input", SAME)
    for i in range(config.layers):
        ours, theirs = f"aggregator.boqs.{i}", f"{prefix}boqs.{i}"
        yield Entry((f"{ours}.queries",), (f"{theirs}.queries",), FIRST)
        yield from transformer_layer(f"{ours}.encoder", f"{theirs}.encoder")
        for attention, norm in (("self_attn", "norm_q"), ("cross_attn", "norm_out")):
            yield from torch_attention(f"{ours}.{attention}", f"{theirs}.{attention}")
            yield from affine(f"{ours}.{norm}", f"{theirs}.{norm}", SAME)
    yield from affine("aggregator.fc", f"{prefix}fc", LINEAR)


def _infer_boq(read: Reader) -> BoqConfig:
    return BoqConfig(
        channels=read.size("proj_c.weight", 0),
        queries=read.size("boqs.0.queries", 1),
        layers=read.count("boqs."),
        rows=read.size("fc.weight", 0),
    )


BOQ = Head("boq", _boq_lines, _infer_boq, "proj_c.weight")


def _mixvpr_lines(config: MixVprConfig, prefix: str) -> Lines:
    """Yield the table; mixers are layer norm, linear, ReLU, linear."""
    for i in range(config.depth):
        ours, theirs = f"aggregator.mix.{i}", f"{prefix}mix.{i}.mix"
        yield from affine(f"{ours}.norm", f"{theirs}.0", SAME)
        yield from affine(f"{ours}.fc1", f"{theirs}.1", LINEAR)
        yield from affine(f"{ours}.fc2", f"{theirs}.3", LINEAR)
    yield from affines("aggregator.", prefix, {"channel_proj": LINEAR, "row_proj": LINEAR})


def _mixvpr(*, last_norm: bool) -> Head:
    """Return MixVPR's head; no shape tells whether patches go through the last layer norm."""

    def infer(read: Reader) -> MixVprConfig:
        return MixVprConfig(
            channels=read.size("channel_proj.weight", 0),
            rows=read.size("row_proj.weight", 0),
            depth=read.count("mix."),
            last_norm=last_norm,
        )

    return Head("mixvpr", _mixvpr_lines, infer, "row_proj.weight")


MIXVPR = _mixvpr(last_norm=True)  # which a ResNet has not: the field keeps its default
DINO_MIX = _mixvpr(last_norm=False)


def _conv_ap_lines(config: ConvApConfig, prefix: str) -> Lines:
    yield from affine("aggregator.channel_pool", f"{prefix}channel_pool", POINTWISE)


# No shape shows the regions, which are 2 x 2 when published.
CONV_AP = Head(
    "conv-ap",
    _conv_ap_lines,
    lambda read: ConvApConfig(channels=read.size("channel_pool.weight", 0)),
    "channel_pool.weight",
)


def _edtformer_lines(config: EdtFormerConfig, prefix: str) -> Lines:
    """Yield the decoder's table, the queries first."""
    yield Entry(("aggregator.queries",), (f"{prefix}queries",), FIRST)
    yield from affine("aggregator.fc", f"{prefix}fc", LINEAR)
    for i in range(config.layers):
        ours, theirs = f"aggregator.layers.{i}.", f"{prefix}decoder.layers.{i}."
        for name in ("self_attn", "multihead_attn"):
            yield from torch_attention(f"{ours}{name}", f"{theirs}{name}")
        yield from affines(ours, theirs, {"norm1": SAME, "norm2": SAME})
    yield from affines("aggregator.", prefix, {"channel_proj": LINEAR, "row_proj": LINEAR})


def _infer_edtformer(read: Reader) -> EdtFormerConfig:
    """Infer the decoder's sizes; the number of heads is the published one."""
    return EdtFormerConfig(
        width=read.size("queries", 2),
        layers=read.count("decoder.layers."),
        queries=read.size("queries", 1),
        channels=read.size("channel_proj.weight", 0),
        rows=read.size("row_proj.weight", 0),
    )


EDTFORMER = Head("edtformer", _edtformer_lines, _infer_edtformer, "queries", "")


# Tokens: the class token, ImAge (Lu-Feng) and TransVPR (RuotongWANG).


CLASS_TOKEN = Head(
    "class-token", lambda config, prefix: iter(()), lambda read: ClassTokenConfig(), None
)
_TOKENS = "learnable_aggregation_tokens"
# They enter before the last four blocks, as published.
AGGREGATION_TOKENS = Head(
    "aggregation-tokens",
    lambda config, prefix: iter([Entry(("aggregator.tokens",), (f"{prefix}{_TOKENS}",), FIRST)]),
    lambda read: AggregationTokensConfig(tokens=read.size(_TOKENS, 1)),
    _TOKENS,
    "",
)


def _transvpr_lines(config: TransVprConfig, prefix: str) -> Lines:
    yield from affine("aggregator.reduction", f"{prefix}fc.1", LINEAR)
    yield from affine("aggregator.attention", f"{prefix}attention_pool", LINEAR, bias=False)
    # The same for all patches, it has no effect on their softmax.
    bias = f"{prefix}attention_pool.bias"
    yield Extra("aggregator.attention.bias", bias, (config.levels,), np.float32)


def _infer_transvpr(read: Reader) -> TransVprConfig:
    return TransVprConfig(
        levels=read.size("attention_pool.weight", 0), dim=read.size("fc.1.weight", 0)
    )


TRANSVPR = Head("transvpr", _transvpr_lines, _infer_transvpr, "attention_pool.weight", "pool.")


def _own_transvpr_lines(config: TransVprConfig, prefix: str) -> Lines:
    """Yield both linear layers under our own names, for other backbones than TransVPR's."""
    yield from affine("aggregator.attention", f"{prefix}attention", LINEAR, bias=False)
    yield from affine("aggregator.reduction", f"{prefix}reduction", LINEAR)


# Only its vocabulary is published, by itself (AnyLoc/DINO).
ANYLOC = Head(
    "anyloc",
    lambda config, prefix: iter([Entry(("aggregator.words",), ("words",), SAME)]),
    lambda read: AnyLocConfig(clusters=read.size("words", 0)),
    None,
)

HEADS: dict[str, Head] = {
    head.aggregator: head
    for head in (
        *(AGGREGATION_TOKENS, BOQ, CONV_AP, COSPLACE, EDTFORMER, FOL, GEM, GEM_PYRAMID, MIXVPR),
        *(NETVLAD, SALAD, SELAVPR, SUPERVLAD, VLAD_BUFF),
        TRANSVPR._replace(lines=_own_transvpr_lines, prefix="aggregator."),
    )
}
"""Heads by the aggregator's name, for the layout that holds any."""
