"""The HTML page of an evaluation, which embeds its pictures and loads nothing from the network."""

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
from crisalad_jax.evaluation.record import table_notes
from crisalad_jax.evaluation.results import GroupingResult, percent
from crisalad_jax.experiments.report.charts import (
    OUTCOMES,
    Positions,
    find_placed,
    outcomes_of,
    position_map,
    precision_curves,
    recall_curves,
    similarity_matrix,
)
from crisalad_jax.experiments.report.gallery import evenly, first_right_ranks, thumbnail
from crisalad_jax.experiments.report.style import Drawing, chart, illustration, photograph
from crisalad_jax.experiments.report.transport import Transported, draw_transport, transport_of
from crisalad_jax.experiments.result_tables import result_tables
from crisalad_jax.experiments.tables import write_csv, write_text
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.utils.locks import staged_folder
from crisalad_jax.utils.output import printable

PAGE = "index.html"
_RETRIEVALS = 4
"""Number of retrievals shown for each query."""
_SHOWN = 6
"""Maximum number of queries shown for each outcome."""
_THUMBNAIL = 320


def write_report(
    out: str | os.PathLike[str],
    benchmark: Benchmark,
    groupings: Sequence[GroupingResult],
    *,
    model: Model,
    model_name: str,
    settings: dict[str, Any],
    similarities: Float[np.ndarray, "rows columns"] | None = None,
) -> pathlib.Path:
    """Write index.html, its charts and results.csv into the folder `out`.

    The retrievals, the map of positions and the matrix of similarities on the page are those of the
    first grouping; results.csv has a row for every query under every grouping.

    Args:
        out: the folder, created if missing. Files of the same names are replaced.
        benchmark: the evaluated benchmark, without unreadable images.
        groupings: the results of `evaluate`, at least one.
        model: the model; if it has an optimal transport, the page shows that of some images.
        model_name: name of the model, for the page.
        settings: settings from `evaluation_record`, which the page shows collapsed.
        similarities: `similarity_map` of the first grouping; None leaves the matrix out.

    Returns:
        The path of the page.

    Raises:
        InputError: there is no ground truth, an image cannot be read, or a file cannot be written;
            no file is then written.

    Example:
        >>> import shutil
        >>> import crisalad_jax as cj
        >>> for side in ("queries", "database"):
        ...     _ = shutil.copytree(pictures, folder / "set" / side)
        >>> lines = ["query,database", *(f"{number}.png,{number}.png" for number in range(4))]
        >>> _ = (folder / "set" / "ground_truth.csv").write_text("\\n".join(lines))
        >>> benchmark = cj.open_benchmark(folder / "set", layout="folders")
        >>> model, quiet = cj.load("starter"), cj.Reading(quiet=True)
        >>> results = cj.evaluate(model, benchmark, groupings=["single"], reading=quiet)
        >>> asked = {"model_name": "starter", "batch_size": 4, "seed": 0, "seeds": 1}
        >>> record = cj.evaluation_record(results, benchmark, model.config, **asked)
        >>> names = {"model_name": "starter", "settings": record.settings}
        >>> write_report(folder / "report", benchmark, results, model=model, **names).name
        'index.html'
    """
    main = groupings[0]
    subject = Subject.of(benchmark, main.neighbours)
    shown = subject.choose()
    with staged_folder(out) as folder:
        rows = [row for grouping in groupings for row in query_results(subject, grouping)]
        write_csv(folder / "results.csv", rows)
        context = {
            "title": benchmark.name,
            "model_name": model_name,
            "subject": subject,
            "config": model.config,
            "main": main,
            "tables": result_tables(groupings),
            "notes": table_notes(groupings, settings),
            "curves": _curves(folder, groupings),
            "galleries": {
                outcome: [_photographs(subject, query) for query in chosen]
                for outcome, chosen in shown.items()
                if chosen
            },
            "results": page_rows(subject, main),
            "outcomes": OUTCOMES,
            "map": _map(folder, subject),
            "transport": list(_transport(subject, shown, model)),
            "matrix": _matrix(folder, subject, similarities),
            "settings": json.dumps(settings, indent=2),
        }
        write_text(folder / PAGE, render("page.html", context))
    return pathlib.Path(out) / PAGE


