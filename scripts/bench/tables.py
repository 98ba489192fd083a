"""What a study leaves: a table in Markdown, its numbers, a picture; and the page that shows it."""

import argparse
import contextlib
import json
import pathlib
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crisalad_jax.experiments import tables
from crisalad_jax.experiments.report import style
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, check_target, split_markers

INK, GREY = style.INK, style.GREY
COLOURS = (*style.COLOURS, INK)


class Table(NamedTuple):
    """One table: the first `labels` columns are words, the others numbers."""

    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    caption: str
    labels: int = 1


class Study(NamedTuple):
    table: Table
    values: Any
    """The same unrounded, for JSON."""
    figure: Figure | None = None


def number(value: float) -> str:
    """Two significant digits."""
    value = float(value)
    return f"{value:.1e}" if value and not 1e-3 <= abs(value) < 1e4 else f"{value:.2g}"


def markdown(table: Table) -> str:
    rows = [list(map(tables.Cell, cells)) for cells in table.rows]
    return f"{table.caption}\n\n{tables.Table(table.header, rows, table.labels).markdown()}"


def files_of(name: str, out: pathlib.Path) -> list[pathlib.Path]:
    """What a study is saved in: its table, its numbers, its picture if it has one."""
    return [out / f"{name}{suffix}" for suffix in (".md", ".json", ".png")]


def save(name: str, study: Study, out: pathlib.Path) -> None:
    """Write NAME.md, NAME.json and, with a figure, NAME.png."""
    text, numbers, picture = files_of(name, out)
    tables.write_text(text, markdown(study.table))
    with atomic_path(numbers) as temporary:  # numbers for people: no reader checks them
        temporary.write_text(json.dumps(study.values, indent=2) + "\n", encoding="utf-8")
    if study.figure is not None:
        with atomic_path(picture) as temporary:
            study.figure.savefig(temporary, format="png", dpi=120, facecolor="white")


def page_of(pages: Sequence[pathlib.Path], name: str) -> pathlib.Path:
    """The first page that has the comments of this name; the last where none has."""
    for page in pages[:-1]:
        with contextlib.suppress(InputError):
            split_markers(page, name)
            return page
    return pages[-1]


def put(page: pathlib.Path, name: str, text: str) -> None:
    """Put a text in the page, between its two comments of this name.

    Raises:
        InputError: the page has no such comments.
    """
    before, after = split_markers(page, name)
    tables.write_text(page, before + text + after)


def flags(description: str, out: str) -> argparse.ArgumentParser:
    """A parser of where what a study leaves goes: folder `out` by default, and a page if asked."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path(out))
    words = "also put what is tabled into this page; of several, into the one with a place for it"
    parser.add_argument("--page", type=pathlib.Path, action="append", help=words)
    return parser


def count(text: str) -> int:
    """An argument that is a whole number from 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a whole number from 1")
    return int(text)


def read(parser: argparse.ArgumentParser, *names: str) -> argparse.Namespace:
    """The arguments of `flags`, once it is known that the studies of these names have a place."""
    arguments = parser.parse_args()
    _check_places(parser, arguments, names)
    return arguments


def read_some(parser: argparse.ArgumentParser, names: Collection[str]) -> argparse.Namespace:
    """As `read`, of those of these studies that are asked for, or of all: its `studies`."""
    words = ", ".join(names)
    parser.add_argument("studies", nargs="*", metavar="STUDY", help=f"of {words}")
    arguments = parser.parse_args()
    if unknown := set(arguments.studies) - set(names):
        parser.error(f"found {', '.join(sorted(unknown))}, expected of {words}")
    arguments.studies = arguments.studies or list(names)
    _check_places(parser, arguments, arguments.studies)
    return arguments


def _check_places(
    parser: argparse.ArgumentParser, arguments: argparse.Namespace, names: Iterable[str]
) -> None:
    """End the program in one line if a study cannot be left where the arguments say, before it."""
    try:
        for name in names:
            for path in files_of(name, arguments.out):
                check_target(path)
            if arguments.page is not None:
                split_markers(page_of(arguments.page, name), name)
    except (InputError, OSError) as error:
        parser.error(str(error))


def leave(name: str, study: Study, arguments: argparse.Namespace) -> None:
    """Put a study where the arguments of `flags` say, and on the terminal."""
    save(name, study, arguments.out)
    if arguments.page is not None:
        put(page_of(arguments.page, name), name, markdown(study.table))
    print(markdown(study.table), flush=True)


def panels(
    count: int, titles: tuple[str, ...], *, width: float = 4.0, height: float = 3.4, sharey=True
) -> tuple[Figure, list[Axes]]:
    """A row of panels in the project's plain style."""
    figure = Figure(figsize=(width * count, height), layout="constrained")
    axes = list(figure.subplots(1, count, squeeze=False, sharey=sharey)[0])
    for one, title in zip(axes, titles, strict=True):
        style.label_axes(one, "", "", title=title)
    return figure, axes


def bars(
    values: list[dict[str, Any]],
    title: Callable[[dict[str, Any]], str],
    length: str,
    label: str,
) -> Figure:
    """A panel for each title, in it a bar for each contender, as long as the first of `length`."""
    titles = tuple(dict.fromkeys(map(title, values)))
    names = list(dict.fromkeys(value["contender"] for value in values))
    figure, axes = panels(len(titles), titles, width=3.4, height=2.8, sharey=False)
    for one, name in zip(axes, titles, strict=True):
        chosen = [value for value in values if title(value) == name]
        lengths = [value[length][0] for value in chosen]
        places = range(len(chosen))
        one.barh(
            places, lengths, color=[COLOURS[names.index(value["contender"])] for value in chosen]
        )
        for place, end in zip(places, lengths, strict=True):
            one.annotate(f" {end:.2f}", (end, place), va="center", fontsize=8)
        one.axvline(1, color=GREY, linewidth=0.8)
        one.set_yticks(places, [value["contender"] for value in chosen], fontsize=8)
        one.invert_yaxis()
        one.set_xlim(0, 1.25 * max(lengths))
        one.grid(visible=False)
        one.set_xlabel(label, fontsize=9)
    return figure
