"""`crisalad compare`, and what `crisalad ablate` shares with it."""

import pathlib
from typing import Annotated, Any, Literal

import rich.console

from crisalad_jax.cli.common import echo, find_given, pick, show_tables
from crisalad_jax.cli.flags import FOLDER, ClusterFlag, ReadFlags, SizeFlags, TableFlags


class ComparisonFlags(ReadFlags, SizeFlags, TableFlags, ClusterFlag):
    """Flags that `compare` and `ablate` share."""

    test: tuple[pathlib.Path, ...]
    """Evaluation sets, each in any layout that `evaluate` reads."""
    out: Annotated[pathlib.Path, FOLDER]
    """Folder of the comparison; the same command resumes it. Results are in table.md, table.csv,
    results.json and the page index.html."""
    train: pathlib.Path | None = None
    """Training set: a folder with one folder per place, a table name,place[,lat,lon[,heading]]
    (places.csv in the folder, or the file), or Dataframes/ and Images/ of GSV-Cities."""
    backbone: pathlib.Path | None = None
    """Train from this backbone, as the recipes say: a weight file of this package, a public
    checkpoint, or a published model's name. Without it, the recipe scratch trains from scratch."""
    preset: str = "b14"
    """Model size: tiny, s14, b14, l14 or g14."""
    seeds: int = 3
    """Number of runs of each method, with seeds 0, 1 and so on."""
    epochs: int | None = None
    """Number of epochs; by default as the recipes say, or 6 from scratch."""
    grouping: str = "single"
    """Groupings for methods with a cross-image encoder, comma-separated as in `evaluate`."""
    reference: str | None = None
    """Row that differences, speeds and training times are relative to; by default crisalad, or the
    first if that is not compared."""
    jobs: int | None = None
    """Number of parallel runs, each a Ray task (extra ray) with its share of the devices, on this
    machine or --cluster. By default 1; on a cluster one per GPU, or per node without GPUs."""


def names_of(text: str) -> tuple[str, ...]:
    """Split text at commas into names, without the spaces around them."""
    return tuple(name.strip() for name in text.split(","))


def run_comparison(
    flags: ComparisonFlags,
    command: Literal["compare", "ablate"],
    names: tuple[str, ...],
    **more: Any,
) -> dict[str, Any]:
    """Run a comparison, and print its tables.

    Args:
        flags: the flags that both commands share.
        command: "compare" or "ablate".
        names: names of the methods or rows to compare.
        **more: settings of `ComparisonConfig` that only one of the two commands has.

    Returns:
        The result as JSON values.
    """
    from crisalad_jax.experiments.comparison import ComparisonConfig, compare
    from crisalad_jax.experiments.comparison.tables import as_json, tables_of

    backbone = find_given(flags.backbone, quiet=flags.quiet)
    config = ComparisonConfig(
        command,
        names,
        test=tuple(map(str, flags.test)),
        train=None if flags.train is None else str(flags.train),
        backbone=None if backbone is None else str(backbone),
        **pick(flags, "preset", "epochs", "image_size", "resize", "batch_size", "on_bad_image"),
        **pick(flags, "grouping", "seeds", "reference"),
        **more,
    )
    notes = rich.console.Console(stderr=True, markup=False, emoji=False, quiet=flags.quiet)
    summary = compare(
        config,
        flags.out,
        **pick(flags, "jobs", "cluster", "quiet"),
        say=lambda line: notes.print(line, soft_wrap=True, highlight=False),
    )
    show_tables(*tables_of(summary).values(), latex=flags.latex)
    for note in summary.notes:
        echo(note)
    echo(f"table.md, table.csv, results.json, and a page: {flags.out / 'index.html'}")
    return as_json(summary)


class Compare(ComparisonFlags):
    """Train or load the paper's Table 1 methods, evaluate them the same way, and print tables."""

    methods: str | None = None
    """Methods, comma-separated. By default the models of --weights; without --weights, or if it
    names only methods, those of Table 1 over one backbone: crisalad+netvlad (or gem, conv-ap,
    patch-netvlad, transvpr, mixvpr: that head with CriSALAD's backbone and training), cosplace-vit,
    eigenplaces-vit, anyloc, cricavpr, salad, crisalad, boq. Any recipe of `train` is a method too,
    and so is RECIPE+PART, with a registered part as NAME or KIND:NAME."""
    weights: tuple[str, ...] = ()
    """NAME=FILE or the NAME of a published model (`crisalad models`). If NAME is a method, it uses
    these weights and is not trained. Any other name adds a row; with + and a second stage, as in
    fol-large+fol, the model's first retrievals are re-ranked."""
    rerank: int = 20
    """Number of retrievals that a second stage re-ranks."""


def run(arguments: Compare) -> dict[str, Any]:
    """Compare the methods, and print the tables; return the result for --json."""
    from crisalad_jax.experiments.comparison import names_to_compare

    methods = None if arguments.methods is None else names_of(arguments.methods)
    names = names_to_compare(methods, arguments.weights)
    return run_comparison(
        arguments, "compare", names, weights=arguments.weights, rerank=arguments.rerank
    )
