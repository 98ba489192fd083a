"""The layout of gmberton/CosPlace and EigenPlaces, which is one, and the head of GeM alone."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import Reader, State, register_head
from crisalad_jax.checkpoints.layouts.cnn import Names
from crisalad_jax.checkpoints.layouts.forms import FIRST, LINEAR, Entry, affine
from crisalad_jax.checkpoints.layouts.over_cnn import register_over_cnn
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators.gem import CosPlaceConfig, GemConfig
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.backbones.vgg import VggConfig


@register_head("gem")
def gem_lines(config: GemConfig) -> Iterator[Entry]:
    """Yield the exponent."""
    yield Entry(("aggregator.p",), ("aggregation.1.p",), FIRST)


@register_head("cosplace")
def cosplace_lines(config: CosPlaceConfig, prefix: str = "") -> Iterator[Entry]:
    """Yield the exponent and the linear layer, under their names after a prefix."""
    yield Entry(("aggregator.p",), (f"{prefix}aggregation.1.p",), FIRST)
    yield from affine("aggregator.fc", f"{prefix}aggregation.3", LINEAR)


def infer_cosplace(state: State, prefix: str = "") -> CosPlaceConfig:
    """Infer the width of the descriptor."""
    return CosPlaceConfig(dim=Reader(state, prefix).size("aggregation.3.weight", 0))


register_over_cnn(
    "cosplace",
    "CosPlace and EigenPlaces .pth",
    "cosplace",
    infer_cosplace,
    backbones=(ResNetConfig, VggConfig),
    names=Names("backbone.", numbered=True),
    mark="aggregation.3.weight",
    image_size=lambda state: (512, 512),
    preprocessing=lambda head: PreprocessingConfig(size_rule="native"),
)
