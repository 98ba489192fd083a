"""`crisalad info`."""

import dataclasses
import pathlib
from typing import Any

from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.cli.common import (
    check_one_model,
    give_json,
    prepare_json,
    say,
    show,
)
from crisalad_jax.cli.tables import fact_lines, summary_table
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.training.recipes import recipe
from crisalad_jax.training.summary import (
    model_summary,
    summary_json,
    summary_lines,
)
from crisalad_jax.utils.errors import InputError

EXAMPLE = "crisalad info --preset b14"


@dataclasses.dataclass(frozen=True)
class Info:
    """Print what a model is made of: parameters, what trains, multiply-accumulates an image."""

    preset: str | None = None
    """tiny, s14, b14 (the default), l14 or g14."""
    weights: pathlib.Path | None = None
    """Describe the model in this file of this package instead, or a published one, by its name."""
    map: pathlib.Path | None = None
    """Describe the map in this folder instead."""
    verify: bool = False
    """Read all of the map's descriptors, and compare them with their digests."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of the patch size; by default the model's."""
    resize: tuple[str, ...] = ()
    """Words in place of the model's way: fixed, shorter-side, longer-side or native; bilinear,
    bicubic or area; antialias or no-antialias; bytes or floats; round;
    high-byte or contrast-stretch, for 16 bits and floats (docs/resizing.md)."""
    trainable: str | None = None
    """head, adapters+head, last-N-blocks+head or all; by default the recipe's, of
    a file adapters+head, or head where it has no adapter."""
    batch_size: int = 16
    """Images that look at each other in the cross-image encoder."""
    json: pathlib.Path | None = None
    """File for the table as JSON; - prints it."""
    plugin: tuple[str, ...] = ()
    """Files FILE.py or modules that register parts of your own; their code is run."""


def run(arguments: Info) -> None:
    """Print the table of a model or a map, and write it as JSON where that is asked for."""
    if arguments.verify and arguments.map is None:
        raise InputError("--verify: found without --map, expected both")
    prepare_json(arguments.json)
    values = _model(arguments) if arguments.map is None else _map(arguments.map, arguments)
    give_json(arguments.json, values)


def _model(arguments: Info) -> dict[str, Any]:
    check_one_model(arguments.weights, arguments.preset)
    if arguments.weights is not None:
        _, config = load_weights(find_weights(arguments.weights))
        name, trainable = str(arguments.weights), arguments.trainable
    else:
        name = arguments.preset or "b14"
        defaults = recipe(name)
        config = defaults.model
        trainable = arguments.trainable or defaults.trainable
    config = config.resized(arguments.image_size, arguments.resize)
    summary = model_summary(config, trainable, images=arguments.batch_size)
    show(summary_table(summary, name))
    say("\n".join(summary_lines(summary)))
    return summary_json(summary, name)


def _map(folder: pathlib.Path, arguments: Info) -> dict[str, Any]:
    for field in dataclasses.fields(Info):
        of_maps = field.name in ("map", "verify", "json", "plugin")
        if not of_maps and getattr(arguments, field.name) != field.default:
            raise InputError(
                f"--{field.name.replace('_', '-')}: found beside --map, expected it for a model"
            )
    with Map.open(folder, verify=False) as places:
        summary = places.summary(verify=arguments.verify)
    extent = summary["extent"] or {}
    ends = {axis: f"{low:.9g} to {high:.9g}" for axis, (low, high) in extent.items()}
    known = {name: value for name, value in summary.items() if value not in (None, "none")}
    for line in fact_lines(known | ({"extent": ends} if ends else {})):
        say(line)
    return summary
