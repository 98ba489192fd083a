"""Helpers that several commands share: terminal output, and loading the model that flags name."""

import dataclasses
import json
import pathlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, get_type_hints

import rich.console
import rich.table

from crisalad_jax.checkpoints.load import OpenedModel, find_weights, open_model
from crisalad_jax.cli.flags import (
    ModelFlags,
    PositionFlags,
    QueryRuntimeName,
    SetFlags,
    SizeFlags,
    Target,
)
from crisalad_jax.config.checks import require
from crisalad_jax.config.part import with_non_semantic_fields_of
from crisalad_jax.experiments.tables import Table, write_text
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import check_format, write_json
from crisalad_jax.utils.output import printable

if TYPE_CHECKING:  # commands that load no model of a file start without these
    from crisalad_jax.data.benchmarks import Benchmark
    from crisalad_jax.data.tracks import Track
    from crisalad_jax.nn.config import ModelConfig
    from crisalad_jax.nn.model import Model
    from crisalad_jax.training.config import TrainConfig
    from crisalad_jax.training.loop import FitResult

_WIDE = 10_000
"""A number of columns that no table fills."""
# A file or a pipe has room for all columns. Brackets and colons in names are text.
console = rich.console.Console(
    width=None if sys.stdout.isatty() else _WIDE, markup=False, emoji=False
)


def echo(line: str) -> None:
    """Print a line without wrapping it to the terminal's width."""
    console.print(printable(line), soft_wrap=True, highlight=False)


def show(table: rich.table.Table) -> None:
    """Print a table without wrapping; split a wide one into parts, each with the first column.

    The terminal still wraps a column that is wider than the terminal.
    """
    if table.title:
        echo(str(table.title))
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
    """Make a table of some columns without wrapping, and return its width too."""
    part = rich.table.Table(show_lines=table.show_lines)
    for column in columns:
        part.add_column(column.header, justify=column.justify, no_wrap=True)
    for row, cells in zip(table.rows, zip(*(c.cells for c in columns), strict=True), strict=True):
        part.add_row(*cells, end_section=row.end_section)
    part.width = console.measure(part, options=console.options.update(max_width=_WIDE)).maximum
    return part, part.width


STDOUT = pathlib.Path("-")
"""Path that means standard output, for --json and --latex."""


def prepare_output(flags: Any) -> None:
    """Check that a command's outputs can be written, before it does any work.

    If --json or --latex is `STDOUT`, everything else is printed on stderr from then on.

    Raises:
        InputError: a file or folder cannot be made, a file's suffix is of another format, or both
            --json and --latex are `STDOUT`.
    """
    printed = [name for name in ("json", "latex") if getattr(flags, name, None) == STDOUT]
    require(len(printed) < 2, "--latex: found - with --json -, expected only one of the two")
    console.stderr = bool(printed)
    hints = get_type_hints(type(flags), include_extras=True)
    marks = [(name, mark) for name in hints for mark in getattr(hints[name], "__metadata__", ())]
    for name, target in marks:
        path = getattr(flags, name)
        if isinstance(target, Target) and path is not None and name not in printed:
            if target.suffixes:
                check_format(f"--{name}", path, *target.suffixes)
            target.check(path)


class Jax:
    """The set-up of JAX for a command."""

    keeps_programs: ClassVar[bool] = False
    """Whether to store compiled programs; see `executable_cache.cache_executables`."""

    @classmethod
    def set_up(cls) -> None:
        """Set up devices and caches, as `compiler.set_up` does, but without starting a device."""
        from crisalad_jax.utils import compiler, executable_cache

        compiler.configure()
        if cls.keeps_programs:
            executable_cache.cache_executables()


def emit_json(file: pathlib.Path | None, value: Mapping[str, Any]) -> None:
    """Write a command's result as JSON, or print it if `file` is `STDOUT`; do neither if None.

    Raises:
        InputError: the file cannot be written.
    """
    if file == STDOUT:
        print(json.dumps(value, indent=2))
    elif file is not None:
        write_json(file, value)


def show_tables(*tables: Table, latex: pathlib.Path | None = None) -> None:
    """Print tables, and pass them to `emit_latex`, with `latex` as the file."""
    for table in tables:
        show(table.terminal())
    emit_latex(latex, *tables)


def emit_latex(file: pathlib.Path | None, *tables: Table) -> None:
    """Write tables as LaTeX, or print them if `file` is `STDOUT`; do neither if None.

    Raises:
        InputError: the file cannot be written.
    """
    text = "\n".join(table.latex() for table in tables)
    if file == STDOUT:
        print(text, end="")
    elif file is not None:
        write_text(file, text)


