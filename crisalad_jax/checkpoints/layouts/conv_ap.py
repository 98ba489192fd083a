"""Conv-AP's head, under the names of amaralibey/gsv-cities."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import register_head
from crisalad_jax.checkpoints.layouts.forms import POINTWISE, Entry, affine
from crisalad_jax.nn.aggregators.conv_ap import ConvApConfig


@register_head("conv-ap")
def conv_ap_lines(config: ConvApConfig) -> Iterator[Entry]:
    """Yield the 1 x 1 convolution."""
    yield from affine("aggregator.channel_pool", "aggregator.channel_pool", POINTWISE)
