"""`crisalad convert`."""

import dataclasses
import pathlib
from typing import Annotated

import tyro

from crisalad_jax.checkpoints.layouts import LAYOUTS
from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.checkpoints.published import PUBLISHED
from crisalad_jax.checkpoints.torch_io import convert
from crisalad_jax.cli.common import give_json, prepare_json, say
from crisalad_jax.training.summary import model_words
from crisalad_jax.utils.errors import InputError


def _sources() -> str:
    files = ", ".join(layout.holds for layout in LAYOUTS.values())
    return f"{files}, or a file of this package."


def _layouts() -> str:
    return (
        f"{', '.join(LAYOUTS)}, for a source of this package; by default the one its parts came "
        "from (huggingface if the target is a .safetensors)."
    )


COMMON = ("source", "target", "layout", "backbone", "json")
EXAMPLE = "crisalad convert dino_salad.ckpt salad.safetensors"


@dataclasses.dataclass(frozen=True)
class Convert:
    """Convert a public torch checkpoint to a file of this package, or such a file back."""

    source: Annotated[
        tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="SRC", help=_sources())
    ]
    target: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="DST")]
    """A .safetensors file; for a source of this package, the public checkpoint to write."""
    layout: Annotated[str | None, tyro.conf.arg(help=_layouts())] = None
    backbone: pathlib.Path | None = None
    """The backbone's checkpoint, or a published model's name, as in dinov2-vitg14: for a vocabulary
    of AnyLoc, which is one tensor by itself."""
    layer: int | None = None
    """With --backbone: the vocabulary's block, from 0, or from the end where negative; by default
    -9, which is 31 of ViT-g's 40."""
    facet: str | None = None
    """With --backbone: query, key, value or token; by default value."""
    assignment: str | None = None
    """With --backbone: cosine, as published, or euclidean."""
    half: bool = False
    """Write a file of this package in half precision, in half the room; of a source of this package
    too."""
    json: pathlib.Path | None = None
    """File for the result as JSON; - prints it."""
    plugin: tuple[str, ...] = ()
    """Files FILE.py or modules that register parts of your own; their code is run."""


def run(arguments: Convert) -> None:
    """Convert the file, and print both layouts and the model."""
    prepare_json(arguments.json)
    given = {name: getattr(arguments, name) for name in ("layer", "facet", "assignment")}
    fields = {name: value for name, value in given.items() if value is not None}
    if fields and arguments.backbone is None:
        raise InputError(f"--{next(iter(fields))}: found without --backbone, expected both")
    if str(arguments.source) in PUBLISHED and not arguments.source.exists():
        raise InputError(
            f"{arguments.source}: found the name of a published model, expected a file; --weights "
            f"{arguments.source} converts it by itself"
        )
    backbone = None if arguments.backbone is None else find_weights(arguments.backbone)
    done = convert(
        arguments.source,
        arguments.target,
        arguments.layout,
        backbone=backbone,
        fields=fields,
        half=arguments.half,
    )
    source, target = map(_layout_words, (done.source, done.target))
    say(
        f"{arguments.source} ({source}) -> {arguments.target} ({target}): "
        + model_words(done.config)
    )
    give_json(
        arguments.json,
        {
            "source": {"file": str(arguments.source), "layout": source},
            "target": {"file": str(arguments.target), "layout": target},
            "model": model_words(done.config),
        },
    )


def _layout_words(layout: str | None) -> str:
    return "crisalad-jax" if layout is None else LAYOUTS[layout].holds
