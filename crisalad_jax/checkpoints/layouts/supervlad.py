"""The layout of lu-feng/SuperVLAD, with and without its cross-image encoder."""

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
from crisalad_jax.checkpoints.layouts.cricavpr import encoder_lines, infer_encoder
from crisalad_jax.checkpoints.layouts.dinov2 import accepts_parts, vit_config, vit_lines, vit_of
from crisalad_jax.checkpoints.layouts.forms import POINTWISE, Entry, affine
from crisalad_jax.nn.aggregators.supervlad import SuperVladConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.utils.errors import InputError

_BACKBONE = "backbone."
_CONV = "aggregation.conv"
_GHOSTS = {5: 1, 3: 2}
"""Number of ghosts by that of all clusters, in the published files; no shape tells them apart."""


@register_head("supervlad")
def supervlad_lines(config: SuperVladConfig) -> Iterator[Entry]:
    """Yield the scores' convolution."""
    yield from affine("aggregator.conv", _CONV, POINTWISE, bias=False)


def _accepts(config: ModelConfig) -> str | None:
    encoder = bool(config.cross_image.layers)
    return accepts_parts(config, "supervlad", "none", cross_image=encoder)


def _infer(state: State) -> ModelConfig:
    count = Reader(state).size(f"{_CONV}.weight", 0)
    if count not in _GHOSTS:
        raise InputError(
            f"{_CONV}.weight found of {count} clusters, expected 5 (1 ghost) or 3 (2 ghosts)"
        )
    ghosts = _GHOSTS[count]
    return ModelConfig(
        image_size=(322, 322),
        backbone=vit_config(Reader(state, _BACKBONE)),
        aggregator=SuperVladConfig(count - ghosts, ghosts),
        cross_image=infer_encoder(state),
    )


def _lines(config: ModelConfig) -> Lines:
    yield from vit_lines(vit_of(config), _BACKBONE)
    yield from head_lines(config)
    yield from encoder_lines(config.cross_image)


register_layout(
    Layout(
        "supervlad",
        "SuperVLAD .pth",
        _accepts,
        _lines,
        lambda state: (
            f"{_CONV}.weight" in state
            and (f"{_BACKBONE}cls_token" in state or f"{_BACKBONE}pos_embed" in state)
        ),
        _infer,
        module="module.",
        under="model_state_dict",
    )
)
