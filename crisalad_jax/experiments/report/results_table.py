"""The result of every query: a row of results.csv, and of the table in a page."""

import csv
import os
import pathlib
import posixpath
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.evaluation.metrics import right_retrievals
from crisalad_jax.evaluation.results import GroupingResult
from crisalad_jax.experiments.report.sections import Subject
from crisalad_jax.experiments.report.tables import no_formula
from crisalad_jax.utils.files import atomic_path
from crisalad_jax.utils.output import printable

RESULTS = "results.csv"
OUTCOMES = ("wrong", "no positive", "right")
"""What became of a query, in the order of the page's table."""


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
    right = right_retrievals(neighbours.indices, positives)
    ranks = np.where(right.any(axis=1), right.argmax(axis=1) + 1, 0)
    for query, (path, rank) in enumerate(zip(benchmark.queries, ranks.tolist(), strict=True)):
        first = int(neighbours.indices[query, 0])
        matched = len(positives[query]) > 0
        yield QueryResult(
            subject.name(path),
            "right" if rank == 1 else "wrong" if matched else "no positive",
            rank or None,
            subject.name(benchmark.database[first]),
            float(neighbours.similarities[query, 0]),
            subject.metres(query, first),
        )


_HEADERS = (
    *("query", "grouping", "rerank", "outcome", "rank_of_first_positive"),
    *("first_retrieval", "similarity", "distance_m"),
)


def write_results(
    path: str | os.PathLike[str], subject: Subject, groupings: Sequence[GroupingResult]
) -> None:
    """Write results.csv: a row for every query under every grouping, of the first seed.

    Control characters in names are escaped, and no cell is a spreadsheet's formula.
    """
    with (
        atomic_path(path) as temporary,
        pathlib.Path(temporary).open("w", encoding="utf-8", newline="") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(_HEADERS)
        for grouping in groupings:
            for row in query_results(subject, grouping):
                writer.writerow(
                    (
                        no_formula(printable(row.query)),
                        grouping.grouping,
                        grouping.rerank or "",
                        row.outcome,
                        "" if row.rank is None else row.rank,
                        no_formula(printable(row.retrieval)),
                        f"{row.similarity:.6f}",
                        "" if row.metres is None else f"{row.metres:.2f}",
                    )
                )


def page_rows(subject: Subject, grouping: GroupingResult) -> list[list[Any]]:
    """Return the rows of the page's table, as short as JSON allows; see queries.js.

    Names lack the folder that all of a side's images are in.
    """
    benchmark = subject.benchmark
    asked, places = (_folder(subject, paths) for paths in (benchmark.queries, benchmark.database))
    return [
        [
            printable(row.query.removeprefix(asked)),
            OUTCOMES.index(row.outcome),
            row.rank,
            printable(row.retrieval.removeprefix(places)),
            round(row.similarity, 4),
            None if row.metres is None else round(row.metres, 1),
        ]
        for row in query_results(subject, grouping)
    ]


def _folder(subject: Subject, paths: Sequence[pathlib.Path]) -> str:
    """Return the folder that all images are in, as it begins their names."""
    folders = [pathlib.PurePosixPath(subject.name(path)).parent for path in paths]
    common = posixpath.commonpath([folder.as_posix() for folder in folders])
    return "" if common in ("", ".") else f"{common}/"
