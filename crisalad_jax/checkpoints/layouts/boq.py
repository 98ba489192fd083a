"""The layout of amaralibey/Bag-of-Queries with DINOv2: BoQ (Ali-bey et al., CVPR 2024)."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import (
    Layout,
    Lines,
    Reader,
    State,
    register_head,
    register_layout,
)
from crisalad_jax.checkpoints.layouts.cnn import Names
from crisalad_jax.checkpoints.layouts.dinov2 import accepts_parts, vit_config, vit_lines, vit_of
from crisalad_jax.checkpoints.layouts.forms import (
    CONV,
    FIRST,
    LINEAR,
    SAME,
    Entry,
    affine,
    torch_attention,
    transformer_layer,
)
from crisalad_jax.checkpoints.layouts.over_cnn import register_over_cnn
from crisalad_jax.nn.aggregators.boq import BoqConfig
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig

_BACKBONE = "backbone.dino."


@register_head("boq")
def boq_lines(config: BoqConfig) -> Iterator[Entry]:
    """Yield BoQ's table, under amaralibey/Bag-of-Queries' names."""
    yield from affine("aggregator.proj_c", "aggregator.proj_c", CONV)
    yield from affine("aggregator.norm_input", "aggregator.norm_input", SAME)
    for i in range(config.layers):
        here = f"aggregator.boqs.{i}"
        yield Entry((f"{here}.queries",), (f"{here}.queries",), FIRST)
        yield from transformer_layer(f"{here}.encoder", f"{here}.encoder")
        for attention, norm in (("self_attn", "norm_q"), ("cross_attn", "norm_out")):
            yield from torch_attention(f"{here}.{attention}", f"{here}.{attention}")
            yield from affine(f"{here}.{norm}", f"{here}.{norm}", SAME)
    yield from affine("aggregator.fc", "aggregator.fc", LINEAR)


def infer_boq(state: State) -> BoqConfig:
    """Infer BoQ's sizes."""
    head = Reader(state)
    return BoqConfig(
        channels=head.size("aggregator.proj_c.weight", 0),
        queries=head.size("aggregator.boqs.0.queries", 1),
        layers=head.count("aggregator.boqs."),
        rows=head.size("aggregator.fc.weight", 0),
    )


def _infer(state: State) -> ModelConfig:
    return ModelConfig(
        image_size=(322, 322),
        backbone=vit_config(Reader(state, _BACKBONE)),
        aggregator=infer_boq(state),
        cross_image=CrossImageConfig(layers=0),
    )


def _lines(config: ModelConfig) -> Lines:
    assert isinstance(config.aggregator, BoqConfig)
    yield from vit_lines(vit_of(config), _BACKBONE)
    yield from boq_lines(config.aggregator)


register_layout(
    Layout(
        "boq-dinov2",
        "BoQ-DINOv2 .pth",
        lambda config: accepts_parts(config, "boq", "none", cross_image=False),
        _lines,
        lambda state: f"{_BACKBONE}cls_token" in state or f"{_BACKBONE}pos_embed" in state,
        _infer,
    )
)

register_over_cnn(
    "boq-resnet50",
    "BoQ-ResNet50 .pth",
    "boq",
    infer_boq,
    backbones=(ResNetConfig,),
    names=Names("backbone.net.", numbered=True),
    mark="aggregator.proj_c.weight",
    image_size=lambda state: (384, 384),
)
