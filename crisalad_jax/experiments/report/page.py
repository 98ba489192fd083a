"""One HTML page of an evaluation, which embeds its pictures and loads nothing from the network."""

import csv
import io
import json
import math
import os
import pathlib
import posixpath
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.images import read_image
from crisalad_jax.data.metres import flattened
from crisalad_jax.evaluation.operating_point import OperatingPoint, caveats
from crisalad_jax.evaluation.results import ANY, GroupingResult, percent
from crisalad_jax.experiments.report.charts import (
    Placed,
    Verdicts,
    find_placed,
    judge,
    position_map,
    similarity_matrix,
)
from crisalad_jax.experiments.report.curves import precision_curves, recall_curves
from crisalad_jax.experiments.report.gallery import first_right_ranks, thumbnail
from crisalad_jax.experiments.report.style import Drawing, drawing, photograph
from crisalad_jax.experiments.report.tables import (
    Cell,
    Table,
    check_fractions,
    no_formula,
    write_text,
)
from crisalad_jax.experiments.report.transport import (
    CLUSTER_COLOURS,
    draw_clusters,
    draw_dustbin,
    heat_gradient,
    heat_range,
    strongest_clusters,
    transport_of,
)
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad
from crisalad_jax.retrieval.grouping import GROUPINGS, Grouping
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.locks import staged_folder
from crisalad_jax.utils.output import printable

PAGE = "index.html"
OUTCOMES = ("wrong", "no positive", "right")
"""What became of a query, in the order of the page's table."""
_DASH = "\N{EN DASH}"
_RETRIEVALS = 4
"""Number of retrievals shown for each query."""
_SHOWN = 6
"""Largest number of queries shown of each kind."""
_THUMBNAIL = 320


def write_report(
    out: str | os.PathLike[str],
    benchmark: Benchmark,
    groupings: Sequence[GroupingResult],
    *,
    params: Crisalad,
    config: ModelConfig,
    model_name: str,
    settings: Mapping[str, Any],
    similarities: Float[np.ndarray, "rows columns"] | None = None,
) -> pathlib.Path:
    """Write index.html, its charts and results.csv into the folder `out`; return the page's path.

    Retrievals, map and matrix are those of the first grouping; results.csv has a row for every
    query under every grouping.

    Args:
        out: the folder, made where it is missing. Files of the same names are replaced.
        benchmark: what was evaluated on.
        groupings: the results, at least one.
        params: the model's, for the section on its transport; a model without one has none.
        config: the model's.
        model_name: which weights.
        settings: the evaluation's settings as JSON values, shown folded.
        similarities: what `similarity.similarity_map` gives of the first grouping.

    Raises:
        InputError: no groupings or ground truth, a recall outside 0 to 1, an image that cannot be
            read, or files that cannot be written: then none of them is.
    """
    if not groupings:
        raise InputError("groupings: found none, expected at least one")
    for grouping in groupings:
        check_fractions(grouping.label, grouping.recalls)
    main = groupings[0]
    subject = Subject.of(benchmark, main.neighbours)
    placed, shown = subject.placed, subject.choose()
    with staged_folder(out) as folder:
        write_results(folder / "results.csv", subject, groupings)
        context = {
            "title": benchmark.name,
            "model_name": model_name,
            "benchmark": benchmark,
            "config": config,
            "groupings": groupings,
            "main": main,
            "unmatched": int((~subject.verdicts.matched).sum()),
            "table": _table(groupings),
            "points": [
                (g.label, f"{100 * g.operating_point.asked:g}", caveats(g.operating_point))
                for g in groupings
                if g.operating_point is not None
            ],
            "meanings": _meanings(groupings),
            "depends": params.cross_image is not None,
            "curves": _curves(folder, groupings),
            "galleries": list(_galleries(subject, shown)),
            "results": page_rows(subject, main),
            "outcomes": OUTCOMES,
            "kept": main.neighbours.indices.shape[1],
            "metres": placed is not None,
            "map": _map(folder, subject),
            "lost": placed
            and {
                "queries": int((~placed.queries).sum()),
                "database": int((~placed.database).sum()),
                "limit": placed.limit,
            },
            "transport": _transport(subject, shown, params, config),
            "matrix": _matrix(folder, subject, similarities),
            "settings": json.dumps(settings, indent=2),
        }
        write_text(folder / PAGE, render("page.html", context))
    return pathlib.Path(out) / PAGE


