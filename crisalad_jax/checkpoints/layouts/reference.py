"""The layout of our torch reference in `parity/`, which can hold any model of ours."""

from crisalad_jax.checkpoints.layouts.base import (
    Layout,
    Lines,
    Reader,
    State,
    head_lines,
    register_layout,
)
from crisalad_jax.checkpoints.layouts.cnn import Names, cnn_lines
from crisalad_jax.checkpoints.layouts.dino_salad import infer_salad
from crisalad_jax.checkpoints.layouts.dinov2 import has_vit, vit_config, vit_lines
from crisalad_jax.checkpoints.layouts.encoder import encoder_lines, infer_encoder
from crisalad_jax.checkpoints.layouts.forms import LINEAR, affine
from crisalad_jax.nn.aggregators.backbone_tokens import ClassTokenConfig
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.backbones.vgg import VggConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig

_BACKBONE = "backbone."


def _accepts(config: ModelConfig) -> str | None:
    held = isinstance(config.backbone, ViTConfig | ResNetConfig | VggConfig)
    return None if held else "a backbone vit, resnet or vgg"


def _lines(config: ModelConfig) -> Lines:
    if isinstance(config.backbone, ViTConfig):
        yield from vit_lines(config.backbone, _BACKBONE)
    else:
        yield from cnn_lines(config.backbone, Names(_BACKBONE, numbered=True))
    yield from head_lines(config)
    yield from encoder_lines(config.cross_image)
    if config.projection.dim:
        yield from affine("projection", "projection", LINEAR)


def _infer(state: State) -> ModelConfig:
    """Infer a model with SALAD or a class token; our own files store their configuration."""
    salad = "aggregator.score.3.weight" in state
    return ModelConfig(
        backbone=vit_config(Reader(state, _BACKBONE)),
        aggregator=infer_salad(state) if salad else ClassTokenConfig(),
        cross_image=infer_encoder(state),
    )


register_layout(
    Layout(
        "reference",
        "our torch reference",
        _accepts,
        _lines,
        lambda state: has_vit(state, _BACKBONE),
        _infer,
        under="state_dict",
    )
)
