"""`crisalad convert`."""

import dataclasses
import pathlib
from typing import Annotated

import tyro

from crisalad_jax.checkpoints.layouts import LAYOUTS
from crisalad_jax.checkpoints.torch_io import convert
from crisalad_jax.cli.common import say
from crisalad_jax.training.summary import model_words


def _sources() -> str:
    files = ", ".join(layout.holds for layout in LAYOUTS.values())
    return f"{files}, or a file of this package."


def _layouts() -> str:
    return (
        f"{', '.join(LAYOUTS)}, for a source of this package; by default the one its parts came "
        "from (huggingface if the target is a .safetensors)."
    )


@dataclasses.dataclass(frozen=True)
class Convert:
    """Convert a public torch checkpoint to a file of this package, or such a file back."""

    source: Annotated[
        tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="SRC", help=_sources())
    ]
    target: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="DST")]
    """A .safetensors file; for a source of this package, the public checkpoint to write."""
    layout: Annotated[str | None, tyro.conf.arg(help=_layouts())] = None
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