def render(template: str, context: Mapping[str, Any]) -> str:
    """Render a page from a template; everything in the context is escaped, names of files too."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("crisalad_jax.experiments.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["percent"] = percent
    return environment.get_template(template).render(context)


class Subject(NamedTuple):
    """The evaluation that all sections show."""

    benchmark: Benchmark
    neighbours: Neighbours
    verdicts: Verdicts
    placed: Placed | None
    """Which images have a likely position; None where none has one."""

    @classmethod
    def of(cls, benchmark: Benchmark, neighbours: Neighbours) -> "Subject":
        """Judge an evaluation's retrievals and positions."""
        places, asked = benchmark.database_positions, benchmark.query_positions
        placed = None if places is None or asked is None else find_placed(places, asked)
        return cls(benchmark, neighbours, judge(neighbours, benchmark.ground_truth()), placed)

    def name(self, path: pathlib.Path) -> str:
        """Name a file of the benchmark by its path in the benchmark's folder."""
        root = self.benchmark.root
        return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name

    def metres(self, query: int, index: int) -> float | None:
        """Measure the metres from a query to a database image; None without likely positions."""
        places, asked = self.benchmark.database_positions, self.benchmark.query_positions
        if places is None or asked is None or self.placed is None:
            return None
        if not (self.placed.queries[query] and self.placed.database[index]):
            return None
        return math.dist(asked[query], places[index])

    def choose(self, most: int = _SHOWN) -> dict[str, list[int]]:
        """Choose at most `most` queries of each kind, by similarity and then in file order.

        Wrong queries and those without a positive are the most confident ones, which would do the
        most harm. Right queries are spread evenly from the most to the least confident.
        """
        order = np.argsort(-self.neighbours.similarities[:, 0], kind="stable")
        verdicts = self.verdicts
        right = order[verdicts.right[order]]
        spread = np.linspace(0, len(right) - 1, min(most, len(right))).round().astype(int)
        return {
            "right": right[spread].tolist(),
            "wrong": order[verdicts.wrong[order]][:most].tolist(),
            "unmatched": order[~verdicts.matched[order]][:most].tolist(),
        }


def _table(groupings: Sequence[GroupingResult]) -> Table:
    """Make a row for each grouping, without columns that all lack."""

    def cell(value: float | None) -> Cell:
        return Cell(_DASH if value is None else percent(value))

    ks = sorted({k for grouping in groupings for k in grouping.recalls})
    asked = next((g.operating_point.asked for g in groupings if g.operating_point), 0.0)
    columns = {
        "grouping": [Cell(g.label) for g in groupings],
        **{f"R@{k}": [_recall(g, k) for g in groupings] for k in ks},
        "same place, queries": [cell(g.query_share) for g in groupings],
        "same place, database": [cell(g.database_share) for g in groupings],
        "AP": [cell(g.average_precision) for g in groupings],
        "recall at 100 % precision": [cell(g.recall_at_full_precision) for g in groupings],
        f"at {100 * asked:g} %": [_point(g.operating_point) for g in groupings],
    }
    columns = {
        header: cells
        for header, cells in columns.items()
        if any(each != Cell(_DASH) for each in cells)
    }
    return Table(list(columns), list(zip(*columns.values(), strict=True)))


def _recall(grouping: GroupingResult, k: int) -> Cell:
    if k not in grouping.recalls:
        return Cell(_DASH)
    notes = []
    if grouping.spread is not None:
        notes.append(f"± {percent(grouping.spread.recalls[k])}")
    if k in grouping.intervals:
        notes.append(_DASH.join(map(percent, grouping.intervals[k])))
    return Cell(percent(grouping.recalls[k]), "\n".join(notes))


def _point(point: OperatingPoint | None) -> Cell:
    if point is None:
        return Cell(_DASH)
    if not point.reached:
        return Cell(_DASH, f"highest precision {percent(point.precision)}")
    return Cell(percent(point.recall), f"similarity from {point.min_similarity:.9g}")


def _meanings(groupings: Sequence[GroupingResult]) -> dict[str, str]:
    """Explain which images attend to each other, for every kind of grouping in the results."""
    named = [Grouping.parse(g.grouping) for g in groupings if g.grouping != ANY]
    meanings = {kind: GROUPINGS[kind] for each in named for kind in (each.queries, each.database)}
    if any(each.queries != each.database for each in named):
        meanings["a/b"] = "queries by a, database by b"
    return meanings


def _curves(folder: pathlib.Path, groupings: Sequence[GroupingResult]) -> list[Drawing]:
    """Draw recall by K and, where it is known, precision by recall: a line for each grouping."""
    best = "; ".join(f"{g.label} {percent(g.recalls[min(g.recalls)])} %" for g in groupings)
    path = folder / "recall_curves.png"
    recall_curves(path, {g.label: g.recalls for g in groupings})
    drawings = [drawing(path, f"Recall at K against K. At K = 1: {best}")]
    known = {g.label: g.precision_recall for g in groupings if g.precision_recall is not None}
    if known:
        path = folder / "precision_recall.png"
        precision_curves(path, known)
        drawings.append(drawing(path, f"Precision against recall: {', '.join(known)}"))
    return drawings


