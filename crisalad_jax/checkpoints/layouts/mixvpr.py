"""The layout of amaralibey/MixVPR (Ali-bey et al., WACV 2023), and its head for other layouts."""

import functools
from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import Reader, State, register_head
from crisalad_jax.checkpoints.layouts.cnn import Names, square_image
from crisalad_jax.checkpoints.layouts.forms import LINEAR, SAME, Entry, affine
from crisalad_jax.checkpoints.layouts.over_cnn import register_over_cnn
from crisalad_jax.nn.aggregators.mixvpr import MixVprConfig
from crisalad_jax.nn.backbones.resnet import ResNetConfig

_ROWS = "aggregator.row_proj.weight"


@register_head("mixvpr")
def mixvpr_lines(config: MixVprConfig) -> Iterator[Entry]:
    """Yield the table; mixers are layer norm, linear, ReLU, linear."""
    for i in range(config.depth):
        ours, theirs = f"aggregator.mix.{i}", f"aggregator.mix.{i}.mix"
        yield from affine(f"{ours}.norm", f"{theirs}.0", SAME)
        yield from affine(f"{ours}.fc1", f"{theirs}.1", LINEAR)
        yield from affine(f"{ours}.fc2", f"{theirs}.3", LINEAR)
    for name in ("channel_proj", "row_proj"):
        yield from affine(f"aggregator.{name}", f"aggregator.{name}", LINEAR)


def infer_mixvpr(state: State, *, last_norm: bool) -> MixVprConfig:
    """Infer MixVPR's sizes; no shape tells whether patches go through the last layer norm."""
    head = Reader(state, "aggregator.")
    return MixVprConfig(
        channels=head.size("channel_proj.weight", 0),
        rows=head.size("row_proj.weight", 0),
        depth=head.count("mix."),
        last_norm=last_norm,
    )


register_over_cnn(
    "mixvpr",
    "MixVPR .ckpt",
    "mixvpr",
    # A ResNet has no last layer norm: the field keeps its default.
    functools.partial(infer_mixvpr, last_norm=True),
    backbones=(ResNetConfig,),
    names=Names("backbone.model.", numbered=False),
    mark=_ROWS,
    image_size=lambda state: square_image(state, _ROWS, ResNetConfig(stages=3).patch_size),
)
