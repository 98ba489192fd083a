"""The layouts of chenshunpeng/FoL (Wang et al., AAAI 2025): SALAD's head and local features.

Published files still have the dustbin's score of the SALAD head that they began from, which the
public code no longer reads: those who load FoL_large.pth strictly find it there. What that code
saves today has none, and is a layout of its own.
"""

from collections.abc import Iterator

import numpy as np

from crisalad_jax.checkpoints.layouts.base import Lines, Reader, State, register_head
from crisalad_jax.checkpoints.layouts.dino_salad import infer_salad, network_lines
from crisalad_jax.checkpoints.layouts.forms import UPCONV, Entry, Extra, affine
from crisalad_jax.checkpoints.layouts.over_dinov2 import register_over_dinov2
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators.salad import FolConfig


@register_head("fol")
def fol_lines(config: FolConfig) -> Iterator[Entry]:
    """Yield SALAD's networks, and the transposed convolutions."""
    yield from network_lines("aggregator.")
    for ours, theirs in (("upconv1", "upconv"), ("upconv2", "upconv2")):
        yield from affine(f"aggregator.{ours}", theirs, UPCONV)


def _published_lines(config: FolConfig) -> Lines:
    """Yield the score that nothing reads, then the rest."""
    yield Extra("aggregator.dust_bin", "aggregator.dust_bin", (), np.float32)
    yield from fol_lines(config)


def infer_fol(state: State) -> FolConfig:
    """Infer SALAD's sizes, and the widths of the local features and of the layer before them."""
    salad, read = infer_salad(state), Reader(state)
    return FolConfig(
        clusters=salad.clusters,
        cluster_dim=salad.cluster_dim,
        token_dim=salad.token_dim,
        hidden=salad.hidden,
        local_hidden=read.size("upconv.bias", 0),
        local=read.size("upconv2.bias", 0),
    )


for _name, _holds, _lines in (
    ("fol", "FoL .pth", _published_lines),
    ("fol-without-dustbin", "FoL .pth of newer code", fol_lines),
):
    register_over_dinov2(
        _name,
        _holds,
        "fol",
        infer_fol,
        prefix="backbone.model.",
        mark="upconv.weight",
        head=_lines,
        image_size=(504, 504),
        # Tensors at torchvision 0.15.1, which does not antialias them unasked.
        preprocessing=PreprocessingConfig(antialias=False, pixels="floats"),
        module="module.",
        under="model_state_dict",
    )
