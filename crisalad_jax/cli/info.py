"""`crisalad info`."""

import dataclasses
import pathlib

import rich.table

from crisalad_jax.checkpoint import load_weights
from crisalad_jax.cli.common import console, resized
from crisalad_jax.config import recipe
from crisalad_jax.costs import adapter_macs, paper_adapter_macs, part_costs
from crisalad_jax.errors import InputError
from crisalad_jax.files import check_target, write_json
from crisalad_jax.groupings import check_grouping
from crisalad_jax.maps import open_map


@dataclasses.dataclass(frozen=True)
class Info:
    """Print what a model is made of: parameters, what trains, multiply-accumulates an image."""

    preset: str = "b14"
    """tiny, s14, b14, l14 or g14."""
    weights: pathlib.Path | None = None
    """Describe the model in this file instead."""
    map: pathlib.Path | None = None
    """Describe the map in this folder instead."""
    verify: bool = False
    """Read all of the map's descriptors, and compare them with their digests."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of 14; by default the model's."""
    trains: str | None = None
    """head, adapters+head, last-N-blocks+head or all; by default the recipe's, of
    a file adapters+head, or head where it has no adapter."""
    batch_size: int = 16
    """Images that look at each other in the cross-image encoder."""
    json: pathlib.Path | None = None
    """File for the table as JSON."""


def run(arguments: Info) -> None:
    """Print the table."""
    from crisalad_jax.training import trained_parameters

    check_grouping((), arguments.batch_size, seed=0)
    if arguments.verify and arguments.map is None:
        raise InputError("--verify: found without --map, expected both")
    if arguments.json is not None:
        check_target(arguments.json)
    if arguments.map is not None:
        _check_alone(arguments)
        _describe_map(arguments.map, arguments)
        return
    if arguments.weights is not None:
        _, config = load_weights(arguments.weights)
        title = str(arguments.weights)
        adapted = config.backbone.adapter.kind != "none"
        trains = arguments.trains or ("adapters+head" if adapted else "head")
    else:
        defaults = recipe(arguments.preset)
        config, trains = defaults.model, arguments.trains or defaults.trains
        title = arguments.preset
    config = resized(config, arguments.image_size)
    costs = part_costs(config, images=arguments.batch_size)
    total, macs = sum(c.parameters for c in costs), sum(c.macs for c in costs)
    trained = trained_parameters(config, trains)
    summary = {
        "model": title,
        "image_size": list(config.image_size),
        "descriptor": config.descriptor_dim,
        "trains": trains,
        "trainable_parameters": trained,
        "frozen_parameters": total - trained,
        "parts": [cost._asdict() for cost in costs],
    }
    table = rich.table.Table(
        "part", title=f"{title} at {config.image_size[0]} x {config.image_size[1]}"
    )
    table.add_column("parameters", justify="right")
    table.add_column("multiply-accumulates an image", justify="right")
    for cost in costs:
        table.add_row(cost.part, f"{cost.parameters:,}", f"{cost.macs:,}")
    table.add_section()
    table.add_row("all", f"{total:,}", f"{macs:,}")
    console.print(table)
    lines = [
        f"descriptor            {config.descriptor_dim:>13,} numbers",
        f"trainable             {trained:>13,} parameters ({trains})",
        f"frozen                {total - trained:>13,} parameters",
    ]
    if config.backbone.adapter.kind != "none":
        one = next(c.parameters for c in costs if c.part == "adapters") // config.backbone.depth
        true, paper = adapter_macs(config), paper_adapter_macs(config)
        summary["one_adapter"] = {"parameters": one, "macs": true, "paper_macs": paper}
        lines += [
            f"one adapter           {one:>13,} parameters",
            f"  multiply-accumulates{true:>13,} an image, linears at every token",
            f"  as the paper counts {paper:>13,} (Table 3: each linear once, convolutions at every "
            "patch)",
        ]
    console.print("\n".join(lines), soft_wrap=True, highlight=False)
    if arguments.json is not None:
        write_json(arguments.json, summary)


def _check_alone(arguments: Info) -> None:
    """That nothing is asked of a model beside a map."""
    for field in dataclasses.fields(Info):
        of_maps = field.name in ("map", "verify", "json")
        if not of_maps and getattr(arguments, field.name) != field.default:
            raise InputError(
                f"--{field.name.replace('_', '-')}: found beside --map, expected it for a model"
            )


def _describe_map(folder: pathlib.Path, arguments: Info) -> None:
    with open_map(folder) as opened:
        if arguments.verify:
            opened.verify()
        description = opened.description
        summary = {
            "images": len(opened),
            "positions": sum(image.position is not None for image in opened.images),
            "axes": opened.axes,
            "descriptor": f"{description.descriptor_length} numbers, {description.dtype}",
            "image_size": list(description.config.image_size),
            "grouping": description.grouping,
            "store": description.store,
            "model": description.model,
            "weights": description.weights,
            "created": description.created,
            "verified": arguments.verify,
        }
    width = max(map(len, summary))
    lines = (f"{name:<{width}}  {value}" for name, value in summary.items())
    console.print("\n".join(lines), soft_wrap=True, highlight=False)
    if arguments.json is not None:
        write_json(arguments.json, summary)
