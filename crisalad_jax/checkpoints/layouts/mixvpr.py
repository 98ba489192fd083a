"""MixVPR's head, under the names of amaralibey/MixVPR."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import Reader, State, register_head
from crisalad_jax.checkpoints.layouts.forms import LINEAR, SAME, Entry, affine
from crisalad_jax.nn.aggregators.mixvpr import MixVprConfig


@register_head("mixvpr")
def mixvpr_lines(config: MixVprConfig) -> Iterator[Entry]:
    """Yield the table; mixers are layer norm, linear, ReLU, linear."""
    for i in range(config.depth):
        ours, theirs = f"aggregator.mix.{i}", f"aggregator.mix.{i}.mix"
        yield from affine(f"{ours}.norm", f"{theirs}.0", SAME)
        yield from affine(f"{ours}.fc1", f"{theirs}.1", LINEAR)
        yield from affine(f"{ours}.fc2", f"{theirs}.3", LINEAR)
    for name in ("channel_proj", "row_proj"):
        yield from affine(f"aggregator.{name}", f"aggregator.{name}", LINEAR)


def infer_mixvpr(state: State, *, last_norm: bool) -> MixVprConfig:
    """Infer MixVPR's sizes; no shape tells whether patches go through the last layer norm."""
    head = Reader(state, "aggregator.")
    return MixVprConfig(
        channels=head.size("channel_proj.weight", 0),
        rows=head.size("row_proj.weight", 0),
        depth=head.count("mix."),
        last_norm=last_norm,
    )
