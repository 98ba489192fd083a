"""The layouts of the NetVLAD that hloc reads: the authors' MATLAB file, and hloc's own module.

Names and axes are those of cvg/Hierarchical-Localization. There a descriptor has all clusters'
first channel before whitening, then all their second: rows of the projection are in another order.
"""

from collections.abc import Iterator

import numpy as np

from crisalad_jax.checkpoints.layouts.base import (
    Layout,
    Lines,
    Reader,
    State,
    register_layout,
)
from crisalad_jax.checkpoints.layouts.cnn import Names, accepts_head_over, vgg_numbers
from crisalad_jax.checkpoints.layouts.forms import LINEAR, SAME, Entry, Extra, Form
from crisalad_jax.checkpoints.layouts.over_cnn import register_over_cnn
from crisalad_jax.checkpoints.matlab_io import AVERAGE
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators.vlad import NetVladConfig
from crisalad_jax.nn.backbones.vgg import VggConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.nn.projection import ProjectionConfig

_DIM = VggConfig().dim
_AVERAGE_SIDE = 224
_LARGEST = (768, 1024)
"""Size of hloc's images, of which the longer side counts."""
_MEAN = (123.68, 116.779, 103.939)
"""Mean of red, green and blue of the network that NetVLAD starts from, VGG-16 of MatConvNet."""
_SCORES, _WHITENING = "net.layers[30]", "net.layers[33]"


def _by_cluster(rows: np.ndarray) -> np.ndarray:
    """Reorder rows of (channel, cluster) to rows of (cluster, channel)."""
    return rows.reshape(_DIM, -1, rows.shape[1]).swapaxes(0, 1).reshape(rows.shape)


def _by_channel(rows: np.ndarray) -> np.ndarray:
    return rows.reshape(-1, _DIM, rows.shape[1]).swapaxes(0, 1).reshape(rows.shape)


_WHITENING_ROWS = Form(lambda w: (_by_cluster(w),), lambda w: (_by_channel(w),))
_WHITENING_COLUMNS = Form(lambda w: (_by_cluster(w.T),), lambda w: (_by_channel(w).T,))
_SCORES_1D = Form(lambda w: (w[:, :, 0].T,), lambda w: (w.T[:, :, None],))
_OPPOSITE = Form(lambda c: (-c.T,), lambda c: (-c.T,))
"""MATLAB's file holds the centres with the other sign."""


def _chain(mean: tuple[float, float, float]) -> PreprocessingConfig:
    """Return hloc's chain: sides of at most 1,024, and pixels of 0 to 255 less a mean."""
    red, green, blue = mean
    return PreprocessingConfig(
        size_rule="longer-side",
        filter="area",
        pixels="floats",
        mean=(red / 255, green / 255, blue / 255),
        deviation=(1 / 255, 1 / 255, 1 / 255),
    )


def _hloc_lines(config: NetVladConfig) -> Iterator[Entry]:
    yield Entry(("aggregator.centroids",), ("netvlad.centers",), LINEAR)
    yield Entry(("aggregator.conv.weight",), ("netvlad.score_proj.weight",), _SCORES_1D)


def _infer_head(state: State) -> NetVladConfig:
    return NetVladConfig(clusters=Reader(state).size("netvlad.centers", 1))


register_over_cnn(
    "netvlad-hloc",
    "hloc's NetVLAD .pth",
    "netvlad",
    _infer_head,
    backbones=(VggConfig,),
    names=Names("backbone.", numbered=True),
    mark="netvlad.centers",
    head=_hloc_lines,
    projection="whiten",
    projection_form=_WHITENING_COLUMNS,
    image_size=lambda state: _LARGEST,
    preprocessing=lambda head: _chain(_MEAN),
)


def _matlab_lines(config: ModelConfig) -> Lines:
    mean = tuple(255 * value for value in config.preprocessing.mean)
    shape = (_AVERAGE_SIDE, _AVERAGE_SIDE, 3)
    yield Extra("average_image", AVERAGE, shape, np.float32, mean, free_axes=2)
    for (stage, layer), number in vgg_numbers():
        ours, theirs = f"backbone.blocks.{stage}.layers.{layer}", f"net.layers[{number}]"
        yield Entry((f"{ours}.weight",), (f"{theirs}.weights[0]",), SAME)
        yield Entry((f"{ours}.bias",), (f"{theirs}.weights[1]",), SAME)
    yield Entry(("aggregator.conv.weight",), (f"{_SCORES}.weights[0]",), SAME)
    yield Entry(("aggregator.centroids",), (f"{_SCORES}.weights[1]",), _OPPOSITE)
    yield Entry(("projection.weight",), (f"{_WHITENING}.weights[0]",), _WHITENING_ROWS)
    yield Entry(("projection.bias",), (f"{_WHITENING}.weights[1]",), SAME)


def _mean_of(state: State) -> tuple[float, float, float]:
    """Return the average image's first pixel, which hloc subtracts from all."""
    image = state[AVERAGE]
    if image.ndim != 3 or image.shape[-1] != 3 or not image.size:
        return _MEAN  # the layout's table refuses the image by its shape
    red, green, blue = map(_as_written, image[0, 0])
    return red, green, blue


def _as_written(value: np.float32) -> float:
    """Return a number of three decimals, such as 123.68, where float32 has just rounded it."""
    short = round(float(value), 3)
    return short if np.float32(short) == value else float(value)


def _matlab_infer(state: State) -> ModelConfig:
    read = Reader(state)
    return ModelConfig(
        image_size=_LARGEST,
        preprocessing=_chain(_mean_of(state)),
        backbone=VggConfig(),
        aggregator=NetVladConfig(clusters=read.size(f"{_SCORES}.weights[0]", 1)),
        cross_image=CrossImageConfig(layers=0),
        projection=ProjectionConfig(dim=read.size(f"{_WHITENING}.weights[1]", 0)),
    )


register_layout(
    Layout(
        "netvlad-matlab",
        "NetVLAD .mat",
        lambda config: accepts_head_over(config, "netvlad", (VggConfig,), projection=True),
        _matlab_lines,
        lambda state: AVERAGE in state,
        _matlab_infer,
        stored="matlab",
    )
)
