"""The layout of Lu-Feng/CricaVPR (Lu et al., CVPR 2024), whose encoder CriSALAD has too."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import (
    Layout,
    Lines,
    Reader,
    State,
    head_lines,
    register_head,
    register_layout,
)
from crisalad_jax.checkpoints.layouts.dinov2 import accepts_parts, vit_config, vit_lines, vit_of
from crisalad_jax.checkpoints.layouts.forms import FIRST, Entry, transformer_layer
from crisalad_jax.nn.aggregators.gem_pyramid import GemPyramidConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig

_BACKBONE = "backbone."
ENCODER_HEADS = 16
"""Number of heads of the published encoder, which no shape shows."""


@register_head("gem-pyramid")
def gem_pyramid_lines(config: GemPyramidConfig) -> Iterator[Entry]:
    """Yield the exponent, under CricaVPR's name."""
    yield Entry(("aggregator.p",), ("aggregation.1.p",), FIRST)


def encoder_lines(config: CrossImageConfig) -> Iterator[Entry]:
    """Yield the cross-image encoder, under torch.nn.TransformerEncoder's names."""
    for i in range(config.layers):
        yield from transformer_layer(f"cross_image.layers.{i}", f"encoder.layers.{i}")


def infer_encoder(state: State) -> CrossImageConfig:
    """Infer the encoder's sizes; the number of heads is the published one."""
    head = Reader(state)
    layers = head.count("encoder.layers.")
    if not layers:
        return CrossImageConfig(layers=0, heads=ENCODER_HEADS)
    feedforward = head.size("encoder.layers.0.linear1.weight", 0)
    return CrossImageConfig(layers, ENCODER_HEADS, feedforward)


def _infer(state: State) -> ModelConfig:
    return ModelConfig(
        backbone=vit_config(Reader(state, _BACKBONE)),
        aggregator=GemPyramidConfig(),
        cross_image=infer_encoder(state),
    )


def _lines(config: ModelConfig) -> Lines:
    yield from vit_lines(vit_of(config), _BACKBONE)
    yield from head_lines(config)
    yield from encoder_lines(config.cross_image)


register_layout(
    Layout(
        "cricavpr",
        "CricaVPR .pth",
        lambda config: accepts_parts(config, "gem-pyramid", "multi-resolution", cross_image=True),
        _lines,
        lambda state: (
            "aggregation.1.p" in state
            and (f"{_BACKBONE}cls_token" in state or f"{_BACKBONE}pos_embed" in state)
        ),
        _infer,
        module="module.",
        under="model_state_dict",
    )
)