def render(template: str, context: Mapping[str, Any]) -> str:
    """Render a Jinja template of this package; in an HTML page, all of the context is escaped."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("crisalad_jax.experiments.report"),
        autoescape=jinja2.select_autoescape(),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["percent"] = percent
    return environment.get_template(template).render(context)


class Subject(NamedTuple):
    """The evaluation that all sections of a page show."""

    benchmark: Benchmark
    neighbours: Neighbours
    outcomes: np.ndarray
    """Outcome of each query, one of `OUTCOMES`."""
    positions: Positions | None
    """Where the images were taken; None if unknown."""

    @classmethod
    def of(cls, benchmark: Benchmark, neighbours: Neighbours) -> "Subject":
        """Make a subject from retrievals: judge their outcomes, and find plausible positions."""
        places, asked = benchmark.database_positions, benchmark.query_positions
        positions = None if places is None or asked is None else find_placed(places, asked)
        outcomes = outcomes_of(neighbours, benchmark.ground_truth())
        return cls(benchmark, neighbours, outcomes, positions)

    def name(self, path: pathlib.Path) -> str:
        """Return a file's path relative to the benchmark's folder; outside it, only its name."""
        root = self.benchmark.root
        return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name

    def metres(self, query: int, index: int) -> float | None:
        """Return the metres from a query to a database image; None without plausible positions."""
        places = self.positions
        if places is None:
            return None
        if not (places.queries_placed[query] and places.database_placed[index]):
            return None
        return math.dist(places.queries[query], places.database[index])

    def choose(self, most: int = _SHOWN) -> dict[str, list[int]]:
        """Choose at most `most` queries of each outcome; return their indices by outcome.

        Of "wrong" and "no positive", the queries with the most similar first retrieval are chosen,
        which would do the most harm; "right" ones are spread from the most to the least similar.
        """
        order = np.argsort(-self.neighbours.similarities[:, 0], kind="stable")
        wrong, unmatched, right = (order[self.outcomes[order] == each] for each in OUTCOMES)
        return {
            "right": evenly(right, most),
            "wrong": wrong[:most].tolist(),
            "no positive": unmatched[:most].tolist(),
        }


def _curves(folder: pathlib.Path, groupings: Sequence[GroupingResult]) -> list[Drawing]:
    """Draw recall by K and, if known, precision by recall, with a line for each grouping."""
    best = "; ".join(f"{g.label} {percent(g.recalls[min(g.recalls)])} %" for g in groupings)
    recall = recall_curves({g.label: g.recalls for g in groupings})
    words = f"Recall at K against K. At K = 1: {best}"
    drawings = [chart(recall, folder / "recall_curves.png", words)]
    known = {g.label: g.precision_recall for g in groupings if g.precision_recall is not None}
    if known:
        words = f"Precision against recall: {', '.join(known)}"
        drawings.append(chart(precision_curves(known), folder / "precision_recall.png", words))
    return drawings


def query_results(subject: Subject, grouping: GroupingResult) -> Iterator[dict[str, Any]]:
    """Yield the result of each query under a grouping (first seed), as rows of results.csv.

    Files are named by their path in the benchmark's folder, with control characters escaped.
    """
    benchmark, neighbours = subject.benchmark, grouping.neighbours
    outcomes = outcomes_of(neighbours, benchmark.ground_truth()).tolist()
    ranks = first_right_ranks(neighbours, benchmark.ground_truth()).tolist()
    for query, path in enumerate(benchmark.queries):
        first = int(neighbours.indices[query, 0])
        metres = subject.metres(query, first)
        yield {
            "query": printable(subject.name(path)),
            "grouping": grouping.grouping,
            "rerank": grouping.rerank or "",
            "outcome": outcomes[query],
            "rank_of_first_positive": ranks[query] or None,
            "first_retrieval": printable(subject.name(benchmark.database[first])),
            "similarity": round(float(neighbours.similarities[query, 0]), 6),
            "distance_m": None if metres is None else round(metres, 2),
        }


def page_rows(subject: Subject, grouping: GroupingResult) -> list[list[Any]]:
    """Return the rows of the page's table of queries as short lists; queries.js reads them.

    Names of files leave out the folder that all names of their column share.
    """
    rows = list(query_results(subject, grouping))
    for name in ("query", "first_retrieval"):
        folder = posixpath.commonpath([posixpath.dirname(row[name]) for row in rows])
        for row in rows:
            row[name] = row[name].removeprefix(f"{folder}/")
    columns = ("rank_of_first_positive", "first_retrieval", "similarity", "distance_m")
    return [
        [row["query"], OUTCOMES.index(row["outcome"]), *(row[name] for name in columns)]
        for row in rows
    ]


def _photographs(subject: Subject, query: int) -> tuple[str, list[Drawing]]:
    """Name a query, and show it, its first retrievals, and what should have come first."""
    benchmark = subject.benchmark
    positives = benchmark.ground_truth()[query]
    indices, similarities = (part[query] for part in subject.neighbours)

    def show(path: pathlib.Path, kind: str, words: str, *lines: str) -> Drawing:
        image = thumbnail(read_image(path, bit_depth="contrast-stretch"), _THUMBNAIL)
        return photograph(image, f"{words}: {subject.name(path)}", kind, lines)

    photographs = [show(benchmark.queries[query], "query", "query", "query")]
    for rank, index in enumerate(indices[:_RETRIEVALS], 1):
        kind = "right" if index in positives else "wrong"
        lines = f"{rank}", f"{similarities[rank - 1]:.3f}", *_away(subject, query, index)
        path = benchmark.database[index]
        photographs.append(show(path, kind, f"retrieval {rank}, {kind}", *lines))
    if subject.outcomes[query] == "wrong":
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
    return subject.name(benchmark.queries[query]), photographs


def _away(subject: Subject, query: int, index: int) -> tuple[str, ...]:
    metres = subject.metres(query, index)
    if metres is None:
        return ()
    return (f"{metres:,.0f} m" if metres < 10_000 else f"{metres / 1000:,.0f} km",)


def _map(folder: pathlib.Path, subject: Subject) -> Drawing | None:
    """Draw the map of all images; None without positions."""
    positions, outcomes = subject.positions, subject.outcomes
    if positions is None:
        return None
    figure = position_map(positions, subject.neighbours.indices[:, 0], outcomes)
    right, wrong = ((outcomes == outcome).sum() for outcome in ("right", "wrong"))
    words = (
        f"Map of {len(positions.database)} database images and {len(outcomes)} queries, of which "
        f"{right} are right and {wrong} wrong"
    )
    return chart(figure, folder / "positions.png", words)


def _matrix(
    folder: pathlib.Path,
    subject: Subject,
    similarities: Float[np.ndarray, "rows columns"] | None,
) -> Drawing | None:
    """Draw the similarities between all queries and the database; None if they are unknown."""
    if similarities is None:
        return None
    benchmark, first = subject.benchmark, subject.neighbours.indices[:, 0]
    positives, count = benchmark.ground_truth(), len(benchmark.database)
    figure = similarity_matrix(similarities, positives, first, subject.outcomes, count)
    words = f"Similarities of {len(benchmark.queries)} queries (rows) and {count} database images"
    return chart(figure, folder / "similarities.png", words)


def _transport(
    subject: Subject, shown: Mapping[str, list[int]], model: Model
) -> Iterator[tuple[str, Drawing]]:
    """Yield names and drawings of two wrong and two correct queries, with their first retrievals.

    There are none for a model without a transport.
    """
    if not model.config.aggregator.transports:
        return
    benchmark, first = subject.benchmark, subject.neighbours.indices[:, 0]

    def transport(path: pathlib.Path) -> Transported:
        bit_depth = model.config.preprocessing.bit_depth
        return transport_of(read_image(path, bit_depth=bit_depth), model)

    pairs = []
    for query in shown["wrong"][:2] + shown["right"][:2] or shown["no positive"][:2]:
        word = "right" if subject.outcomes[query] == "right" else "wrong"
        retrieved = transport(benchmark.database[first[query]])
        pair = {"query": transport(benchmark.queries[query]), f"retrieved, {word}": retrieved}
        pairs.append((subject.name(benchmark.queries[query]), pair))
    among = [picture for _, pair in pairs for picture in pair.values()]
    for name, pair in pairs:
        words = f"Dustbin and top clusters of each patch of {name} and of its first retrieval"
        yield name, illustration(draw_transport(pair, among, photographs=False), words)
