"""NetVLAD's head, under the names of Nanne/pytorch-NetVlad."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import register_head
from crisalad_jax.checkpoints.layouts.forms import POINTWISE, SAME, Entry, affine
from crisalad_jax.nn.aggregators.netvlad import NetVladConfig


@register_head("netvlad")
def netvlad_lines(config: NetVladConfig) -> Iterator[Entry]:
    """Yield the shares' convolution and the centroids."""
    yield from affine("aggregator.conv", "aggregator.conv", POINTWISE, bias=False)
    yield Entry(("aggregator.centroids",), ("aggregator.centroids",), SAME)
