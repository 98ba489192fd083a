"""The cross-image encoder, under torch's names; CricaVPR, CriSALAD and SuperVLAD have it."""

from collections.abc import Iterator

from crisalad_jax.checkpoints.layouts.base import Reader, State
from crisalad_jax.checkpoints.layouts.forms import Entry, transformer_layer
from crisalad_jax.nn.cross_image import CrossImageConfig

ENCODER_HEADS = 16
"""Number of heads of the published encoder, which no shape shows."""


def encoder_lines(config: CrossImageConfig) -> Iterator[Entry]:
    """Yield the cross-image encoder, under torch.nn.TransformerEncoder's names."""
    for i in range(config.layers):
        yield from transformer_layer(f"cross_image.layers.{i}", f"encoder.layers.{i}")


def infer_encoder(state: State) -> CrossImageConfig:
    """Infer the encoder's sizes; the number of heads is the published one."""
    head = Reader(state)
    layers = head.count("encoder.layers.")
    if not layers:
        return CrossImageConfig(layers=0, heads=ENCODER_HEADS)
    feedforward = head.size("encoder.layers.0.linear1.weight", 0)
    return CrossImageConfig(layers, ENCODER_HEADS, feedforward)
