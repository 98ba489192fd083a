"""The layout of GaoShuang98/DINO-Mix: MixVPR over DINOv2 without its last layer norm."""

from crisalad_jax.checkpoints.layouts.base import Layout, Lines, Reader, State, register_layout
from crisalad_jax.checkpoints.layouts.dinov2 import accepts_parts, vit_config, vit_lines, vit_of
from crisalad_jax.checkpoints.layouts.mixvpr import infer_mixvpr, mixvpr_lines
from crisalad_jax.nn.aggregators.mixvpr import MixVprConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig

_BACKBONE = "backbone.dino_model."


def _infer(state: State) -> ModelConfig:
    return ModelConfig(
        image_size=(224, 224),
        backbone=vit_config(Reader(state, _BACKBONE)),
        aggregator=infer_mixvpr(state, last_norm=False),
        cross_image=CrossImageConfig(layers=0),
    )


def _lines(config: ModelConfig) -> Lines:
    assert isinstance(config.aggregator, MixVprConfig)
    yield from vit_lines(vit_of(config), _BACKBONE, norm=False)
    yield from mixvpr_lines(config.aggregator)


register_layout(
    Layout(
        "dino-mix",
        "DINO-Mix .ckpt",
        lambda config: accepts_parts(config, "mixvpr", "none", cross_image=False),
        _lines,
        lambda state: f"{_BACKBONE}cls_token" in state or f"{_BACKBONE}pos_embed" in state,
        _infer,
        under="state_dict",
    )
)
