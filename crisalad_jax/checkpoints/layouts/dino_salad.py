"""The layout of serizba/salad: DINO-SALAD (Izquierdo and Civera, CVPR 2024)."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import Reader, State, register_head
from crisalad_jax.checkpoints.layouts.forms import LINEAR, POINTWISE, SAME, Entry, affine
from crisalad_jax.checkpoints.layouts.over_dinov2 import register_over_dinov2
from crisalad_jax.nn.aggregators.salad import SaladConfig


@register_head("salad")
def salad_lines(config: SaladConfig, prefix: str = "aggregator.") -> Iterator[Entry]:
    """Yield SALAD's table, under serizba/salad's names after their prefix."""
    if config.dustbin.part_name in ("column", "row and column", "mass"):
        yield Entry(("aggregator.dust_bin",), (f"{prefix}dust_bin",), SAME)
    yield from network_lines(prefix)


def network_lines(prefix: str) -> Iterator[Entry]:
    """Yield the three networks over features."""
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


register_over_dinov2(
    "dino-salad",
    "DINO-SALAD .ckpt",
    "salad",
    infer_salad,
    prefix="backbone.model.",
    image_size=(322, 322),
)
