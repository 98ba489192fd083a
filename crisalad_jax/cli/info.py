"""`crisalad info`."""

import dataclasses
import pathlib
from typing import Any

from crisalad_jax.cli.common import echo, load_model, refuse_with, refuse_without, show_tables
from crisalad_jax.cli.flags import PluginFlag, SizeFlags, TableFlags
from crisalad_jax.cli.tables import fact_lines, summary_table
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.training.recipes import recipe
from crisalad_jax.training.summary import model_summary, summary_json, summary_lines


class Info(SizeFlags, PluginFlag, TableFlags):
    """Print a model's parts: their parameters, what trains, multiply-accumulates per image."""

    preset: str | None = None
    """Model size: tiny, s14, b14 (the default), l14 or g14."""
    weights: pathlib.Path | None = None
    """Describe this model instead: a weight file of this package, or a published model's name."""
    map: pathlib.Path | None = None
    """Describe the map in this folder instead."""
    checksums: bool = False
    """With --map: read all of its descriptors, and compare them with their checksums."""
    trainable: str | None = None
    """Parameters that train, as in `train`: all, groups such as adapters,head, or patterns of
    names; by default the recipe's, or with --weights adapters,head (only head without adapters)."""
    batch_size: int = 16
    """Number of images that attend to each other in the cross-image encoder."""


def run(arguments: Info) -> dict[str, Any]:
    """Print what a model or a map contains; return the result for --json."""
    refuse_without("--map", arguments.map, checksums=arguments.checksums)
    return _model(arguments) if arguments.map is None else _map(arguments.map, arguments)


def _model(arguments: Info) -> dict[str, Any]:
    trainable = arguments.trainable
    if arguments.weights is not None:
        refuse_with("--weights", preset=arguments.preset)
        name, config = str(arguments.weights), load_model(arguments.weights, arguments).config
    else:
        name = arguments.preset or "b14"
        defaults = recipe(name)
        config = arguments.applied_to(defaults.model)
        trainable = trainable or defaults.trainable
    summary = model_summary(config, trainable, images=arguments.batch_size)
    show_tables(summary_table(summary, name), latex=arguments.latex)
    echo("\n".join(summary_lines(summary)))
    return summary_json(summary, name)


def _map(folder: pathlib.Path, arguments: Info) -> dict[str, Any]:
    of_models = {
        field.name: getattr(arguments, field.name) != field.default
        for field in dataclasses.fields(Info)
        if field.name not in ("map", "checksums", "json", "plugin")
    }
    refuse_with("--map", **of_models)
    with Map.open(folder, verify=False) as places:
        summary = places.summary(verify=arguments.checksums)
    extent = summary["extent"] or {}
    ends = {axis: f"{low:.9g} to {high:.9g}" for axis, (low, high) in extent.items()}
    known = {name: value for name, value in summary.items() if value not in (None, "none")}
    for line in fact_lines(known | ({"extent": ends} if ends else {})):
        echo(line)
    return summary
