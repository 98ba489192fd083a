"""`crisalad convert`."""

import pathlib
from typing import Annotated, Any

import tyro

from crisalad_jax.checkpoints.formats import FORMATS
from crisalad_jax.checkpoints.public import convert
from crisalad_jax.checkpoints.published import PUBLISHED
from crisalad_jax.cli.common import echo, find_given, pick, refuse_without
from crisalad_jax.cli.flags import JsonFlag, PluginFlag, Target
from crisalad_jax.config.checks import require
from crisalad_jax.training.summary import model_words

_SOURCES = f"{', '.join(each.holds for each in FORMATS.values())}, or a file of this package."
_FORMATS = (
    f"{', '.join(FORMATS)}, for a source of this package; by default the one its parts came from "
    "(huggingface if the target is a .safetensors)."
)


class Convert(PluginFlag, JsonFlag):
    """Convert a public torch checkpoint to a file of this package, or such a file back."""

    source: Annotated[
        tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="SRC", help=_SOURCES)
    ]
    target: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="DST"), Target()]
    """A .safetensors file; for a source of this package, the public checkpoint to write."""
    format: Annotated[str | None, tyro.conf.arg(help=_FORMATS)] = None
    backbone: pathlib.Path | None = None
    """The backbone's checkpoint, or a published model's name, as in dinov2-vitg14: for a vocabulary
    of AnyLoc, which is a single tensor."""
    layer: int | None = None
    """With --backbone: the vocabulary's block, from 0, or from the end if negative; by default -9,
    which is 31 of ViT-g's 40."""
    facet: str | None = None
    """With --backbone: query, key, value or token; by default value."""
    assignment: str | None = None
    """With --backbone: cosine, as published, or euclidean."""
    half: bool = False
    """Write a file of this package in half precision, in half the space; also from a source of this
    package."""


def run(arguments: Convert) -> dict[str, Any]:
    """Convert the file, and print both formats and the model."""
    source, target, backbone = arguments.source, arguments.target, arguments.backbone
    given = pick(arguments, "layer", "facet", "assignment")
    fields = {name: value for name, value in given.items() if value is not None}
    refuse_without("--backbone", backbone, **given)
    require(
        str(source) not in PUBLISHED or source.exists(),
        f"{source}: found the name of a published model, expected a file; --weights {source} "
        "converts it by itself",
    )
    backbone = find_given(backbone)
    more = pick(arguments, "format", "half")
    done = convert(source, target, backbone=backbone, fields=fields, **more)
    files = {
        end: {
            "file": str(getattr(arguments, end)),
            "format": "crisalad-jax" if name is None else FORMATS[name].holds,
        }
        for end, name in (("source", done.source), ("target", done.target))
    }
    ends = " -> ".join(f"{each['file']} ({each['format']})" for each in files.values())
    words = model_words(done.config)
    echo(f"{ends}: {words}")
    return {**files, "model": words}
