"""Output of a study: a page with its table, its values as JSON, and a plot."""

import argparse
import json
import pathlib
from collections.abc import Callable, Collection, Iterable
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crisalad_jax.experiments import tables
from crisalad_jax.experiments.report import style
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, check_target

INK, GREY = style.INK, style.GREY
COLOURS = (*style.COLOURS, INK)
TITLES = {
    "claims": "Claimed recalls and their sources",
    "models": "Published models in this package",
    "leakage": "How groupings leak places",
    "order": "Recall by the order of the images",
    "runtimes": "Recall by runtime",
    "zoo": "Exported published models",
    "bench_million": "A million images",
    "bench_cluster": "Describing on a Ray cluster",
    "sequence": "Recall of the sequence filter",
    "bench_describe_costs": "First call and memory of describing",
    "bench_train_costs": "First call and memory of a training step",
    "bench_locate": "Latency of Map.locate",
    "bench_scale": "Time and memory by input size",
    "bench_published": "Speed of published models",
    "bench_published_costs": "First call and memory of published models",
    "bench_extract": "From a folder of images to descriptors",
    "bench_start": "From a new process to the first descriptor",
    "bench_bfloat16": "Error of bfloat16",
    "bench_recall": "Recall in bfloat16",
    "bench_products": "Speed of matrix products by type",
    "bench_gradients": "Gradients in bfloat16",
    "bench_versions": "Speed by JAX version",
    "study_compiler": "XLA compiler options",
    "bench_profile": "Where the time goes",
    "bench_pooling": "Speed of pooling",
    "bench_describe": "Speed of describing",
    "bench_train": "Speed of training",
    "bench_query": "Time of a query",
    "bench_search": "Speed of exact search",
    "search_memory": "Memory of exact search",
    "search_approximate": "Approximate search",
    "bench_serve": "Throughput of the service",
    "dustbin": "Effect of the dustbin's parameter",
    "error": "Marginal error by iterations",
    "mass": "Cluster masses after 3 iterations",
    "gradient": "Gradient error by iterations",
    "acceleration": "Iterations of accelerated solvers",
    "sharpness": "Iterations by epsilon",
    "precision": "Plan error by precision",
    "recall": "Recall by transport",
    "bench_fixed": "Speed of a fixed number of iterations",
    "bench_converged": "Speed to convergence",
    "transport": "Transports in small training runs",
    "transport_more": "Further transports in small training runs",
    "adapters": "Adapters in small training runs",
    "encoder": "The cross-image encoder in small training runs",
    "world": "Variations of the rendered world",
    "distil": "Distillation in small training runs",
    "recalls": "Recall of the packaged model",
    "bench_memory": "Memory of a training step",
    "bench_loader": "Speed of the loader",
    "bench_overlap": "Loading during training",
    "bench_index": "Indexing a data set of the size of GSV-Cities",
}
"""The title of each study's page, by the name of its files."""


class Table(NamedTuple):
    """A table: the first `labels` columns hold text, the others numbers."""

    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    caption: str
    labels: int = 1


class Study(NamedTuple):
    table: Table
    values: Any
    """The unrounded values, for JSON."""
    figure: Figure | None = None


def number(value: float) -> str:
    """Format a number with two significant digits."""
    value = float(value)
    return f"{value:.1e}" if value and not 1e-3 <= abs(value) < 1e4 else f"{value:.2g}"


def markdown(table: Table) -> str:
    rows = [list(map(tables.Cell, cells)) for cells in table.rows]
    text = tables.Table(table.header, rows, table.labels).markdown()
    return f"{table.caption}\n\n{text}" if table.caption else text


def files_of(name: str, out: pathlib.Path) -> list[pathlib.Path]:
    """Return the paths of a study's page, values and plot."""
    return [out / f"{name}{suffix}" for suffix in (".md", ".json", ".png")]


def save(name: str, study: Study, out: pathlib.Path) -> None:
    """Write NAME.md, NAME.json and, if there is a figure, NAME.png."""
    page, values, picture = files_of(name, out)
    tables.write_text(page, f"# {TITLES[name]}\n\n{markdown(study.table)}")
    with atomic_path(values) as temporary:
        temporary.write_text(json.dumps(study.values, indent=2) + "\n", encoding="utf-8")
    if study.figure is not None:
        with atomic_path(picture) as temporary:
            study.figure.savefig(temporary, format="png", dpi=120, facecolor="white")


def flags(description: str, out: str) -> argparse.ArgumentParser:
    """Make a parser with `--out`, the folder of a study's files."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path(out))
    return parser


def count(text: str) -> int:
    """Parse an argument that is an integer >= 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a whole number >= 1")
    return int(text)


def read(parser: argparse.ArgumentParser, *names: str) -> argparse.Namespace:
    """Parse arguments, and check that the studies `names` can be saved."""
    arguments = parser.parse_args()
    _check_targets(parser, arguments, names)
    return arguments


def read_some(parser: argparse.ArgumentParser, names: Collection[str]) -> argparse.Namespace:
    """Parse arguments like `read`, with `studies`: those of `names` to run, by default all."""
    words = ", ".join(names)
    parser.add_argument(
        "studies", nargs="*", metavar="STUDY", help=f"one of {words}; all by default"
    )
    arguments = parser.parse_args()
    if unknown := set(arguments.studies) - set(names):
        parser.error(f"found {', '.join(sorted(unknown))}, expected some of {words}")
    arguments.studies = arguments.studies or list(names)
    _check_targets(parser, arguments, arguments.studies)
    return arguments


def _check_targets(
    parser: argparse.ArgumentParser, arguments: argparse.Namespace, names: Iterable[str]
) -> None:
    """Exit with one line if a study can't be saved in `--out`."""
    try:
        for name in names:
            assert name in TITLES, f"{name} needs a title"
            for path in files_of(name, arguments.out):
                check_target(path)
    except (InputError, OSError) as error:
        parser.error(str(error))


def leave(name: str, study: Study, arguments: argparse.Namespace) -> None:
    """Save a study in `--out`, and print its table."""
    save(name, study, arguments.out)
    print(markdown(study.table), flush=True)


def panels(
    count: int, titles: tuple[str, ...], *, width: float = 4.0, height: float = 3.4, sharey=True
) -> tuple[Figure, list[Axes]]:
    """Make a row of panels in the project's plain style."""
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
    """Plot one panel per title, with a bar per contender as long as the first value of `length`."""
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
