"""The layout of Lu-Feng/SelaVPR (Lu et al., ICLR 2024): adapters, GeM and local features."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import Reader, State, register_head
from crisalad_jax.checkpoints.layouts.forms import FIRST, UPCONV, Entry, affine
from crisalad_jax.checkpoints.layouts.over_dinov2 import register_over_dinov2
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators.selavpr import SelaVprConfig

_LOCAL = "LocalAdapt"


@register_head("selavpr")
def selavpr_lines(config: SelaVprConfig) -> Iterator[Entry]:
    """Yield the exponent, and the transposed convolutions."""
    yield Entry(("aggregator.p",), ("aggregation.1.p",), FIRST)
    for name in ("upconv1", "upconv2"):
        yield from affine(f"aggregator.{name}", f"{_LOCAL}.{name}", UPCONV)


def infer_selavpr(state: State) -> SelaVprConfig:
    """Infer the widths of the local features and of the layer before them."""
    head = Reader(state, f"{_LOCAL}.")
    return SelaVprConfig(head.size("upconv1.bias", 0), head.size("upconv2.bias", 0))


register_over_dinov2(
    "selavpr",
    "SelaVPR .pth",
    "selavpr",
    infer_selavpr,
    prefix="backbone.",
    mark=f"{_LOCAL}.upconv1.weight",
    adapter="serial-parallel",
    # Tensors at torchvision 0.15.0, which does not antialias them unasked.
    preprocessing=PreprocessingConfig(antialias=False, pixels="floats"),
    module="module.",
    under="model_state_dict",
)