def first_of(names: Sequence[str]) -> str:
    """Return "'NAME' the first", to end a message that counts some names; "" without names."""
    return f"{names[0]!r} the first" if names else ""


def pick(flags: Any, *names: str) -> dict[str, Any]:
    """Return the values of some flags by name, for a function with arguments of the same names."""
    return {name: getattr(flags, name) for name in names}


def refuse_with(flag: str, **others: Any) -> None:
    """Raise InputError if one of `others`, values of flags that exclude `flag`, is given."""
    for name in _given(others):
        raise InputError(f"{name}: found with {flag}, expected only one of the two")


def refuse_without(flag: str, value: Any, **others: Any) -> None:
    """Raise InputError if a flag that needs another flag is given without it.

    Args:
        flag: name of the other flag, such as "--verify".
        value: value of the other flag; None if it is not given.
        **others: values, by name, of the flags that need it.
    """
    for name in _given(others) if value is None else ():
        raise InputError(f"{name}: found without {flag}, expected both")


def _given(flags: Mapping[str, Any]) -> list[str]:
    """List the flags that have a value, 0 included."""
    return [
        f"--{name.replace('_', '-')}"
        for name, value in flags.items()
        if value is not None and value is not False and value != ()
    ]


def fit_words(result: "FitResult", config: "TrainConfig") -> str:
    """Describe how a run ended: its steps, its best recall, the images that it skipped."""
    words = [f"{result.steps} steps"]
    if result.stopped_early:
        words.append("stopped early")
    if result.best_recall is not None:
        words.append(f"best {config.monitor} {100 * result.best_recall:.1f} in best.safetensors")
    if result.skipped_images:
        words.append(f"{result.skipped_images} unreadable images skipped")
    return ", ".join(words)


def find_given(
    weights: pathlib.Path | None, *, runtime: QueryRuntimeName = "jax", quiet: bool = False
) -> pathlib.Path | None:
    """Return the file for an optional flag, as `find_weights` finds it; None if not given.

    For a runtime other than "jax", it may be the folder of an exported model.
    """
    return None if weights is None else find_weights(weights, engine=runtime, quiet=quiet)


def given_positions(flags: PositionFlags) -> "Track | pathlib.Path | None":
    """Return --positions in the form that the library takes: a file, or a track with its times.

    Raises:
        InputError: a time flag is given without --positions, or the track cannot be read.
    """
    start, offset = flags.start_time, flags.time_offset
    refuse_without("--positions", flags.positions, start_time=start, time_offset=offset)
    if flags.positions is None or (start is None and offset is None):
        return flags.positions
    from crisalad_jax.data.tracks import read_track

    return read_track(flags.positions, start_time=start, time_offset=offset or 0.0)


def open_set(flags: Any) -> "Benchmark":
    """Open the evaluation set that the flags name, and print its size and what counts as positive.

    Raises:
        InputError: the set cannot be read, or the flags do not fit it.
    """
    from crisalad_jax.data.benchmarks import open_benchmark

    names = [field.name for field in dataclasses.fields(SetFlags) if field.name != "data"]
    benchmark = open_benchmark(flags.data, **pick(flags, *names, "on_bad_image"))
    echo(
        f"{benchmark.name}: {len(benchmark.queries)} queries, {len(benchmark.database)} database "
        f"images; positive: {benchmark.rule}"
    )
    return benchmark


def load_model(weights: pathlib.Path, flags: SizeFlags, *, quiet: bool = False) -> "Model":
    """Load a model in JAX by its file or name, and apply `flags` to its configuration.

    Raises:
        InputError: the model cannot be found or loaded, or the flags do not fit it.
    """
    from crisalad_jax.checkpoints.weights import load_weights

    model = load_weights(find_weights(weights, quiet=quiet))
    return model._replace(config=flags.applied_to(model.config))


def open_flagged(
    flags: ModelFlags,
    weights: pathlib.Path | None = None,
    *,
    groupings: Sequence[str] = ("single",),
    like: "ModelConfig | None" = None,
) -> OpenedModel:
    """Open the model of --weights in the engine of --runtime.

    Args:
        flags: which model, and how it describes images.
        weights: a file in place of --weights.
        groupings: all groupings under which the model will describe images.
        like: a map's configuration, whose image size, resize and types the flags then change.

    Raises:
        InputError: the model cannot be found or opened, or the flags do not fit it.
    """
    return open_model(
        weights or flags.weights,
        flags.runtime,
        lambda config: flags.applied_to(
            config if like is None else with_non_semantic_fields_of(like, config)
        ),
        groupings=groupings,
        verify=flags.checksums,
        quiet=flags.quiet,
    )
