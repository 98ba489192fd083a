"""The flags that `crisalad compare` and `crisalad ablate` share, and what they print."""

import dataclasses
import pathlib
from typing import TYPE_CHECKING, Any, Literal

import rich.console

from crisalad_jax.cli.common import find_given, give_json, say, show

if TYPE_CHECKING:
    from crisalad_jax.experiments.comparison import ComparisonConfig


@dataclasses.dataclass(frozen=True)
class ComparisonFlags:
    """The flags of both commands."""

    test: tuple[pathlib.Path, ...]
    """Evaluation sets, each in any layout that `evaluate` reads."""
    out: pathlib.Path
    """Folder of the comparison; the same command resumes what is in it. It also gets table.md,
    table.csv, results.json, and the page index.html."""
    train: pathlib.Path | None = None
    """Training set: a folder with one folder a place, a table name,place[,lat,lon[,heading]]
    (places.csv in the folder, or the file), or Dataframes/ and Images/ of GSV-Cities."""
    backbone: pathlib.Path | None = None
    """Train from this backbone, as the recipes say: a file of this package, a public checkpoint, or
    a published model's name. None trains all from nothing, by the recipe scratch."""
    preset: str = "b14"
    """tiny, s14, b14, l14 or g14."""
    seeds: int = 3
    """Runs of each, of seed 0, 1 and so on."""
    epochs: int | None = None
    """By default the recipes'; from nothing 6."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of the patch size; by default the preset's, or a file's."""
    resize: tuple[str, ...] = ()
    """Words in place of every model's way: fixed, shorter-side, longer-side or native; bilinear,
    bicubic or area; antialias or no-antialias; bytes or floats; round;
    high-byte or contrast-stretch, for 16 bits and floats (docs/resizing.md)."""
    batch_size: int = 16
    """Images described together, which a grouping lets attend to each other."""
    grouping: str = "single"
    """Comma-separated, as `evaluate` takes them, for methods with a cross-image encoder."""
    reference: str | None = None
    """Which line differences, speeds and training times are relative to; by default crisalad, or
    the first where that is not compared."""
    jobs: int = 1
    """Runs at once, each in a process of its own: on a GPU of its own where there are as many, else
    sharing one. Other hosts that run the same command on a shared folder take runs too."""
    page: pathlib.Path | None = None
    """Also put the tables into this Markdown page, between its comments <!-- NAME --> and <!-- end
    of NAME -->, where NAME is the name of the folder --out."""
    json: pathlib.Path | None = None
    """File for the result as JSON; - prints it."""
    on_bad_image: Literal["stop", "skip"] = "stop"
    """Stop at an unreadable image, or leave it out of training and of the sets, and say so."""
    max_pixels: int = 2**28
    """Pixels that an image file may have; larger ones are not decoded."""
    plugin: tuple[str, ...] = ()
    """Files FILE.py or modules that register parts of your own; their code is run."""
    quiet: bool = False
    """No progress."""


def settings_of(flags: ComparisonFlags) -> dict[str, Any]:
    """Return the settings of a `ComparisonConfig` that both commands' flags set."""

    backbone = find_given(flags.backbone, quiet=flags.quiet)
    return {
        "test": tuple(map(str, flags.test)),
        "train": None if flags.train is None else str(flags.train),
        "backbone": None if backbone is None else str(backbone),
        "preset": flags.preset,
        "epochs": flags.epochs,
        "image_size": flags.image_size,
        "resize": flags.resize,
        "batch_size": flags.batch_size,
        "grouping": flags.grouping,
        "seeds": flags.seeds,
        "reference": flags.reference,
    }


def names_of(text: str) -> tuple[str, ...]:
    """Split text at commas into names."""
    return tuple(name.strip() for name in text.split(","))


def run_comparison(config: "ComparisonConfig", flags: ComparisonFlags) -> None:
    """Carry out a comparison, and print its tables."""
    from crisalad_jax.experiments.comparison import compare
    from crisalad_jax.experiments.comparison.tables import as_json, tables_of

    notes = rich.console.Console(stderr=True, markup=False, emoji=False, quiet=flags.quiet)
    summary = compare(
        config,
        flags.out,
        page=flags.page,
        on_bad_image=flags.on_bad_image,
        jobs=flags.jobs,
        say=lambda line: notes.print(line, soft_wrap=True, highlight=False),
        quiet=flags.quiet,
    )
    for table in tables_of(summary).values():
        show(table.terminal())
    for note in summary.notes:
        say(note)
    say(f"table.md, table.csv, results.json, and a page: {flags.out / 'index.html'}")
    give_json(flags.json, as_json(summary))
