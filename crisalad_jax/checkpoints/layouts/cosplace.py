"""The heads of gmberton/CosPlace and EigenPlaces, and GeM alone."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import register_head
from crisalad_jax.checkpoints.layouts.forms import FIRST, LINEAR, Entry, affine
from crisalad_jax.nn.aggregators.cosplace import CosPlaceConfig
from crisalad_jax.nn.aggregators.gem import GemConfig


@register_head("gem")
def gem_lines(config: GemConfig) -> Iterator[Entry]:
    """Yield the exponent."""
    yield Entry(("aggregator.p",), ("aggregation.1.p",), FIRST)


@register_head("cosplace")
def cosplace_lines(config: CosPlaceConfig) -> Iterator[Entry]:
    """Yield the exponent and the linear layer."""
    yield Entry(("aggregator.p",), ("aggregation.1.p",), FIRST)
    yield from affine("aggregator.fc", "aggregation.3", LINEAR)
