"""The layout of Ahmedest61/VLAD-BuFF (Khaliq et al., ECCV 2024), with its whitening."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import Reader, State, register_head
from crisalad_jax.checkpoints.layouts.forms import LINEAR, POINTWISE, SAME, Entry, affine
from crisalad_jax.checkpoints.layouts.over_dinov2 import register_over_dinov2
from crisalad_jax.nn.aggregators.vlad import VladBuffConfig

_BURST = "aggregator.ab_params"
_ROTATION = "aggregator.pca_rot"


@register_head("vlad-buff")
def vlad_buff_lines(config: VladBuffConfig) -> Iterator[Entry]:
    """Yield the reduction, if there is one, and the rest of the head."""
    if config.reduced:
        yield Entry(("aggregator.reduction.mean",), ("aggregator.pca_mean",), SAME)
        yield Entry(("aggregator.reduction.rotation",), (_ROTATION,), LINEAR)
    yield Entry(("aggregator.centroids",), ("aggregator.centroids",), SAME)
    yield Entry(("aggregator.burst",), (_BURST,), SAME)
    yield from affine("aggregator.conv", "aggregator.conv", POINTWISE, bias=False)


def infer_vlad_buff(state: State) -> VladBuffConfig:
    """Infer the sizes."""
    head = Reader(state)
    return VladBuffConfig(
        clusters=head.size("aggregator.centroids", 0),
        reduced=head.size(_ROTATION, 0) if head.has(_ROTATION) else 0,
    )


register_over_dinov2(
    "vlad-buff",
    "VLAD-BuFF .ckpt",
    "vlad-buff",
    infer_vlad_buff,
    prefix="backbone.model.",
    mark=_BURST,
    image_size=(322, 322),
    projection="WPCA_{dim}.0",
    projection_form=POINTWISE,
    under="state_dict",
)
