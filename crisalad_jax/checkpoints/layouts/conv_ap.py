"""The layout of amaralibey/gsv-cities: Conv-AP (Ali-bey et al., Neurocomputing 2022)."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import Reader, State, register_head
from crisalad_jax.checkpoints.layouts.cnn import Names
from crisalad_jax.checkpoints.layouts.forms import POINTWISE, Entry, affine
from crisalad_jax.checkpoints.layouts.over_cnn import register_over_cnn
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators.conv_ap import ConvApConfig
from crisalad_jax.nn.backbones.resnet import ResNetConfig


@register_head("conv-ap")
def conv_ap_lines(config: ConvApConfig) -> Iterator[Entry]:
    """Yield the 1 x 1 convolution."""
    yield from affine("aggregator.channel_pool", "aggregator.channel_pool", POINTWISE)


def infer_conv_ap(state: State) -> ConvApConfig:
    """Infer the number of channels; no shape shows the regions, which are 2 x 2 when published."""
    return ConvApConfig(channels=Reader(state).size("aggregator.channel_pool.weight", 0))


def _chain(head: ConvApConfig) -> PreprocessingConfig:
    """Return the filter by the README: bicubic for the model of 4,096 numbers alone."""
    return PreprocessingConfig(filter="bicubic" if head.channels == 1024 else "bilinear")


register_over_cnn(
    "conv-ap",
    "Conv-AP .ckpt",
    "conv-ap",
    infer_conv_ap,
    backbones=(ResNetConfig,),
    names=Names("backbone.model.", numbered=False),
    mark="aggregator.channel_pool.weight",
    image_size=lambda state: (320, 320),
    preprocessing=_chain,
)
