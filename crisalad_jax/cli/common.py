"""Helpers of several commands: the terminal, and loading a model as their flags name it."""

import dataclasses
import json
import pathlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import rich.console
import rich.table

from crisalad_jax.checkpoints import starter
from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.config.checks import check_seed
from crisalad_jax.config.part import with_non_semantic_fields_of
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import check_format, check_target, write_json
from crisalad_jax.utils.output import printable

if TYPE_CHECKING:  # commands that load no model of a file start without these
    from crisalad_jax.checkpoints.runtime import Runtime
    from crisalad_jax.data.benchmarks import Benchmark
    from crisalad_jax.nn.config import ModelConfig
    from crisalad_jax.nn.model import Model

RuntimeName = Literal["jax", "onnxruntime", "openvino"]
"""What computes a model: JAX, or another engine (`checkpoints.engines.EngineName`)."""

_WIDE = 10_000
"""Columns that no table fills."""
# A file or a pipe has room for all columns. Brackets and colons in names are text.
console = rich.console.Console(
    width=None if sys.stdout.isatty() else _WIDE, markup=False, emoji=False
)


def say(line: str) -> None:
    """Print a line without wrapping it to the terminal's width."""
    console.print(printable(line), soft_wrap=True, highlight=False)


def show(table: rich.table.Table) -> None:
    """Print a table so that nothing in it breaks; a wide one in parts, each with the first column.

    A terminal has no room for a column that is wider than itself, and breaks its lines.
    """
    if table.title:
        say(str(table.title))
        table.title = None
    for part in _parts(table):
        console.print(part, crop=False)


def _parts(table: rich.table.Table) -> Iterator[rich.table.Table]:
    first, *rest = table.columns
    while True:
        count = len(rest)
        while (part := _part(table, [first, *rest[:count]]))[1] > console.width and count > 1:
            count -= 1
        yield part[0]
        rest = rest[count:]
        if not rest:
            return


def _part(
    table: rich.table.Table, columns: Sequence[rich.table.Column]
) -> tuple[rich.table.Table, int]:
    """Make a table of some columns that breaks no line, and return its width too."""
    part = rich.table.Table(show_lines=table.show_lines)
    for column in columns:
        part.add_column(column.header, justify=column.justify, no_wrap=True)
    for row, cells in zip(table.rows, zip(*(c.cells for c in columns), strict=True), strict=True):
        part.add_row(*cells, end_section=row.end_section)
    part.width = console.measure(part, options=console.options.update(max_width=_WIDE)).maximum
    return part, part.width


STDOUT = pathlib.Path("-")
"""Name of the terminal, or of what reads the output, in place of a file of JSON."""


def talk_beside(file: pathlib.Path | None) -> None:
    """Say everything on standard error where JSON is printed on standard output."""
    console.stderr = file == STDOUT


def write_or_print_json(path: pathlib.Path, value: Mapping[str, Any]) -> None:
    """Write an object as JSON, or print it where the file is `STDOUT`.

    Raises:
        InputError: the file cannot be written.
    """
    if path == STDOUT:
        print(json.dumps(value, indent=2))
    else:
        write_json(path, value)


def check_json(path: pathlib.Path | None, suffixes: Sequence[str] = (".json",)) -> None:
    """Check that `write_or_print_json` can write the file, before any work.

    Raises:
        InputError: it cannot, or the name says another format than those of `suffixes`.
    """
    if path is None or path == STDOUT:
        return
    check_format("--json", path, *suffixes)
    check_target(path)


def prepare_json(file: pathlib.Path | None) -> None:
    """Check a flag --json before any work, and keep standard output for it where it is `STDOUT`.

    Raises:
        InputError: the file cannot be written.
    """
    check_json(file)
    talk_beside(file)


def give_json(file: pathlib.Path | None, value: Mapping[str, Any]) -> None:
    """Write or print a command's result, where --json asks for it.

    Raises:
        InputError: the file cannot be written.
    """
    if file is not None:
        write_or_print_json(file, value)


def find_given(
    weights: pathlib.Path | None, *, runtime: RuntimeName = "jax", quiet: bool = False
) -> pathlib.Path | None:
    """Return the file that an optional flag means, as `find_weights` does; None where not given.

    For another runtime a folder is an exported model: no name to look up, which would import JAX.
    """
    if weights is None or (runtime != "jax" and weights.is_dir()):
        return weights
    return find_weights(weights, quiet=quiet)


