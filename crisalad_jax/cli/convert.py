"""`crisalad convert`."""

import dataclasses
import pathlib
from typing import Annotated

import tyro

from crisalad_jax.checkpoints.layouts import LAYOUTS
from crisalad_jax.checkpoints.torch_io import convert
from crisalad_jax.cli.common import say
from crisalad_jax.training.summary import model_words


@dataclasses.dataclass(frozen=True)
class Convert:
    """Convert a public torch checkpoint to a file of this package, or such a file back."""

    source: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="SRC")]
    """DINOv2 .pth, Hugging Face Dinov2 .safetensors, DINO-SALAD .ckpt, CricaVPR .pth, BoQ-DINOv2
    .pth, MegaLoc .safetensors, the torch reference, or a file of this package."""
    target: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="DST")]
    """A .safetensors file; for a source of this package, the public checkpoint to write."""
    layout: str | None = None
    """dinov2, huggingface, dino-salad, cricavpr, boq-dinov2, megaloc or reference, for a source of
    this package; by default the one its parts came from (huggingface if the target is a
    .safetensors)."""
    plugin: tuple[str, ...] = ()
    """Files FILE.py or modules that register parts of your own; their code is run."""


def run(arguments: Convert) -> None:
    """Convert the file, and print both layouts and the model."""
    done = convert(arguments.source, arguments.target, arguments.layout)
    source, target = map(_layout_words, (done.source, done.target))
    say(
        f"{arguments.source} ({source}) -> {arguments.target} ({target}): "
        + model_words(done.config)
    )


def _layout_words(layout: str | None) -> str:
    return "crisalad-jax" if layout is None else LAYOUTS[layout].holds
