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
    f"{', '.join(FORMATS)}, for a source of this package; by default the first that can hold "
    "the model in a file with the target's ending."
)


class Convert(PluginFlag, JsonFlag):
    """Convert a public checkpoint to this package's .safetensors format, or back."""

    source: Annotated[
        tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="SRC", help=_SOURCES)
    ]
    target: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="DST"), Target()]
    """File to write: .safetensors, or a public checkpoint if SRC is in this package's format."""
    format: Annotated[str | None, tyro.conf.arg(help=_FORMATS)] = None
    backbone: pathlib.Path | None = None
    """For a vocabulary of AnyLoc, which is a single tensor: checkpoint of its backbone, or a
    published model's name, as in dinov2-vitg14."""
    layer: int | None = None
    """With --backbone: the block that AnyLoc reads, from 0, or from the end if negative; by default
    -9, which is 31 of ViT-g's 40."""
    facet: str | None = None
    """With --backbone: what AnyLoc reads: query, key, value or token; by default value."""
    assignment: str | None = None
    """With --backbone: how the nearest word is found: cosine, as published, or euclidean."""
    half: bool = False
    """Write this package's format in half precision, in half the space, whatever the format of
    SRC."""


def run(arguments: Convert) -> dict[str, Any]:
    """Convert the file, and print both formats and the model; return the result for --json."""
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
