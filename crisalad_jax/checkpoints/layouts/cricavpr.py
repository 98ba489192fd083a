"""The layout of Lu-Feng/CricaVPR (Lu et al., CVPR 2024)."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import State, register_head
from crisalad_jax.checkpoints.layouts.forms import FIRST, Entry
from crisalad_jax.checkpoints.layouts.over_dinov2 import register_over_dinov2
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators.gem import GemPyramidConfig

_EXPONENT = "aggregation.1.p"


@register_head("gem-pyramid")
def gem_pyramid_lines(config: GemPyramidConfig) -> Iterator[Entry]:
    """Yield the exponent, under CricaVPR's name."""
    yield Entry(("aggregator.p",), (_EXPONENT,), FIRST)


def infer_gem_pyramid(state: State) -> GemPyramidConfig:
    """Return the pyramid, which is the same in all files."""
    return GemPyramidConfig()


register_over_dinov2(
    "cricavpr",
    "CricaVPR .pth",
    "gem-pyramid",
    infer_gem_pyramid,
    prefix="backbone.",
    mark=_EXPONENT,
    adapter="multi-resolution",
    encoder=True,
    # Tensors at torchvision 0.15.0, which does not antialias them unasked.
    preprocessing=PreprocessingConfig(antialias=False, pixels="floats"),
    module="module.",
    under="model_state_dict",
)
