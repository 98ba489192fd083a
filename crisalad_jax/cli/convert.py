"""`crisalad convert`."""

import dataclasses
import pathlib
from typing import Annotated

import tyro

from crisalad_jax.cli.common import console
from crisalad_jax.convert import convert
from crisalad_jax.layouts import LAYOUTS


@dataclasses.dataclass(frozen=True)
class Convert:
    """Convert a public torch checkpoint to a file of this package, or such a file back."""

    source: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="SRC")]
    """DINOv2 .pth, Hugging Face Dinov2 .safetensors, DINO-SALAD .ckpt, CricaVPR .pth, the torch
    reference, or a file of this package."""
    target: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="DST")]
    """A .safetensors file; for a source of this package, the public checkpoint to write."""
    layout: str | None = None
    """dinov2, huggingface, dino-salad, cricavpr or reference, for a source of this package; by
    default the one its parts came from (huggingface if the target is a .safetensors)."""


def run(arguments: Convert) -> None:
    """Convert, and say what was found."""
    done = convert(arguments.source, arguments.target, arguments.layout)
    config = done.config
    backbone = config.backbone
    console.print(
        f"{arguments.source} ({_layout_words(done.source)}) -> {arguments.target} "
        f"({_layout_words(done.target)}): backbone of width {backbone.dim}, {backbone.depth} "
        f"blocks, {backbone.registers} registers, adapter {backbone.adapter.kind}; aggregator "
        f"{config.aggregator}; {config.encoder.layers} encoder layers; descriptor of "
        f"{config.descriptor_dim} numbers",
        soft_wrap=True,
    )


def _layout_words(layout: str | None) -> str:
    return "crisalad-jax" if layout is None else LAYOUTS[layout].holds
