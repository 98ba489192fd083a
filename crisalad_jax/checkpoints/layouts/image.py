"""The layout of Lu-Feng/ImAge (Lu et al., 2025): learnt tokens over DINOv2 with registers."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import Reader, State, register_head
from crisalad_jax.checkpoints.layouts.forms import FIRST, Entry
from crisalad_jax.checkpoints.layouts.over_dinov2 import register_over_dinov2
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators.backbone_tokens import AggregationTokensConfig

_TOKENS = "learnable_aggregation_tokens"


@register_head("aggregation-tokens")
def aggregation_token_lines(config: AggregationTokensConfig) -> Iterator[Entry]:
    """Yield the tokens."""
    yield Entry(("aggregator.tokens",), (_TOKENS,), FIRST)


def infer_aggregation_tokens(state: State) -> AggregationTokensConfig:
    """Infer the number of tokens; they enter before the last four blocks, as published."""
    return AggregationTokensConfig(tokens=Reader(state).size(_TOKENS, 1))


register_over_dinov2(
    "image",
    "ImAge .pth",
    "aggregation-tokens",
    infer_aggregation_tokens,
    prefix="backbone.",
    mark=_TOKENS,
    first=1,
    image_size=(322, 322),
    preprocessing=PreprocessingConfig(pixels="floats", round_to_patch=True),
    backbone={"position_resize": "plain"},
    module="module.",
    under="model_state_dict",
)
