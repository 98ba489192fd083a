"""The layout of serizba/salad: DINO-SALAD (Izquierdo and Civera, CVPR 2024)."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import (
    Layout,
    Lines,
    Reader,
    State,
    register_head,
    register_layout,
)
from crisalad_jax.checkpoints.layouts.dinov2 import accepts_parts, vit_config, vit_lines, vit_of
from crisalad_jax.checkpoints.layouts.forms import LINEAR, POINTWISE, SAME, Entry, affine
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig

_BACKBONE = "backbone.model."


@register_head("salad")
def salad_lines(config: SaladConfig, prefix: str = "aggregator.") -> Iterator[Entry]:
    """Yield SALAD's table, under serizba/salad's names after their prefix."""
    if config.dustbin.part_name in ("column", "row and column", "mass"):
        yield Entry(("aggregator.dust_bin",), (f"{prefix}dust_bin",), SAME)
    for name, second, form in (
        ("token_features", 2, LINEAR),
        ("cluster_features", 3, POINTWISE),
        ("score", 3, POINTWISE),
    ):
        yield from affine(f"aggregator.{name}.fc1", f"{prefix}{name}.0", form)
        yield from affine(f"aggregator.{name}.fc2", f"{prefix}{name}.{second}", form)


def infer_salad(state: State, prefix: str = "aggregator.") -> SaladConfig:
    """Infer SALAD's sizes."""
    head = Reader(state, prefix)
    return SaladConfig(
        clusters=head.size("score.3.weight", 0),
        cluster_dim=head.size("cluster_features.3.weight", 0),
        token_dim=head.size("token_features.2.weight", 0),
        hidden=head.size("score.0.weight", 0),
    )


def _infer(state: State) -> ModelConfig:
    return ModelConfig(
        image_size=(322, 322),
        backbone=vit_config(Reader(state, _BACKBONE)),
        aggregator=infer_salad(state),
        cross_image=CrossImageConfig(layers=0),
    )


def _lines(config: ModelConfig) -> Lines:
    assert isinstance(config.aggregator, SaladConfig)
    yield from vit_lines(vit_of(config), _BACKBONE)
    yield from salad_lines(config.aggregator)


register_layout(
    Layout(
        "dino-salad",
        "DINO-SALAD .ckpt",
        lambda config: accepts_parts(config, "salad", "none", cross_image=False),
        _lines,
        lambda state: f"{_BACKBONE}cls_token" in state or f"{_BACKBONE}pos_embed" in state,
        _infer,
    )
)
