"""The layout of amaralibey/Bag-of-Queries with DINOv2: BoQ (Ali-bey et al., CVPR 2024)."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import Reader, State, register_head
from crisalad_jax.checkpoints.layouts.cnn import Names
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
from crisalad_jax.checkpoints.layouts.over_dinov2 import register_over_dinov2
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators.queries import BoqConfig
from crisalad_jax.nn.backbones.resnet import ResNetConfig

_CHAIN = PreprocessingConfig(filter="bicubic", pixels="floats")


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


register_over_dinov2(
    "boq-dinov2",
    "BoQ-DINOv2 .pth",
    "boq",
    infer_boq,
    prefix="backbone.dino.",
    image_size=(322, 322),
    preprocessing=_CHAIN,
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
    preprocessing=lambda head: _CHAIN,
)
