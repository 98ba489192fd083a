"""BoQ's head, under the names of amaralibey/Bag-of-Queries."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import register_head
from crisalad_jax.checkpoints.layouts.forms import (
    CONV,
    FIRST,
    LINEAR,
    SAME,
    Entry,
    affine,
    torch_attention,
    transformer_layer,
)
from crisalad_jax.nn.aggregators.boq import BoqConfig


@register_head("boq")
def boq_lines(config: BoqConfig) -> Iterator[Entry]:
    """Yield BoQ's table, under amaralibey/Bag-of-Queries' names."""
    yield from affine("aggregator.proj_c", "aggregator.proj_c", CONV)
    yield from affine("aggregator.norm_input", "aggregator.norm_input", SAME)
    for i in range(config.layers):
        here = f"aggregator.boqs.{i}"
        yield Entry((f"{here}.queries",), (f"{here}.queries",), FIRST)
        yield from transformer_layer(f"{here}.encoder", f"{here}.encoder")
        for attention, norm in (("self_attn", "norm_q"), ("cross_attn", "norm_out")):
            yield from torch_attention(f"{here}.{attention}", f"{here}.{attention}")
            yield from affine(f"{here}.{norm}", f"{here}.{norm}", SAME)
    yield from affine("aggregator.fc", "aggregator.fc", LINEAR)
