"""TransVPR's head, under our own names, because the public head fits another backbone."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import register_head
from crisalad_jax.checkpoints.layouts.forms import LINEAR, Entry, affine
from crisalad_jax.nn.aggregators.transvpr import TransVprConfig


@register_head("transvpr")
def transvpr_lines(config: TransVprConfig) -> Iterator[Entry]:
    """Yield both linear layers."""
    yield from affine("aggregator.attention", "aggregator.attention", LINEAR, bias=False)
    yield from affine("aggregator.reduction", "aggregator.reduction", LINEAR)
