"""What `crisalad compare` and `crisalad ablate` share: their flags, and their work."""

import dataclasses
import pathlib
from typing import TYPE_CHECKING, Any

import rich.console

from crisalad_jax.cli.common import console
from crisalad_jax.files import around, check_target

if TYPE_CHECKING:
    from crisalad_jax.comparison import AdapterCost, ComparisonConfig


@dataclasses.dataclass(frozen=True)
class Side:
    """The flags of both commands."""

    test: tuple[pathlib.Path, ...]
    """Evaluation sets, each in any layout that `evaluate` reads."""
    out: pathlib.Path
    """Folder of the comparison; the same command goes on with what is in it. Beside the runs it
    holds table.md, table.csv, results.json, and the page index.html."""
    train: pathlib.Path | None = None
    """Training set, in the layout of GSV-Cities."""
    backbone: pathlib.Path | None = None
    """Train from this backbone, as the recipes say: a file of this package or a public checkpoint.
    None trains all from nothing, by the recipe scratch."""
    preset: str = "b14"
    """tiny, s14, b14, l14 or g14."""
    seeds: int = 3
    """Runs of each, of seed 0, 1 and so on."""
    epochs: int | None = None
    """By default the recipes'; from nothing 6."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of 14; by default the preset's."""
    batch_size: int = 16
    """Images described together, which a grouping lets look at each other."""
    grouping: str = "single"
    """Comma-separated, as `evaluate` takes them, for methods with a cross-image encoder."""
    page: pathlib.Path | None = None
    """Also put the tables into this Markdown page, between its comments <!-- NAME --> and <!-- end
    of NAME -->, where NAME is the name of the folder --out."""
    quiet: bool = False
    """No progress."""


def settings_of(arguments: Side) -> dict[str, Any]:
    """What the flags say of a `ComparisonConfig`."""

    def text(path: pathlib.Path | None) -> str | None:
        return None if path is None else str(path)

    return {
        "test": tuple(map(str, arguments.test)),
        "train": text(arguments.train),
        "backbone": text(arguments.backbone),
        "preset": arguments.preset,
        "epochs": arguments.epochs,
        "image_size": arguments.image_size,
        "batch_size": arguments.batch_size,
        "grouping": arguments.grouping,
        "seeds": arguments.seeds,
    }


def names_of(text: str) -> tuple[str, ...]:
    """Names between commas."""
    return tuple(name.strip() for name in text.split(","))


def compare(config: "ComparisonConfig", arguments: Side) -> None:
    """Check all that can be checked, do what is left, print and write the tables."""
    from crisalad_jax.comparison import carry_out, claim, prepare, summarise, tables
    from crisalad_jax.comparison.page import write_page

    out = arguments.out
    check_target(out / "config.json")
    place = out.resolve().name
    if arguments.page is not None:
        around(arguments.page, place)
    prepared = prepare(config)
    claim(out, prepared)
    notes = rich.console.Console(stderr=True, markup=False, emoji=False, quiet=arguments.quiet)
    notes.print(_start_words(config), soft_wrap=True, highlight=False)

    def say(line: str) -> None:
        notes.print(line, soft_wrap=True, highlight=False)

    carry_out(prepared, out, say=say, quiet=arguments.quiet)
    summary = summarise(prepared, out, _adapters(config, out))
    console.print(tables.recall_table(summary))
    console.print(tables.cost_table(summary))
    if summary.adapters:
        console.print(tables.adapter_table(summary.adapters))
    for note in summary.notes:
        console.print(note, soft_wrap=True, highlight=False)
    tables.write_tables(summary, out)
    page = write_page(summary, out)
    if arguments.page is not None:
        tables.put_in_page(arguments.page, place, tables.markdown(summary))
    console.print(f"table.md, table.csv, results.json, and a page: {page}", soft_wrap=True)


def _start_words(config: "ComparisonConfig") -> str:
    start = "from nothing" if config.backbone is None else f"from {config.backbone}"
    return f"{len(config.names)} to compare, {config.preset}, what is trained starts {start}"


def _adapters(config: "ComparisonConfig", out: pathlib.Path) -> "list[AdapterCost]":
    """Table 3, of an ablation."""
    from crisalad_jax.comparison import adapter_costs_once

    return adapter_costs_once(out) if config.kind == "ablate" else []
