"""`crisalad convert`."""

import dataclasses
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


def _sources() -> str:
    files = ", ".join(each.holds for each in FORMATS.values())
    return f"{files}, or a file of this package."


def _formats() -> str:
    return (
        f"{', '.join(FORMATS)}, for a source of this package; by default the one its parts came "
        "from (huggingface if the target is a .safetensors)."
    )


COMMON = "source target format backbone json"
EXAMPLE = "crisalad convert dino_salad.ckpt salad.safetensors"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Convert(PluginFlag, JsonFlag):
    """Convert a public torch checkpoint to a file of this package, or such a file back."""

    source: Annotated[
        tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="SRC", help=_sources())
    ]
    target: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="DST"), Target()]
    """A .safetensors file; for a source of this package, the public checkpoint to write."""
    format: Annotated[str | None, tyro.conf.arg(help=_formats())] = None
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
    done = convert(
        source,
        target,
        arguments.format,
        backbone=find_given(backbone),
        fields=fields,
        half=arguments.half,
    )
    formats = {
        path: "crisalad-jax" if name is None else FORMATS[name].holds
        for path, name in ((source, done.source), (target, done.target))
    }
    ends = " -> ".join(f"{path} ({name})" for path, name in formats.items())
    echo(f"{ends}: {model_words(done.config)}")
    return {
        "source": {"file": str(source), "format": formats[source]},
        "target": {"file": str(target), "format": formats[target]},
        "model": model_words(done.config),
    }