class QueryResult(NamedTuple):
    """What one query found under one grouping."""

    query: str
    """Its file, by the path in the set's folder."""
    outcome: str
    """One of `OUTCOMES`."""
    rank: int | None
    """Rank of the first right retrieval, from 1; None where none of those kept is right."""
    retrieval: str
    """File of the first retrieval."""
    similarity: float
    metres: float | None
    """Metres from the query to the first retrieval; None without known positions of both."""


def query_results(subject: Subject, grouping: GroupingResult) -> Iterator[QueryResult]:
    """Yield the result of every query under a grouping, in the order of the queries."""
    benchmark, neighbours = subject.benchmark, grouping.neighbours
    positives = benchmark.ground_truth()
    ranks = first_right_ranks(neighbours, positives).tolist()
    for query, (path, rank) in enumerate(zip(benchmark.queries, ranks, strict=True)):
        first = int(neighbours.indices[query, 0])
        yield QueryResult(
            printable(subject.name(path)),
            "right" if rank == 1 else "wrong" if len(positives[query]) else "no positive",
            rank or None,
            printable(subject.name(benchmark.database[first])),
            float(neighbours.similarities[query, 0]),
            subject.metres(query, first),
        )


def write_results(
    path: pathlib.Path, subject: Subject, groupings: Sequence[GroupingResult]
) -> None:
    """Write results.csv: a row for every query under every grouping, of the first seed.

    Control characters in names are escaped, and no cell is a spreadsheet's formula.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(
        (
            *("query", "grouping", "rerank", "outcome", "rank_of_first_positive"),
            *("first_retrieval", "similarity", "distance_m"),
        )
    )
    for grouping in groupings:
        for row in query_results(subject, grouping):
            metres = "" if row.metres is None else f"{row.metres:.2f}"
            names = no_formula(row.query), grouping.grouping, grouping.rerank or ""
            found = no_formula(row.retrieval), f"{row.similarity:.6f}", metres
            writer.writerow((*names, row.outcome, row.rank or "", *found))
    write_text(path, text.getvalue())


def page_rows(subject: Subject, grouping: GroupingResult) -> list[list[Any]]:
    """Return the rows of the page's table, as short as JSON allows; see queries.js.

    Names lack the folder that all of a side's images are in.
    """
    benchmark = subject.benchmark
    asked, places = (_folder(subject, paths) for paths in (benchmark.queries, benchmark.database))
    return [
        [
            row.query.removeprefix(asked),
            OUTCOMES.index(row.outcome),
            row.rank,
            row.retrieval.removeprefix(places),
            round(row.similarity, 4),
            None if row.metres is None else round(row.metres, 1),
        ]
        for row in query_results(subject, grouping)
    ]


def _folder(subject: Subject, paths: Sequence[pathlib.Path]) -> str:
    """Return the folder that all images are in, as it begins their names."""
    folders = [posixpath.dirname(printable(subject.name(path))) for path in paths]
    common = posixpath.commonpath(folders)
    return f"{common}/" if common else ""


class Photograph(NamedTuple):
    """A small photograph in a gallery."""

    drawing: Drawing
    kind: str
    """One of query, right, wrong and expected."""
    lines: tuple[str, ...]


def _galleries(subject: Subject, shown: Mapping[str, Sequence[int]]) -> Iterator[dict[str, Any]]:
    """Yield the queries shown of each kind, with what was retrieved for them."""
    verdicts, queries = subject.verdicts, subject.benchmark.queries
    masks = {"right": verdicts.right, "wrong": verdicts.wrong, "unmatched": ~verdicts.matched}
    for kind, chosen in shown.items():
        if chosen:
            found = [(subject.name(queries[each]), _photographs(subject, each)) for each in chosen]
            yield {"kind": kind, "total": int(masks[kind].sum()), "retrievals": found}


def _photographs(subject: Subject, query: int) -> list[Photograph]:
    """Show a query and its first retrievals, and of a wrong one what should have come first."""
    benchmark = subject.benchmark
    positives = benchmark.ground_truth()[query]
    indices, similarities = (part[query] for part in subject.neighbours)

    def show(path: pathlib.Path, kind: str, words: str, *lines: str) -> Photograph:
        image = thumbnail(read_image(path, bit_depth="contrast-stretch"), _THUMBNAIL)
        return Photograph(photograph(image, f"{words}: {subject.name(path)}"), kind, lines)

    photographs = [show(benchmark.queries[query], "query", "query", "query")]
    for rank, index in enumerate(indices[:_RETRIEVALS], 1):
        kind = "right" if index in positives else "wrong"
        lines = f"{rank}", f"{similarities[rank - 1]:.3f}", *_away(subject, query, index)
        path = benchmark.database[index]
        photographs.append(show(path, kind, f"retrieval {rank}, {kind}", *lines))
    if subject.verdicts.wrong[query]:
        # The best retrieved positive, or else the nearest one.
        ranks = np.flatnonzero(np.isin(indices, positives))
        if ranks.size:
            index, rank = int(indices[ranks[0]]), f"rank {ranks[0] + 1}"
        else:
            away = [subject.metres(query, int(index)) or 0 for index in positives]
            index, rank = int(positives[np.argmin(away)]), f"not in the first {len(indices)}"
        lines = "would be right", rank, *_away(subject, query, index)
        words = f"right for the query, {rank}"
        photographs.append(show(benchmark.database[index], "expected", words, *lines))
    return photographs


def _away(subject: Subject, query: int, index: int) -> tuple[str, ...]:
    metres = subject.metres(query, index)
    if metres is None:
        return ()
    return (f"{metres:,.0f} m" if metres < 10_000 else f"{metres / 1000:,.0f} km",)


def _map(folder: pathlib.Path, subject: Subject) -> Drawing | None:
    """Draw the map of all images; None without positions."""
    places, asked = subject.benchmark.database_positions, subject.benchmark.query_positions
    placed, verdicts = subject.placed, subject.verdicts
    if places is None or asked is None or placed is None:
        return None
    places, asked = np.split(flattened(np.concatenate([places, asked])), [len(places)])
    path = folder / "positions.png"
    position_map(path, places, asked, subject.neighbours.indices[:, 0], verdicts, placed)
    words = (
        f"Map of {len(places)} database images and {len(asked)} queries, of which "
        f"{verdicts.right.sum()} are right and {verdicts.wrong.sum()} wrong"
    )
    return drawing(path, words)


def _matrix(
    folder: pathlib.Path,
    subject: Subject,
    similarities: Float[np.ndarray, "rows columns"] | None,
) -> Drawing | None:
    """Draw the similarities of all queries and the whole database; None where they are unknown."""
    if similarities is None:
        return None
    path, benchmark = folder / "similarities.png", subject.benchmark
    first, count = subject.neighbours.indices[:, 0], len(benchmark.database)
    positives, right = benchmark.ground_truth(), subject.verdicts.right
    similarity_matrix(path, similarities, positives, first, right, count)
    words = f"Similarities of {len(benchmark.queries)} queries (rows) and {count} database images"
    return drawing(path, words)


def _transport(
    subject: Subject,
    shown: Mapping[str, list[int]],
    params: Crisalad,
    config: ModelConfig,
    each: int = 2,
) -> dict[str, Any] | None:
    """Draw dustbin and clusters over `each` wrong and right queries and their retrievals.

    The result is None for a model without a transport.
    """
    if not config.aggregator.transports:
        return None
    benchmark, first = subject.benchmark, subject.neighbours.indices[:, 0]
    files = []
    for query in shown["wrong"][:each] + shown["right"][:each] or shown["unmatched"][:each]:
        word = "right" if subject.verdicts.right[query] else "wrong"
        files += [
            ("Query", benchmark.queries[query]),
            (f"Retrieved for it, {word}", benchmark.database[first[query]]),
        ]
    bit_depth = config.preprocessing.bit_depth
    pictures = [  # one by one, for their sizes may differ
        transport_of(read_image(path, bit_depth=bit_depth), params, config) for _, path in files
    ]
    clusters = strongest_clusters(pictures)
    limits = None if pictures[0].dustbin is None else heat_range(pictures)
    panels = []
    for (title, path), picture in zip(files, pictures, strict=True):
        name, share = subject.name(path), picture.dustbin_share
        drawings = [
            photograph(
                draw_clusters(picture, list(clusters)), f"The top cluster of each patch of {name}"
            )
        ]
        if limits is not None:
            words = f"The dustbin's share of each patch of {name}"
            drawings.insert(0, photograph(draw_dustbin(picture, limits), words))
        panels.append({"title": title, "file": name, "share": share, "drawings": drawings})
    keys = zip(CLUSTER_COLOURS, clusters.items(), strict=False)
    return {
        "pictures": panels,
        "heat": limits,
        "gradient": heat_gradient(),
        "clusters": [(colour, number, share) for colour, (number, share) in keys],
    }
