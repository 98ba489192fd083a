"""The layout of Tong-Jin01/EDTformer (Jin et al., 2025): side adapters and a decoder."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import Reader, State, register_head
from crisalad_jax.checkpoints.layouts.forms import (
    FIRST,
    LINEAR,
    SAME,
    Entry,
    affine,
    torch_attention,
)
from crisalad_jax.checkpoints.layouts.over_dinov2 import register_over_dinov2
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators.queries import EdtFormerConfig


@register_head("edtformer")
def edtformer_lines(config: EdtFormerConfig) -> Iterator[Entry]:
    """Yield the decoder's table, the queries first."""
    yield Entry(("aggregator.queries",), ("queries",), FIRST)
    yield from affine("aggregator.fc", "fc", LINEAR)
    for i in range(config.layers):
        ours, theirs = f"aggregator.layers.{i}", f"decoder.layers.{i}"
        for name in ("self_attn", "multihead_attn"):
            yield from torch_attention(f"{ours}.{name}", f"{theirs}.{name}")
        for name in ("norm1", "norm2"):
            yield from affine(f"{ours}.{name}", f"{theirs}.{name}", SAME)
    for name in ("channel_proj", "row_proj"):
        yield from affine(f"aggregator.{name}", name, LINEAR)


def infer_edtformer(state: State) -> EdtFormerConfig:
    """Infer the decoder's sizes; the number of heads is the published one."""
    head = Reader(state)
    return EdtFormerConfig(
        width=head.size("queries", 2),
        layers=head.count("decoder.layers."),
        queries=head.size("queries", 1),
        channels=head.size("channel_proj.weight", 0),
        rows=head.size("row_proj.weight", 0),
    )


register_over_dinov2(
    "edtformer",
    "EDTformer .pth",
    "edtformer",
    infer_edtformer,
    prefix="backbone.",
    mark="queries",
    first=1,
    image_size=(322, 322),
    preprocessing=PreprocessingConfig(pixels="floats", round_to_patch=True),
    adapter="side",
    module="module.",
    under="model_state_dict",
)