def check_one_model(weights: pathlib.Path | None, preset: str | None) -> None:
    """Raise InputError where a preset is given beside weights, which have their own sizes."""
    if weights is not None and preset is not None:
        raise InputError("--preset: found beside --weights, expected only one of the two")


def open_set(arguments: Any) -> "Benchmark":
    """Open the evaluation set that a command's flags name, and say what it is.

    Args:
        arguments: has the flags of `evaluate` that say which set, how it lies and what is right.

    Raises:
        InputError: what `open_benchmark` raises.
    """
    from crisalad_jax.data.benchmarks import open_benchmark

    benchmark = open_benchmark(
        arguments.data,
        arguments.split,
        arguments.radius,
        images=arguments.images,
        max_heading_difference=arguments.max_heading_difference,
        frames=arguments.frames,
        queries=arguments.queries,
        ignore_zones=arguments.ignore_zones,
        layout=arguments.layout,
        on_bad_image=arguments.on_bad_image,
    )
    say(
        f"{benchmark.name}: {len(benchmark.queries)} queries, {len(benchmark.database)} database "
        f"images; positive: {benchmark.rule}"
    )
    return benchmark


def open_model(
    weights: pathlib.Path,
    flags: Any,
    *,
    groupings: Sequence[str] = ("single",),
    like: "ModelConfig | None" = None,
) -> "tuple[Model | Runtime, str]":
    """Load a model for JAX, or open it in another engine.

    Args:
        weights: the file, a published model's name, or for other engines an exported folder.
        flags: has those of `flags.ModelFlags` and `flags.ReadFlags`.
        groupings: the groupings that images will be described in.
        like: configuration of a map, whose image size and types the flags then change.

    Returns:
        The model, and its name for tables and titles.

    Raises:
        InputError: what `find_weights`, `load_weights`, `ModelConfig.resized` and `open_runtime`
            raise.
    """
    from crisalad_jax.checkpoints.runtime import open_runtime, read_model

    file = find_given(weights, runtime=flags.runtime, quiet=flags.quiet) or weights
    if flags.runtime == "jax":
        return load_model(file, flags, like=like, verify=flags.verify)
    config = _changed(read_model(file), flags, like)
    if config.compute_dtype == "float64":
        raise InputError(f"--runtime: found {flags.runtime} with a model of float64, expected jax")
    attends = bool(config.cross_image.layers)
    model = open_runtime(
        file,
        flags.runtime,
        image_size=config.image_size,
        preprocessing=config.preprocessing,
        precision=config.compute_dtype,
        any_grouping=attends and set("/".join(groupings).split("/")) != {"single"},
        verify=flags.verify,
    )
    return model, f"{_name(file)}, {flags.runtime}"


def load_model(
    file: pathlib.Path, flags: Any, *, like: "ModelConfig | None" = None, verify: bool = True
) -> "tuple[Model, str]":
    """Load a model of JAX's, changed by flags; see `open_model`."""
    from crisalad_jax.checkpoints.weights import load_weights

    model = load_weights(file, verify=verify)
    return model._replace(config=_changed(model.config, flags, like)), _name(file)


def untrained(preset: str, flags: Any) -> "tuple[Model, str]":
    """Make an untrained model of a preset, with the flags of `evaluate`."""
    import jax

    from crisalad_jax.nn.model import Model, init_crisalad
    from crisalad_jax.training.recipes import recipe

    check_seed("seed", flags.seed)
    config = recipe(preset).model
    params = init_crisalad(jax.random.key(flags.seed), config)
    return Model(params, _changed(config, flags)), f"untrained {preset}, seed {flags.seed}"


def _changed(config: "ModelConfig", flags: Any, like: "ModelConfig | None" = None) -> "ModelConfig":
    """Change how images are resized and computed to what the map and the flags say."""
    if like is not None:
        config = with_non_semantic_fields_of(like, config)
    if flags.compute_dtype is not None:
        config = dataclasses.replace(config, compute_dtype=flags.compute_dtype)
    return config.resized(flags.image_size, flags.resize)


def _name(weights: pathlib.Path) -> str:
    """Return what a file of weights is called in tables and titles."""
    if weights in starter.FILES.values():
        return starter.named(weights)
    return f"{weights.parent.name}/{weights.name}" if weights.parent.name else weights.name
